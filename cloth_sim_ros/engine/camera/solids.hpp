// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Solid shapes in a z-buffer, exact for each pixel: the ray of a pixel is intersected with the shape.
#pragma once

#include <limits>

#include "camera/z_buffer.hpp"
#include "contact/shapes.hpp"

namespace cloth::camera {

using contact::Shape;

/// Whether a ray enters a shape, and at which depth [m].
struct Entry {
    M hit;
    V depth;
};

/// The earlier of two entries.
CLOTH_INLINE Entry earlier(const Entry& a, const Entry& b) {
    return {a.hit | b.hit, select(a.hit & (~b.hit | (a.depth < b.depth)), a.depth, b.depth)};
}

/// Root of a t^2 + 2 b t + c = 0 at which a ray enters a round shape.
CLOTH_INLINE Entry smaller_root(V a, V b, V c) {
    const V square = b * b - a * c;
    const M hit = square >= V{};
    return {hit, (-b - root(select(hit, square, V{}))) / a};
}

/// Entry into a slab |p| <= half of an axis, and exit from it. Without motion along it they are infinite or NaN.
CLOTH_INLINE void intersect_slab(V from, V along, double half, V& entry, V& exit) {
    const V inverse = splat<V>(1.0) / along;
    const V lower = (splat<V>(-half) - from) * inverse, upper = (splat<V>(half) - from) * inverse;
    // NaN, on the boundary and along it, restricts nothing.
    entry = larger(smaller(lower, upper), entry);
    exit = smaller(larger(lower, upper), exit);
}

/// Where lines enter a shape, which is convex. The point at a depth t is origin + t direction.
template <Shape S>
CLOTH_INLINE Entry entry_into(Vec3<V> o, Vec3<V> d, Vec3<double> size) {
    const V none{};
    if constexpr (S == Shape::plane) {
        return {d.z < none, o.z / -d.z};
    } else if constexpr (S == Shape::sphere) {
        return smaller_root(norm2(d), dot(o, d), norm2(o) - splat<V>(size.x * size.x));
    } else if constexpr (S == Shape::box) {
        const V infinity = splat<V>(std::numeric_limits<double>::infinity());
        V entry = -infinity, exit = infinity;
        intersect_slab(o.x, d.x, 0.5 * size.x, entry, exit);
        intersect_slab(o.y, d.y, 0.5 * size.y, entry, exit);
        intersect_slab(o.z, d.z, 0.5 * size.z, entry, exit);
        return {entry <= exit, entry};
    } else {
        const V half = splat<V>(0.5 * size.y), radius2 = splat<V>(size.x * size.x);
        const V across = d.x * d.x + d.y * d.y;
        Entry side = smaller_root(across, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius2);
        side.hit &= (across > none) & (absolute(o.z + side.depth * d.z) <= half);
        if constexpr (S == Shape::capsule) {
            const auto cap = [&](V end) CLOTH_INLINED {
                const Vec3<V> from{o.x, o.y, o.z - end};
                return smaller_root(norm2(d), dot(from, d), norm2(from) - radius2);
            };
            return earlier(side, earlier(cap(half), cap(-half)));
        } else {
            const V depth = (select(d.z < none, half, -half) - o.z) / d.z;
            const V x = o.x + depth * d.x, y = o.y + depth * d.y;
            const Entry end{(d.z < none) | (d.z > none), depth};
            return earlier(side, {end.hit & (x * x + y * y <= radius2), depth});
        }
    }
}

/// Pixels that a ball about a point of the camera's frame may cover.
inline Window ball_window(const Pinhole& camera, Vec3<double> centre, double radius) {
    const double nearest = centre.z - radius, farthest = centre.z + radius;
    if (farthest < min_depth) return {0, -1, 0, -1};
    if (!(nearest > min_depth)) return {0, camera.width - 1, 0, camera.height - 1};
    const auto low = [&](double a) { return (a - radius) / (a > radius ? farthest : nearest); };
    const auto high = [&](double a) { return (a + radius) / (a < -radius ? farthest : nearest); };
    return window(camera, fma(camera.fx, low(centre.x), camera.cx) - 1.0,
                  fma(camera.fx, high(centre.x), camera.cx) + 1.0, fma(camera.fy, low(centre.y), camera.cy) - 1.0,
                  fma(camera.fy, high(centre.y), camera.cy) + 1.0);
}

/// Draw a shape that is no mesh. Rays enter a shape that contains the camera behind it, so it is not drawn.
inline void draw_solid(ZBuffer& buffer, const Placement& placement, Shape shape, Vec3<double> size, double radius,
                       std::uint16_t label) {
    const double* const t = placement.translation;
    const Vec3<double> origin = placement.rotate_back(Vec3<double>{-t[0], -t[1], -t[2]});
    const Pinhole& camera = buffer.camera;
    const Window pixels = ball_window(camera, {t[0], t[1], t[2]}, radius);
    contact::with_shape(shape, [&](auto constant) {
        constexpr Shape S = constant;
        if constexpr (S != Shape::mesh) {
            const Vec3<V> o{splat<V>(origin.x), splat<V>(origin.y), splat<V>(origin.z)};
            buffer.visit_window(pixels, [&](std::int64_t first, V u, double v, M inside) CLOTH_INLINED {
                const Vec3<V> ray{(u - splat<V>(camera.cx)) / splat<V>(camera.fx),
                                  splat<V>((v - camera.cy) / camera.fy), splat<V>(1.0)};
                const Entry entry = entry_into<S>(o, placement.rotate_back(ray), size);
                const M covered = inside & entry.hit & (entry.depth >= splat<V>(min_depth));
                if (any(covered)) buffer.draw(first, covered, splat<V>(1.0) / entry.depth, label);
            });
        }
    });
}

}  // namespace cloth::camera
