// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Triangles in a z-buffer. Those with a common edge or corner leave no pixel between them: each also covers pixels up
// to `margin` outside its edges, which is more than their rounding errors.
#pragma once

#include <cmath>
#include <vector>

#include "camera/z_buffer.hpp"

namespace cloth::camera {

/// Distance from its edges up to which a triangle covers pixels outside [pixels].
constexpr double margin = 1e-9;

/// A corner in the image: coordinates [pixels] and inverse depth [1/m].
struct ImagePoint {
    double u, v, w;
};

inline ImagePoint projected(const Pinhole& camera, Vec3<double> p) {
    const double w = 1.0 / p.z;
    return {fma(camera.fx, p.x * w, camera.cx), fma(camera.fy, p.y * w, camera.cy), w};
}

/// Draw a triangle. `solid`: only if it is seen from its outside, where its corners run counterclockwise.
inline void draw_triangle(ZBuffer& buffer, const ImagePoint& a, ImagePoint b, ImagePoint c, bool solid,
                          std::uint16_t label) {
    const auto lowest = [](double p, double q, double r) { return p < q ? (p < r ? p : r) : (q < r ? q : r); };
    const auto highest = [](double p, double q, double r) { return p > q ? (p > r ? p : r) : (q > r ? q : r); };
    double area = (b.u - a.u) * (c.v - a.v) - (c.u - a.u) * (b.v - a.v);
    if (!(area != 0.0)) return;  // NaN included
    // v points down, so an outside is seen clockwise in numbers: with a negative area.
    if (solid && area > 0.0) return;
    if (area < 0.0) {
        std::swap(b, c);
        area = -area;
    }
    const Window pixels = window(buffer.camera, std::ceil(lowest(a.u, b.u, c.u)), std::floor(highest(a.u, b.u, c.u)),
                                 std::ceil(lowest(a.v, b.v, c.v)), std::floor(highest(a.v, b.v, c.v)));
    if (pixels.u1 < pixels.u0 || pixels.v1 < pixels.v0) return;
    // Edge function from p to q: (slope_u u + slope_v v) + offset, not negative inside and in the margin.
    struct Edge {
        double slope_u, slope_v, offset;
        Edge(const ImagePoint& p, const ImagePoint& q)
            : slope_u(p.v - q.v), slope_v(q.u - p.u),
              offset(p.u * q.v - q.u * p.v + margin * (std::abs(slope_u) + std::abs(slope_v))) {}
        CLOTH_INLINE V at(V u, double v) const { return splat<V>(slope_u) * u + splat<V>(slope_v * v + offset); }
    };
    const Edge ab(a, b), bc(b, c), ca(c, a);
    const double slope_u = ((b.w - a.w) * (c.v - a.v) - (c.w - a.w) * (b.v - a.v)) / area;
    const double slope_v = ((c.w - a.w) * (b.u - a.u) - (b.w - a.w) * (c.u - a.u)) / area;
    // Rounding in a narrow triangle must not leave the range of its corners.
    const V low = splat<V>(lowest(a.w, b.w, c.w)), high = splat<V>(highest(a.w, b.w, c.w));
    buffer.visit_window(pixels, [&](std::int64_t first, V u, double v, M inside) CLOTH_INLINED {
        const V none{};
        const M covered = inside & (ab.at(u, v) >= none) & (bc.at(u, v) >= none) & (ca.at(u, v) >= none);
        if (!any(covered)) return;
        const V w = splat<V>(slope_u) * (u - splat<V>(a.u)) + splat<V>(slope_v * (v - a.v) + a.w);
        buffer.draw(first, covered, smaller(larger(w, low), high), label);
    });
}

/// Draw triangles (count, 3) of vertices x (3, n) [m] in a frame that `placement` moves to the camera's. Triangles
/// with a vertex that is not finite are left out.
inline void draw_triangles(ZBuffer& buffer, const Placement& placement, std::int64_t n, const double* x,
                           std::int64_t count, const std::int64_t* corners, bool solid, std::uint16_t label) {
    std::vector<Vec3<double>> points(static_cast<std::size_t>(n));
    std::vector<ImagePoint> images(static_cast<std::size_t>(n));
    for (std::int64_t k = 0; k < n; ++k) {
        points[k] = placement.apply({x[k], x[n + k], x[2 * n + k]});
        images[k] = projected(buffer.camera, points[k]);
    }
    for (std::int64_t t = 0; t < count; ++t) {
        const std::int64_t* const corner = corners + 3 * t;
        int in_front = 0;
        for (int k = 0; k < 3; ++k) in_front += points[corner[k]].z >= min_depth;
        if (in_front == 3) {
            draw_triangle(buffer, images[corner[0]], images[corner[1]], images[corner[2]], solid, label);
        } else if (in_front > 0) {
            // The part in front of the camera has three or four corners.
            ImagePoint part[4];
            int size = 0;
            for (int k = 0; k < 3; ++k) {
                const Vec3<double> p = points[corner[k]], q = points[corner[(k + 1) % 3]];
                if (p.z >= min_depth) part[size++] = images[corner[k]];
                if ((p.z >= min_depth) != (q.z >= min_depth)) {
                    Vec3<double> cut = fma((min_depth - p.z) / (q.z - p.z), q - p, p);
                    cut.z = min_depth;
                    part[size++] = projected(buffer.camera, cut);
                }
            }
            for (int k = 2; k < size; ++k) draw_triangle(buffer, part[0], part[k - 1], part[k], solid, label);
        }
    }
}

}  // namespace cloth::camera
