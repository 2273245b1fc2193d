// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// The smooth path of a gripper or an obstacle over one frame, from its present pose and velocity to where it is to be.
#pragma once

#include <cmath>
#include <cstdint>

#include "held.hpp"

namespace cloth {

/// The angle [rad] of the point (x, y), x at least 0 and not both 0, to a few roundings: three times
/// atan(t) = 2 atan(t / (1 + sqrt(1 + t^2))), then the power series, which meets rounding up to tan(pi / 32).
inline double arctangent(double y, double x) {
    const bool swapped = std::abs(y) > x;
    double t = swapped ? x / y : y / x, doubled = 1.0;
    for (int turn = 0; turn < 3; ++turn) {
        t = t / (1.0 + root(1.0 + t * t));
        doubled = 2.0 * doubled;
    }
    const double square = t * t;
    double total = 0.0;
    for (int k = 12; k >= 1; --k) total = square * (1.0 / (2.0 * k + 1.0) - total);
    const double angle = doubled * t * (1.0 - total), quarter = 0.5 * 3.141592653589793;
    if (!swapped) return angle;
    return (y > 0.0 ? quarter : -quarter) - angle;
}

/// Rotation vector [rad] of the shortest turn from one unit quaternion x, y, z, w to another.
inline void rotation_vector(const double* start, const double* end, double* out) {
    // The quaternion product of the end and the conjugate of the start.
    const double ax = end[0], ay = end[1], az = end[2], aw = end[3];
    const double bx = -start[0], by = -start[1], bz = -start[2], bw = start[3];
    double x = aw * bx + ax * bw + ay * bz - az * by, y = aw * by - ax * bz + ay * bw + az * bx;
    double z = aw * bz + ax * by - ay * bx + az * bw, w = aw * bw - ax * bx - ay * by - az * bz;
    if (w < 0.0) {
        x = -x;
        y = -y;
        z = -z;
        w = -w;
    }
    const double sine = root(x * x + y * y + z * z);
    // atan(sine / w) / sine -> 1 as the turn vanishes.
    const double scale = sine > 1e-12 ? 2.0 * arctangent(sine, w) / sine : 2.0;
    out[0] = scale * x;
    out[1] = scale * y;
    out[2] = scale * z;
}

/// The coefficients, 9 numbers, of a cubic that covers the displacement `way` over a duration from a start velocity,
/// and its end velocity `last`. The end velocity is the mean velocity times way . before / |way|^2, held within 0 to 1,
/// where `before` is the last frame's displacement. So a steady stream of targets is followed without ripple, and a
/// jump arrives at rest without overshoot.
inline void cubic_path(const double* way, const double* start, const double* before, double duration, double* cubic,
                       double* last) {
    const double square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2];
    const double shared = way[0] * before[0] + way[1] * before[1] + way[2] * before[2];
    double kept = square > 0.0 ? shared / square : 0.0;
    kept = kept > 0.0 ? kept : 0.0;
    kept = kept < 1.0 ? kept : 1.0;
    for (int i = 0; i < 3; ++i) {
        const double mean = way[i] / duration, first = start[i], end = mean * kept;
        cubic[i] = first;
        cubic[3 + i] = (3.0 * mean - 2.0 * first - end) / duration;
        cubic[6 + i] = (first + end - 2.0 * mean) / (duration * duration);
        last[i] = end;
    }
}

/// The path over one frame, path_numbers, from pose and twist to a target; the twist at its end, 6 numbers; the frame's
/// displacement [m] and turn [rad], 6 numbers. `before` has those of the frame before.
inline void path_to(double t, double duration, const double* pose, const double* twist, const double* before,
                    const double* target, double* path, double* last, double* turn) {
    for (int i = 0; i < 3; ++i) turn[i] = target[i] - pose[i];
    rotation_vector(pose + 3, target + 3, turn + 3);
    path[0] = t;
    for (int i = 0; i < 3; ++i) path[1 + i] = pose[i];
    cubic_path(turn, twist, before, duration, path + 4, last);
    for (int i = 0; i < 4; ++i) path[13 + i] = pose[3 + i];
    cubic_path(turn + 3, twist + 3, before + 3, duration, path + 17, last + 3);
}

}  // namespace cloth
