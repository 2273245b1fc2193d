// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of depth images. `camera.py` checks shapes and types; this file checks indices.

#include "api/guard.hpp"
#include "camera/solids.hpp"
#include "camera/triangles.hpp"

namespace cloth::api {
namespace {

camera::ZBuffer buffer_of(std::int64_t width, std::int64_t height, const double* intrinsics, float* inverse,
                          std::uint16_t* labels) {
    return {{width, height, intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]}, inverse, labels};
}
camera::Placement placement_of(const double* numbers) {
    camera::Placement placement;
    std::memcpy(&placement, numbers, sizeof placement);
    return placement;
}

}  // namespace

CLOTH_API int cloth_draw_triangles(std::int64_t width, std::int64_t height, const double* intrinsics,
                                   const double* placement, std::int64_t n, const double* x, std::int64_t count,
                                   const std::int64_t* corners, std::int64_t solid, std::int64_t label, float* inverse,
                                   std::uint16_t* labels) {
    for (std::int64_t k = 0; k < 3 * count; ++k)
        if (corners[k] < 0 || corners[k] >= n) return failed;
    return guarded([&] {
        camera::ZBuffer buffer = buffer_of(width, height, intrinsics, inverse, labels);
        camera::draw_triangles(buffer, placement_of(placement), n, x, count, corners, solid != 0,
                               static_cast<std::uint16_t>(label));
    });
}

CLOTH_API int cloth_draw_solid(std::int64_t width, std::int64_t height, const double* intrinsics,
                               const double* placement, std::int64_t shape, const double* size, double radius,
                               std::int64_t label, float* inverse, std::uint16_t* labels) {
    return guarded([&] {
        camera::ZBuffer buffer = buffer_of(width, height, intrinsics, inverse, labels);
        camera::draw_solid(buffer, placement_of(placement), static_cast<contact::Shape>(shape),
                           {size[0], size[1], size[2]}, radius, static_cast<std::uint16_t>(label));
    });
}

}  // namespace cloth::api
