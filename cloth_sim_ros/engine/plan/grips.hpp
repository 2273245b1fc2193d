// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Grasped particles: joints (S4) between particles and points that move and rotate with the grippers, and particles
// whose motion is prescribed by these points (docs/derivations/prescribed_grip.md).
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

template <class S>
struct PoseOf {
    Vec3<S> position, velocity, rotation[3], spin;
};
using Pose = PoseOf<double>;

/// sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 by their power series in a^2, accurate to rounding up to a = 2 pi.
template <class S>
struct RotationFactors {
    S first, second, third;
    explicit RotationFactors(S square) {
        const auto constant = [](double a) { return splat<S>(a); };
        const S one = constant(1.0);
        // Without rotation the series give the same bits. Most grippers do not rotate, and every step needs every pose,
        // so an early return saves time.
        first = one, second = constant(0.5), third = constant(1.0 / 6.0);
        if (value_of(square) == 0.0) return;
        // Horner scheme: 1/(2k+1)!, 1/(2k+2)! and 1/(2k+3)! with alternating signs.
        for (int k = 24; k >= 1; --k) {
            first = one - square / constant((2.0 * k) * (2.0 * k + 1.0)) * (k == 24 ? one : first);
            second = one - square / constant((2.0 * k + 1.0) * (2.0 * k + 2.0)) * (k == 24 ? one : second);
            third = one - square / constant((2.0 * k + 2.0) * (2.0 * k + 3.0)) * (k == 24 ? one : third);
        }
        second = second * constant(0.5);
        third = third / constant(6.0);
    }
};

/// Pose on a path. A time that carries the slope 1 also yields the acceleration and the angular acceleration.
template <class S>
inline PoseOf<S> pose_at(const double* path, S t) {
    PoseOf<S> pose;
    const auto constant = [](double a) { return splat<S>(a); };
    const S s = t - constant(path[0]);
    const auto at = [&](int first) {
        return Vec3<S>{constant(path[first]), constant(path[first + 1]), constant(path[first + 2])};
    };
    const auto cubic = [&](Vec3<S> a, Vec3<S> b, Vec3<S> c) { return s * (a + s * (b + s * c)); };
    const auto slope = [&](Vec3<S> a, Vec3<S> b, Vec3<S> c) {
        return a + s * (constant(2.0) * b + (constant(3.0) * s) * c);
    };
    pose.position = at(1) + cubic(at(4), at(7), at(10));
    pose.velocity = slope(at(4), at(7), at(10));
    const Vec3<S> r = cubic(at(17), at(20), at(23)), rotation_rate = slope(at(17), at(20), at(23));
    const RotationFactors<S> f(norm2(r));
    const double x = path[13], y = path[14], z = path[15], w = path[16];
    const auto column = [&](double a, double b, double c) { return Vec3<S>{constant(a), constant(b), constant(c)}; };
    // Columns of the initial orientation, each rotated by Rodrigues' formula.
    const Vec3<S> start[3] = {column(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)),
                              column(2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)),
                              column(2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y))};
    for (int j = 0; j < 3; ++j) {
        const Vec3<S> perpendicular = cross(r, start[j]);
        pose.rotation[j] = start[j] + f.first * perpendicular + f.second * cross(r, perpendicular);
    }
    // Angular velocity: left Jacobian of the rotation group times dr/dt.
    const Vec3<S> perpendicular = cross(r, rotation_rate);
    pose.spin = rotation_rate + f.second * perpendicular + f.third * cross(r, perpendicular);
    return pose;
}

/// Grips of particles; particles ascend, and grips of one particle keep the caller's order.
struct Grips {
    std::int64_t grippers = 0;
    std::vector<std::int64_t> particle, gripper;
    std::vector<Vec3<double>> offset;
    std::vector<double> stiffness, damping, paths;
    /// Whether the motion of the particle is prescribed. Such a grip exerts no spring force.
    std::vector<char> prescribed;
    bool has_prescribed = false;
    /// Velocity of each prescribed particle before the present frame.
    std::vector<Vec3<double>> velocity_before;

    std::int64_t count() const { return static_cast<std::int64_t>(particle.size()); }

    template <class S>
    struct PointOf {
        Vec3<S> arm, position, velocity;
    };
    using Point = PointOf<double>;
    template <class S>
    PointOf<S> point(const PoseOf<S>& pose, std::int64_t grip) const {
        const Vec3<S> o{splat<S>(offset[grip].x), splat<S>(offset[grip].y), splat<S>(offset[grip].z)};
        PointOf<S> p;
        p.arm = o.x * pose.rotation[0] + o.y * pose.rotation[1] + o.z * pose.rotation[2];
        p.position = pose.position + p.arm;
        p.velocity = pose.velocity + cross(pose.spin, p.arm);
        return p;
    }
    const double* path_of(std::int64_t grip) const { return paths.data() + gripper[grip] * path_numbers; }
    Point point_at(std::int64_t grip, double t) const { return point(pose_at(path_of(grip), t), grip); }
    /// Call visit(grip, its point at a time) for each prescribed particle.
    template <class F>
    void for_each_prescribed(double t, F&& visit) const {
        for (std::int64_t grip = 0; has_prescribed && grip < count(); ++grip)
            if (prescribed[grip]) visit(grip, point_at(grip, t));
    }
    /// Set positions and velocities (3, n) of the prescribed particles at a time.
    void prescribe(double t, std::int64_t n, double* x, double* v) const {
        for_each_prescribed(t, [&](std::int64_t grip, const Point& p) {
            double *const x_ = x + particle[grip], *const v_ = v + particle[grip];
            x_[0] = p.position.x, x_[n] = p.position.y, x_[2 * n] = p.position.z;
            v_[0] = p.velocity.x, v_[n] = p.velocity.y, v_[2 * n] = p.velocity.z;
        });
    }
    /// Accumulate the impulse of the other forces f on a prescribed particle over dt, and the part of its inertia that
    /// `accumulate_inertia` leaves to the steps.
    void accumulate_prescribed(double* sums, const Pose& pose, const Point& point, Vec3<double> f, double mass,
                               double dt) const {
        const Vec3<double> torque = cross(point.arm, f) + mass * cross(cross(pose.spin, point.arm), pose.velocity);
        const double rates[record_numbers] = {f.x, f.y, f.z, torque.x, torque.y, torque.z, -dot(f, point.velocity),
                                              0.0};
        for (int i = 0; i < record_numbers; ++i) sums[i] += dt * rates[i];
    }
    /// Accumulate the inertia of a prescribed particle from one point to a later one, and the inelastic impulse that
    /// gives it the velocity of the first point.
    void accumulate_inertia(double* sums, std::int64_t grip, const Point& from, const Point& to, double mass) const {
        const Vec3<double> before = velocity_before[grip], jump = from.velocity - before,
                           momentum = mass * (to.velocity - before),
                           angular = mass * (cross(to.arm, to.velocity) - cross(from.arm, before));
        const double work = mass * (0.5 * (norm2(to.velocity) - norm2(from.velocity)) + dot(jump, from.velocity));
        const double record[record_numbers] = {-momentum.x, -momentum.y, -momentum.z, -angular.x,
                                               -angular.y,  -angular.z,  work,        0.5 * mass * norm2(jump)};
        for (int i = 0; i < record_numbers; ++i) sums[i] += record[i];
    }
    /// Accumulate the inelastic impulse that gives the air at a prescribed particle, of a mass block, the velocity of its
    /// first point.
    void accumulate_air_jump(double* sums, std::int64_t grip, const Point& from, const Sym3<double>& block) const {
        const Vec3<double> jump = from.velocity - velocity_before[grip], impulse = product(block, jump),
                           angular = cross(from.arm, impulse);
        const double record[record_numbers] = {-impulse.x,
                                               -impulse.y,
                                               -impulse.z,
                                               -angular.x,
                                               -angular.y,
                                               -angular.z,
                                               dot(impulse, from.velocity),
                                               0.5 * dot(impulse, jump)};
        for (int i = 0; i < record_numbers; ++i) sums[i] += record[i];
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

/// Poses on paths at the steps of a run, for one thread. The last ones are cached; a sweep has fewer steps.
class PoseCache {
public:
    static constexpr std::int64_t capacity = 8;

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
