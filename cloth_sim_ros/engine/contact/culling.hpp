// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Culling of obstacles, of their features and of self-contact in a frame.
#pragma once

#include "plan/plan.hpp"

namespace cloth::contact {

using plan::MotionRecord, plan::Plan;

/// Largest speed of the particles, anchored ones included.
inline double max_speed(const double* v, std::int64_t n) {
    using V = vec<double>;
    V max_square{};
    double square = 0.0;
    std::int64_t i = 0;
    for (; i + lanes<double> <= n; i += lanes<double>)
        max_square = larger(norm2(Vec3<V>{load(v + i), load(v + n + i), load(v + 2 * n + i)}), max_square);
    for (; i < n; ++i) square = larger(norm2(Vec3<double>{v[i], v[n + i], v[2 * n + i]}), square);
    for (int k = 0; k < lanes<double>; ++k) square = larger<double>(max_square[k], square);
    return root(square);
}

/// Ball that contains all particles, anchored ones included.
struct BoundingBall {
    Vec3<double> center;
    double radius;
    bool finite = true;  ///< whether all positions are finite

    BoundingBall(const double* x, std::int64_t n) {
        double low[3], high[3];
        for (int c = 0; c < 3; ++c) {
            low[c] = high[c] = x[c * n];
            range(x + c * n, n, low[c], high[c]);
        }
        const Vec3<double> lower{low[0], low[1], low[2]}, upper{high[0], high[1], high[2]};
        center = 0.5 * (lower + upper);
        radius = 0.5 * root(norm2(upper - lower));
    }
    /// Lower bound of the distance of all particles from an obstacle [m]; `rounding_margin` bounds its rounding error.
    double distance_to(const Obstacle& obstacle, const PosedObstacle<double>& posed) const {
        const Vec3<double> offset = center - posed.position;
        if (obstacle.shape == Shape::plane) return dot(posed.rotation[2], offset) - radius;
        return root(norm2(offset)) - radius - obstacle.radius;
    }
    /// Whether all particles surely are further than a distance [m] from an obstacle on its path until time t. False for
    /// planes, jaws, and positions that are not finite. No pose is computed.
    bool is_away(const Contacts& contacts, std::int64_t obstacle, double t, double distance) const {
        const Obstacle& properties = contacts.obstacles[obstacle];
        if (!finite || properties.shape == Shape::plane || contacts.jaw_of(obstacle)) return false;
        const double* const path = contacts.path(obstacle);
        const Vec3<double> start{path[1], path[2], path[3]};
        const double length = max_path_motion(path, 0.0, absolute(t - path[0])).length;
        return root(norm2(center - start)) - radius - properties.radius - length > 1.001 * distance;
    }
    double rounding_margin(const PosedObstacle<double>& posed) const {
        return 64.0 * std::numeric_limits<double>::epsilon() *
               (root(norm2(center)) + root(norm2(posed.position)) + radius);
    }
    /// Upper bound of the speed relative to an obstacle, of particles no faster than `fastest`.
    double max_relative_speed(double fastest, const PosedObstacle<double>& posed) const {
        return fastest + root(norm2(posed.velocity)) +
               root(norm2(posed.spin)) * (root(norm2(center - posed.position)) + radius);
    }

private:
    void range(const double* from, std::int64_t n, double& min, double& max) {
        using V = vec<double>;
        V low = splat<V>(min), high = splat<V>(max), nan_check{};
        double finite_check = 0.0;
        std::int64_t i = 0;
        for (; i + lanes<double> <= n; i += lanes<double>) {
            const V a = load(from + i);
            low = smaller(a, low);
            high = larger(a, high);
            nan_check = nan_check + (a - a);
        }
        for (; i < n; ++i) {
            min = smaller(from[i], min), max = larger(from[i], max);
            finite_check += from[i] - from[i];
        }
        for (int k = 0; k < lanes<double>; ++k) finite_check += nan_check[k];
        finite = finite && finite_check == 0.0;
        for (int k = 0; k < lanes<double>; ++k) min = smaller<double>(low[k], min), max = larger<double>(high[k], max);
    }
};

/// Excludes obstacles that no particle can reach from the runs of a frame. Such an obstacle is more than four times as
/// far away as the fastest particle, with `speed_margin` added, moves in the frame. If a particle is faster than twice
/// that in any step of a run, or a skipped block moved faster than assumed (see ContactSummary), all runs of the frame
/// are repeated with all obstacles.
class ObstacleCulling {
public:
    ObstacleCulling(Plan& plan, double t, double duration, const double* x0, const double* v0) : plan_(plan) {
        Contacts& contacts = plan.contacts;
        contacts.active.clear();
        contacts.may_skip_blocks = true;
        if (!contacts.count()) return;
        const BoundingBall cloth(x0, plan.count);
        const Vec3<double> center = cloth.center;
        const double radius = cloth.radius;
        speed_limit_ = max_speed(v0, plan.count) + speed_margin;
        for (std::int64_t k = 0; k < contacts.count(); ++k) {
            if (!contacts.present(k)) continue;
            const double* const path = contacts.path(k);
            // From the path's start, because no pose at time t is computed.
            const auto [path_length, path_angle] = max_path_motion(path, 0.0, t - path[0] + duration);
            const Obstacle& obstacle = contacts.obstacles[k];
            double distance;
            if (obstacle.shape == Shape::plane) {
                const Pose pose = pose_at(path, path[0]);
                distance = path_angle > 0.0 ? 0.0 : dot(pose.rotation[2], center - pose.position) - radius;
            } else {
                distance = root(norm2(center - Vec3<double>{path[1], path[2], path[3]})) - radius - obstacle.radius;
            }
            if (!(distance - path_length - contacts.thickness > 4.0 * speed_limit_ * duration))
                contacts.active.push_back(k);
        }
        std::int64_t present = 0;
        for (std::int64_t k = 0; k < contacts.count(); ++k) present += contacts.present(k);
        covers_all_ = static_cast<std::int64_t>(contacts.active.size()) == present;
    }
    /// Whether runs leave anything out.
    bool is_active() const { return plan_.contacts.count() && (plan_.contacts.may_skip_blocks || !covers_all_); }
    /// Whether a run with end velocities v, this summary and this motion violates the assumptions.
    bool is_violated(const double* v, const double* summary, const MotionRecord& motion) const {
        if (!is_active()) return false;
        return summary[ContactSummary::violation] != 0.0 ||
               (!covers_all_ && !(larger(motion.max_speed(), max_speed(v, plan_.count)) <= 2.0 * speed_limit_));
    }
    void disable() {
        plan_.contacts.activate_all();
        plan_.contacts.may_skip_blocks = false;
        covers_all_ = true;
    }

private:
    /// Margin of the largest speed at the start of a frame [m/s], because a cloth at rest may be set in motion.
    static constexpr double speed_margin = 0.5;

    Plan& plan_;
    double speed_limit_ = 0.0;
    bool covers_all_ = true;
};

/// Excludes self-contact from a frame in which no part of the cloth comes near another, by one of two tests.
///
/// A regular sheet must stay separated from itself (`SelfContact::stays_separated`) after the start of the frame. In
/// each run, no two particles may leave the paths of their velocities at the start by more than the margin of that.
/// Otherwise the sheet must have been separated on its path to the end (`SelfContact::stayed_separated`), by the bounds
/// of all particles together, or by the path of each. If the record of a run does not show it, the run is repeated with
/// the other record, so that no result depends on which of them was the first.
///
/// Where that is not clear at the start, no pair may be nearer than the thickness and the distance covered at twice the
/// largest relative speed, plus a margin. No step of a run may have a larger relative speed.
///
/// Otherwise all runs of the frame are repeated with self-contact. Cached pairs make no difference, so no bit depends
/// on them.
class SelfCulling {
public:
    SelfCulling(Plan& plan, double duration, const double* x0, const double* v0);
    bool is_active() const { return plan_.self_culled; }
    /// Whether the first test applies; and whether runs then record the path of each particle, else bounds of all.
    bool is_separated() const { return is_separated_; }
    bool records_paths() const;
    /// Whether a run with positions x and velocities v at its end, and this motion, violates the assumptions.
    bool is_violated(const double* x, const double* v, MotionRecord& motion) const;
    /// Whether the other record may show that a run does not violate them.
    bool needs_other_record() const;
    /// Let the next frames record paths, or bounds.
    void set_record(bool has_paths) const;
    void disable() { plan_.self_culled = false; }

private:
    Plan& plan_;
    const double* x0_;
    double duration_, speed_limit_ = 0.0;
    bool is_separated_ = false;
};

/// Let the next runs evaluate contact of all features; of none.
void activate_features(Plan& plan);
void deactivate_features(Plan& plan);

/// Excludes features of obstacles that stay away from the cloth from a frame. If a step of a run has a larger speed than
/// assumed, all runs of the frame are repeated with all features.
class FeatureCulling {
public:
    FeatureCulling(Plan& plan, double t, double duration, const double* x0, const double* v0);
    bool is_active() const { return plan_.features && !covers_all_; }
    /// Whether a run with end velocities v and this motion violates the assumptions.
    bool is_violated(const double* v, const MotionRecord& motion) const {
        return is_active() && !(larger(motion.max_speed(), max_particle_speed(v)) <= speed_limit_);
    }
    void disable() {
        activate_features(plan_);
        covers_all_ = true;
    }

private:
    /// Speed that particles may gain [m/s].
    static constexpr double speed_margin = 0.25;

    double max_particle_speed(const double* v) const;
    Plan& plan_;
    double speed_limit_ = 0.0;
    bool covers_all_ = true;
};

}  // namespace cloth::contact
