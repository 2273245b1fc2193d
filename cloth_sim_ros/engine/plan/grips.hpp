// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Grasped particles: joints (S4) between particles and points that move and rotate with the grippers.
#pragma once

#include "core/algebra.hpp"
#include "core/storage.hpp"

namespace cloth::plan {

/// Numbers of a path: start time t0; position p0 + p1 s + p2 s^2 + p3 s^3, s = t - t0; orientation x, y, z, w at s = 0;
/// rotation vector r1 s + r2 s^2 + r3 s^3 from there.
inline constexpr int path_numbers = 26;
/// Record of a gripper: force and torque of the cloth about its pose, work on the cloth, and dissipation of its joints,
/// as time integrals.
inline constexpr int record_numbers = 8;

struct Pose {
    Vec3<double> position, velocity, rotation[3], spin;
};

/// sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 by their power series in a^2, accurate to rounding up to a = 2 pi.
struct RotationFactors {
    double first, second, third;
    explicit RotationFactors(double square) {
        // Without rotation the series give the same bits. Most grippers do not rotate, and every step needs every pose,
        // so an early return saves time.
        first = 1.0, second = 0.5, third = 1.0 / 6.0;
        if (square == 0.0) return;
        // Horner scheme: 1/(2k+1)!, 1/(2k+2)! and 1/(2k+3)! with alternating signs.
        for (int k = 24; k >= 1; --k) {
            first = 1.0 - square / ((2.0 * k) * (2.0 * k + 1.0)) * (k == 24 ? 1.0 : first);
            second = 1.0 - square / ((2.0 * k + 1.0) * (2.0 * k + 2.0)) * (k == 24 ? 1.0 : second);
            third = 1.0 - square / ((2.0 * k + 2.0) * (2.0 * k + 3.0)) * (k == 24 ? 1.0 : third);
        }
        second *= 0.5;
        third /= 6.0;
    }
};

inline Pose pose_at(const double* path, double t) {
    Pose pose;
    const double s = t - path[0];
    const auto at = [&](int first) { return Vec3<double>{path[first], path[first + 1], path[first + 2]}; };
    const auto cubic = [&](Vec3<double> a, Vec3<double> b, Vec3<double> c) { return s * (a + s * (b + s * c)); };
    const auto slope = [&](Vec3<double> a, Vec3<double> b, Vec3<double> c) {
        return a + s * (2.0 * b + (3.0 * s) * c);
    };
    pose.position = at(1) + cubic(at(4), at(7), at(10));
    pose.velocity = slope(at(4), at(7), at(10));
    const Vec3<double> r = cubic(at(17), at(20), at(23)), rotation_rate = slope(at(17), at(20), at(23));
    const RotationFactors f(norm2(r));
    const double x = path[13], y = path[14], z = path[15], w = path[16];
    // Columns of the initial orientation, each rotated by Rodrigues' formula.
    const Vec3<double> start[3] = {{1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)},
                                   {2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)},
                                   {2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)}};
    for (int j = 0; j < 3; ++j) {
        const Vec3<double> perpendicular = cross(r, start[j]);
        pose.rotation[j] = start[j] + f.first * perpendicular + f.second * cross(r, perpendicular);
    }
    // Angular velocity: left Jacobian of the rotation group times dr/dt.
    const Vec3<double> perpendicular = cross(r, rotation_rate);
    pose.spin = rotation_rate + f.second * perpendicular + f.third * cross(r, perpendicular);
    return pose;
}

/// Grips of particles; particles ascend, and grips of one particle keep the caller's order.
struct Grips {
    std::int64_t grippers = 0;
    std::vector<std::int64_t> particle, gripper;
    std::vector<Vec3<double>> offset;
    std::vector<double> stiffness, damping, paths;

    std::int64_t count() const { return static_cast<std::int64_t>(particle.size()); }

    struct Point {
        Vec3<double> arm, position, velocity;
    };
    Point point(const Pose& pose, std::int64_t grip) const {
        const Vec3<double> o = offset[grip];
        Point p;
        p.arm = o.x * pose.rotation[0] + o.y * pose.rotation[1] + o.z * pose.rotation[2];
        p.position = pose.position + p.arm;
        p.velocity = pose.velocity + cross(pose.spin, p.arm);
        return p;
    }
    /// Force on the particle of a grip [N].
    Vec3<double> force(std::int64_t grip, const Point& point, Vec3<double> x, Vec3<double> v) const;
    /// Accumulate the record of the force on a grip's particle over dt.
    void accumulate(double* sums, std::int64_t grip, const Point& point, Vec3<double> f, Vec3<double> v,
                    double dt) const {
        const Vec3<double> reaction = -f, torque = cross(point.arm, reaction), slip = v - point.velocity;
        const double rates[record_numbers] = {reaction.x,
                                              reaction.y,
                                              reaction.z,
                                              torque.x,
                                              torque.y,
                                              torque.z,
                                              dot(f, point.velocity),
                                              damping[grip] * norm2(slip)};
        for (int i = 0; i < record_numbers; ++i) sums[i] += dt * rates[i];
    }
};

/// Poses on paths at the steps of a run, for one thread. The last ones are cached; a sweep has no more steps.
class PoseCache {
public:
    static constexpr std::int64_t capacity = 4;

    PoseCache(const std::vector<double>& paths, double t, double step)
        : paths_(paths), t_(t), step_(step), entries_(capacity * (paths.size() / path_numbers)) {}
    /// At the middle of a step, or at the start of the run for step -1.
    const Pose& at(std::int64_t path, std::int64_t step) {
        Entry& entry = entries_[capacity * path + (step + 1) % capacity];
        if (entry.step != step) {
            const double t = step < 0 ? t_ : t_ + (step + 0.5) * step_;
            entry = {pose_at(paths_.data() + path * path_numbers, t), step};
        }
        return entry.pose;
    }

private:
    struct Entry {
        Pose pose;
        std::int64_t step = -2;
    };
    const std::vector<double>& paths_;
    double t_, step_;
    std::vector<Entry> entries_;
};

}  // namespace cloth::plan
