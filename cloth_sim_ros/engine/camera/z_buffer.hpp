// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Z-buffer of a pinhole camera: inverse depth, which is linear in the image on a plane, and a label a pixel.
//
// Camera frame: x right, y down, z forward. Depth is z. Centres of pixels have integer coordinates u = fx x / z + cx,
// v = fy y / z + cy. The nearest surface has the largest inverse depth; of equal ones the first drawn stays.
#pragma once

#include <cstdint>

#include "core/algebra.hpp"

namespace cloth::camera {

using V = vec<double>;
using M = decltype(V{} < V{});
constexpr int width_of_vector = lanes<double>;
/// Inverse depths and labels of a vector of pixels, and their masks.
typedef float Inverse __attribute__((vector_size(4 * width_of_vector)));
typedef std::int32_t InverseMask __attribute__((vector_size(4 * width_of_vector)));
typedef std::uint16_t Labels __attribute__((vector_size(2 * width_of_vector)));
typedef std::int16_t LabelMask __attribute__((vector_size(2 * width_of_vector)));

/// Surfaces nearer than this do not exist [m].
constexpr double min_depth = 1e-3;

struct Pinhole {
    std::int64_t width, height;
    double fx, fy, cx, cy;
};

/// Rigid motion from a frame to the camera's: rotation matrix by rows, translation [m].
struct Placement {
    double rotation[9], translation[3];

    Vec3<double> apply(Vec3<double> p) const {
        const double* r = rotation;
        const double* t = translation;
        return {fma(r[2], p.z, fma(r[1], p.y, fma(r[0], p.x, t[0]))),
                fma(r[5], p.z, fma(r[4], p.y, fma(r[3], p.x, t[1]))),
                fma(r[8], p.z, fma(r[7], p.y, fma(r[6], p.x, t[2])))};
    }
    /// The inverse rotation of a vector.
    template <class W>
    CLOTH_INLINE Vec3<W> rotate_back(Vec3<W> a) const {
        const auto along = [&](int axis) CLOTH_INLINED {
            const double* r = rotation + axis;
            return fma(splat<W>(r[6]), a.z, fma(splat<W>(r[3]), a.y, splat<W>(r[0]) * a.x));
        };
        return {along(0), along(1), along(2)};
    }
};

/// Pixels of an image that a surface may cover, both ends included; empty if one is before its begin.
struct Window {
    std::int64_t u0, u1, v0, v1;
};

/// The pixels between coordinates that need not lie in the image.
inline Window window(const Pinhole& camera, double u0, double u1, double v0, double v1) {
    const auto clamp = [](double a, std::int64_t count) {
        return static_cast<std::int64_t>(a < -1.0 ? -1.0 : a > double(count) ? double(count) : a);
    };
    // Conversion truncates, so coordinates below 0 give a pixel at most one too early.
    const Window pixels{clamp(u0, camera.width), clamp(u1, camera.width), clamp(v0, camera.height),
                        clamp(v1, camera.height)};
    return {pixels.u0 < 0 ? 0 : pixels.u0, pixels.u1 < camera.width ? pixels.u1 : camera.width - 1,
            pixels.v0 < 0 ? 0 : pixels.v0, pixels.v1 < camera.height ? pixels.v1 : camera.height - 1};
}

/// Images (height, width), followed by a vector of padding.
struct ZBuffer {
    Pinhole camera;
    float* inverse;
    std::uint16_t* labels;

    /// Draw inverse depths w of the pixels from `first` on where a mask is set and nothing nearer is.
    CLOTH_INLINE void draw(std::int64_t first, M covered, V w, std::uint16_t label) {
        Inverse before;
        std::memcpy(&before, inverse + first, sizeof before);
        const Inverse now = __builtin_convertvector(w, Inverse);
        const InverseMask nearer = __builtin_convertvector(covered, InverseMask) & (now > before);
        const Inverse after = nearer ? now : before;
        std::memcpy(inverse + first, &after, sizeof after);
        Labels shown;
        std::memcpy(&shown, labels + first, sizeof shown);
        const LabelMask changed = __builtin_convertvector(nearer, LabelMask);
        shown = changed ? label - Labels{} : shown;
        std::memcpy(labels + first, &shown, sizeof shown);
    }

    /// Call `visit` with the first pixel of each vector in a window, its coordinates u and v, and whether a lane is in
    /// the window.
    template <class F>
    CLOTH_INLINE void visit_window(const Window& pixels, F&& visit) {
        V offset;
        for (int lane = 0; lane < width_of_vector; ++lane) offset[lane] = lane;
        const V end = splat<V>(double(pixels.u1));
        for (std::int64_t v = pixels.v0; v <= pixels.v1; ++v)
            for (std::int64_t u = pixels.u0; u <= pixels.u1; u += width_of_vector) {
                const V columns = offset + splat<V>(double(u));
                visit(v * camera.width + u, columns, double(v), columns <= end);
            }
    }
};

}  // namespace cloth::camera
