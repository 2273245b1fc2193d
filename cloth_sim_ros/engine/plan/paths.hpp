// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Smooth path of a gripper or an obstacle over one frame, from its pose and velocity to its target.
#pragma once

#include <cmath>
#include <cstdint>

#include "plan/grips.hpp"

namespace cloth::plan {

/// Angle [rad] of the point (x, y), x >= 0 and not both 0, to a few roundings: three times atan(t) = 2 atan(t / (1 +
/// sqrt(1 + t^2))), then the power series, accurate to rounding up to tan(pi / 32).
inline double arctangent(double y, double x) {
    const bool swapped = std::abs(y) > x;
    double t = swapped ? x / y : y / x, doubled = 1.0;
    for (int halving = 0; halving < 3; ++halving) {
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

/// Rotation vector [rad] of the shortest rotation from one unit quaternion x, y, z, w to another.
inline void rotation_vector(const double* start, const double* end, double* out) {
    // Quaternion product of the end and the conjugate of the start.
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
    // atan(sine / w) / sine -> 1 for vanishing rotation.
    const double scale = sine > 1e-12 ? 2.0 * arctangent(sine, w) / sine : 2.0;
    out[0] = scale * x;
    out[1] = scale * y;
    out[2] = scale * z;
}

/// Coefficients, 9 numbers, of a cubic over a displacement and a duration from a start velocity, and its end velocity.
/// The end velocity is the mean velocity times displacement . previous / |displacement|^2, clamped to 0 to 1, where
/// `previous` is the displacement of the last frame. Therefore a steady stream of targets is followed without ripple,
/// and a jump ends at rest without overshoot.
inline void cubic_path(const double* displacement, const double* start, const double* previous, double duration,
                       double* cubic, double* end_velocity) {
    const double square =
        displacement[0] * displacement[0] + displacement[1] * displacement[1] + displacement[2] * displacement[2];
    const double product =
        displacement[0] * previous[0] + displacement[1] * previous[1] + displacement[2] * previous[2];
    double velocity_ratio = square > 0.0 ? product / square : 0.0;
    velocity_ratio = velocity_ratio > 0.0 ? velocity_ratio : 0.0;
    velocity_ratio = velocity_ratio < 1.0 ? velocity_ratio : 1.0;
    for (int i = 0; i < 3; ++i) {
        const double mean = displacement[i] / duration, first = start[i], end = mean * velocity_ratio;
        cubic[i] = first;
        cubic[3 + i] = (3.0 * mean - 2.0 * first - end) / duration;
        cubic[6 + i] = (first + end - 2.0 * mean) / (duration * duration);
        end_velocity[i] = end;
    }
}

/// Path over one frame, path_numbers, from pose and twist to a target; twist at its end, 6 numbers; displacement [m]
/// and rotation [rad] of the frame, 6 numbers. `previous`: those of the frame before.
inline void path_to(double t, double duration, const double* pose, const double* twist, const double* previous,
                    const double* target, double* path, double* end_twist, double* motion) {
    for (int i = 0; i < 3; ++i) motion[i] = target[i] - pose[i];
    rotation_vector(pose + 3, target + 3, motion + 3);
    path[0] = t;
    for (int i = 0; i < 3; ++i) path[1 + i] = pose[i];
    cubic_path(motion, twist, previous, duration, path + 4, end_twist);
    for (int i = 0; i < 4; ++i) path[13 + i] = pose[3 + i];
    cubic_path(motion + 3, twist + 3, previous + 3, duration, path + 17, end_twist + 3);
}

}  // namespace cloth::plan
