// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact of points and edges of obstacles with the cloth over a run.
#pragma once

#include "contact/features.hpp"
#include "contact/jaw_run.hpp"

namespace cloth::contact {

using plan::record_numbers;

/// Call `visit` with each contact of an obstacle's features in its Verlet lists. If `bound` is given, add pairs that
/// come into contact within `duration` [s] to it. `at` and `velocity` have the points of the obstacle.
template <class V, class X, class U, class F>
inline void for_each_feature_contact(const Surface& s, const FeatureVerletList& neighbors, const FeaturesAt& from,
                                     const SurfaceLaw<V>& law, X&& at, U&& velocity, Contact<V>& m, F&& visit,
                                     FeatureStiffnessBound* bound = nullptr, double duration = 0.0) {
    const auto add_approaching = [&](int corners, const Index* corner, const double* weight, double distance,
                                     double speed) {
        const Scaling<double> scaling = law.scaling(~0);
        const double gap = distance - law.radius();
        bound->add_approaching(s, corners, corner, weight, scaling.gap(gap) - law.thickness(false),
                               scaling.closing(gap, speed), duration);
    };
    const auto point = [&](Index k, const Index* begin, const Index* end, double) {
        law.particle(s, ~k, begin, end, at, velocity, m);
        if (!m.gaps.empty()) visit(m);
        if constexpr (std::is_same_v<V, double>)
            for (const Index* triangle = begin; bound && triangle != end; ++triangle) {
                const auto& t = s.triangles[*triangle];
                const auto n = near_triangle(at(~k), at(t[0]), at(t[1]), at(t[2]));
                const double away = root(n.square);
                const Vec3<double> slip = n.weight[0] * velocity(t[0]) + n.weight[1] * velocity(t[1]) +
                                          n.weight[2] * velocity(t[2]) - velocity(~k);
                add_approaching(3, t.data(), n.weight, away, dot(n.away, slip) / away);
            }
    };
    for_each_particle(neighbors.triangles, neighbors.triangles.square, std::numeric_limits<double>::infinity(), point);
    for (std::size_t pair = 0; pair < neighbors.edges.size(); ++pair) {
        const auto c = feature_corners<true>(s, from.features, neighbors.edges, pair);
        law.edges(s, {c[0], c[1]}, {c[2], c[3]}, at, velocity, m);
        if (!m.gaps.empty()) visit(m);
        if constexpr (std::is_same_v<V, double>) {
            if (!bound || !m.gaps.empty()) continue;
            const auto n = near_segments(at(c[0]), at(c[1]), at(c[2]), at(c[3]));
            const double away = root(n.square), weight[2] = {1.0 - n.first, n.first};
            const Vec3<double> u = velocity(c[2]), w = velocity(c[3]);
            const Vec3<double> slip = weight[0] * velocity(c[0]) + weight[1] * velocity(c[1]) - u - n.second * (w - u);
            add_approaching(2, c.data(), weight, away, -dot(n.away, slip) / away);
        }
    }
}

/// Features over a run, on one thread.
class FeatureRun {
public:
    FeatureRun(FeatureContactModel& contact, const Contacts& contacts, const Run& run)
        : contact_(contact), neighbors_(contact.neighbors(run.workspace)), contacts_(contacts), run_(run),
          law_(contact.law(contacts)), bound_(contact.mass),
          sums_(run.record_obstacles ? contacts.count() * record_numbers : 0, 0.0) {
        poses_.resize(contact.obstacles.size());
    }

    /// Set the jaws, which move with the run.
    void set_jaws(JawRun& jaws) { jaws_ = &jaws; }
    /// Add the forces at a step, for positions x and velocities v, to f, all quads.
    void add(std::int64_t step, const double* x, const double* v, double* f) {
        const double t = midpoint_time(run_, step);
        const Quads at{x}, velocity{v};
        measure_motion(x);
        for (std::int64_t k = 0; k < contacts_.count(); ++k) {
            if (!contact_.is_active[k]) continue;
            const Pose path_pose = pose_at(contacts_.path(k), t), pose = obstacle_pose(k, path_pose);
            if (!update_neighbors(k, x, pose)) return;
            const FeaturesAt from{contact_.obstacles[k], pose, pose.position - path_pose.position};
            bound_.set_obstacle(contacts_, k);
            law_.set_obstacle(from.features.radius, contacts_.feature_scaling(k, contact_.surface.count, t));
            JawRun::JawLoad jaw_load;
            double* const sums = run_.record_obstacles && step >= 0 ? sums_.data() + k * record_numbers : nullptr;
            const auto add_force = [&](Index c, Vec3<double> force) {
                if (c >= 0) {
                    f[4 * c] += force.x, f[4 * c + 1] += force.y, f[4 * c + 2] += force.z;
                    return;
                }
                jaw_load.force += contacts_.obstacles[k].jaw_side * dot(pose.rotation[1], force);
                if (sums) accumulate(sums, from, ~c, force, 1.0);
            };
            const auto add_contact = [&](const Contact<double>& m) {
                bound_.include(contact_.surface, m);
                law_.forces(m, add_force);
                if (sums) sums[record_numbers - 1] += law_.dissipation(m);
                if (sums) growth_work_ += run_.step * law_.growth_power(m);
            };
            for_each_feature_contact<double>(contact_.surface, neighbors_[k], from, law_,
                                             with_point_positions(from, at), with_point_velocities(from, velocity),
                                             feature_contact_, add_contact, &bound_, 2.0 * run_.step);
            if (contacts_.jaw_of(k)) jaws_->record_surface_load(k, step, jaw_load);
        }
        bound_.flush();
        positions_.assign(x, x + 4 * contact_.surface.count);
    }
    /// Finish the run. Return false if something may have intersected in the last step.
    bool finish(const double* x) {
        measure_motion(x);
        for (std::int64_t k = 0; k < contacts_.count() && !intersected_; ++k)
            if (contact_.is_active[k])
                update_neighbors(
                    k, x,
                    obstacle_pose(k, pose_at(contacts_.path(k), run_.t + run_.step * static_cast<double>(run_.steps))));
        if (run_.record_obstacles)
            for (std::size_t k = 0; k < sums_.size(); ++k) run_.contact_record[k] += run_.step * sums_[k];
        return !intersected_;
    }
    /// Least gap in units of the full thickness of particles [m].
    double gap() const { return 2.0 * bound_.gap; }
    /// Work of contacts that recover their thickness [J].
    double growth_work() const { return growth_work_; }
    ContactBounds bounds() const { return bound_.bounds(law_); }

    /// Accumulate the record of a force on a point of an obstacle, except dissipation.
    static void accumulate(double* sums, const FeaturesAt& from, Index point, Vec3<double> force, double weight) {
        const Vec3<double> arm = from.arm(point), torque = cross(from.lever + arm, force);
        const double rates[record_numbers] = {
            force.x, force.y, force.z, torque.x, torque.y, torque.z, -dot(force, from.velocity(point)), 0.0};
        for (int k = 0; k < record_numbers; ++k) sums[k] += weight * rates[k];
    }

private:
    /// Pose of an obstacle from the pose on its path.
    Pose obstacle_pose(std::int64_t k, const Pose& path_pose) const {
        return contacts_.jaw_of(k) ? jaws_->pose(0, k, path_pose) : path_pose;
    }
    /// Measure the motion of the cloth since the last step.
    void measure_motion(const double* x) {
        has_previous_ = !positions_.empty();
        cloth_ = {};
        if (has_previous_) cloth_.include(x, positions_.data(), contact_.surface.count);
    }
    /// Update the neighbours of an obstacle, and check the motion since the last step for intersections.
    bool update_neighbors(std::int64_t k, const double* x, const Pose& pose) {
        if (intersected_) return false;
        const FeaturesAt from{contact_.obstacles[k], pose};
        FeatureVerletList& neighbors = neighbors_[k];
        double motion = 0.0, since = std::numeric_limits<double>::infinity();
        if (has_previous_) since = motion = max_relative_motion(cloth_, from.features, poses_[k], pose);
        // A pair within twice `motion` [m] of contact may come into contact in one of the next two steps.
        intersected_ = !neighbors.update(contact_.surface, x, from, law_.thickness(false), 2.0 * motion, since);
        if (!intersected_ && motion > 0.0) check_intersections(neighbors, x, from, poses_[k], motion);
        poses_[k] = pose;
        return !intersected_;
    }
    void check_intersections(const FeatureVerletList& neighbors, const double* x, const FeaturesAt& current,
                             const Pose& previous_pose, double motion) {
        const FeaturesAt previous{current.features, previous_pose};
        const Quads cloth{x}, previous_cloth{positions_.data()};
        const auto at = with_point_positions(current, cloth), was = with_point_positions(previous, previous_cloth);
        const auto displacement = [&](Index c) { return at(c) - was(c); };
        const double radius = current.features.radius, limit = radius + motion;
        intersected_ = neighbors.any([&](auto edges, const PairList& pairs, std::size_t k) {
            return pairs.square[k] <= limit * limit &&
                   may_intersect<edges()>(feature_corners<edges()>(contact_.surface, current.features, pairs, k),
                                          pairs.square[k], radius, displacement);
        });
    }

    const FeatureContactModel& contact_;
    std::vector<FeatureVerletList>& neighbors_;
    const Contacts& contacts_;
    const Run& run_;
    SurfaceLaw<double> law_;
    Contact<double> feature_contact_;
    FeatureStiffnessBound bound_;
    std::vector<double> sums_;
    double growth_work_ = 0.0;
    /// Positions and poses of the last step.
    Array<double> positions_;
    std::vector<Pose> poses_;
    MotionBound cloth_;
    JawRun* jaws_ = nullptr;
    bool has_previous_ = false, intersected_ = false;
};

}  // namespace cloth::contact
