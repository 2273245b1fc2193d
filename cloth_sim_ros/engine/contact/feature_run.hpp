// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact of points and edges of obstacles with the cloth over a run.
#pragma once

#include "contact/feature_neighbors.hpp"
#include "contact/jaw_run.hpp"

namespace cloth::contact {

using plan::record_numbers;

/// Stiffness bound of contact with features: the energy per mass that contact absorbs, in units of U^2/2, and the
/// largest row sum of stiffness over mass relative to a single gap at a particle. Gershgorin: a gap's stiffness k g g'
/// is at most k |w_c| at a corner of weight w_c, because the weights add up to one and an obstacle does not yield. Jaws
/// yield: there it is at most 2 k |w_c|, and 2 k at the jaws.
class FeatureStiffnessBound {
public:
    explicit FeatureStiffnessBound(double mass) : mass_(mass) {}
    double encountered = 0.0, gap = 1e30;

    /// Set the obstacle of the contacts that follow.
    void set_obstacle(const Contacts& contacts, std::int64_t obstacle) {
        const ParallelJaw* const jaw = contacts.jaw_of(obstacle);
        jaw_ = jaw ? contacts.obstacles[obstacle].parallel_jaw : -1;
        inverse_jaw_mass_ = jaw ? 1.0 / jaw->mass : 0.0;
        mobility_ = jaw ? 2.0 : 1.0;
        if (jaw_loads_.size() < contacts.parallel_jaws.size()) jaw_loads_.resize(contacts.parallel_jaws.size(), 0.0);
    }
    template <class V>
    void include(const Surface& s, const FeatureContact<V>& m) {
        gap = smaller(m.min_gap(), gap);
        for (const auto& g : m.gaps) {
            double weight[3];
            for (int k = 0; k < g.corners; ++k) weight[k] = number_of(g.weight[k]);
            add_contact(s, g.corners, g.corner, weight, number_of(g.closing), number_of(m.shape));
            for (int k = 0; k < g.corners; ++k) {
                const Index c = g.corner[k];
                if (load_.empty()) load_.assign(s.count, 0.0);
                if (load_[c] == 0.0) loaded_.push_back(c);
                load_[c] += mobility_ * g.sign * mass_ * weight[k] / s.masses[c];
            }
            if (jaw_ >= 0) jaw_loads_[jaw_] += mobility_ * g.sign * mass_ * inverse_jaw_mass_;
        }
    }
    /// Add a gap with a closing speed and a contact energy: m_e w^2/2 of all its corners is converted into M U^2/2 b,
    /// where 1/m_e is the sum of w_c^2 / m_c and the inverse mass of the jaws.
    void add_contact(const Surface& s, int corners, const Index* corner, const double* weight, double closing,
                     double shape) {
        const double speed = larger(closing, 0.0) / ContactLaw<double>::speed;
        double inverse = inverse_jaw_mass_;
        row_sum_ = larger(mobility_ * mass_ * inverse_jaw_mass_, row_sum_);
        for (int k = 0; k < corners; ++k) {
            inverse += weight[k] * weight[k] / s.masses[corner[k]];
            row_sum_ = larger(mobility_ * mass_ * weight[k] / s.masses[corner[k]], row_sum_);
        }
        encountered = larger(shape + speed * speed / (mass_ * inverse), encountered);
    }
    /// Add a gap that comes into contact within a duration [s], because the step has to be short enough before that.
    /// `distance` [m] is left until then.
    void add_approaching(const Surface& s, int corners, const Index* corner, const double* weight, double distance,
                         double closing, double duration) {
        if (distance >= 0.0 && distance < duration * closing) add_contact(s, corners, corner, weight, closing, 0.0);
    }
    /// Include the row sums collected since the last call, and clear them.
    void flush() {
        for (const Index c : loaded_) {
            row_sum_ = larger(load_[c], row_sum_);
            load_[c] = 0.0;
        }
        loaded_.clear();
        for (double& load : jaw_loads_) {
            row_sum_ = larger(load, row_sum_);
            load = 0.0;
        }
    }
    ContactBounds bounds(const FeatureLaw<double>& law, double expected = 1.0) const {
        if (!(encountered > 0.0)) return {};
        const double at = stopping_gap(expected * encountered) * law.thickness();
        return {row_sum_ * law.law().stiffness(at), row_sum_ * law.law().damping(at)};
    }

private:
    double mass_, row_sum_ = 1.0, inverse_jaw_mass_ = 0.0, mobility_ = 1.0;
    std::int64_t jaw_ = -1;  ///< index of the present obstacle's gripper, or -1
    std::vector<double> load_, jaw_loads_;
    std::vector<Index> loaded_;
};

/// Call `visit` with each contact of an obstacle's features in its Verlet lists. If `bound` is given, add pairs that
/// come into contact within `duration` [s] to it.
template <class V, class X, class U, class F>
inline void for_each_feature_contact(const Surface& s, const FeatureVerletList& neighbors, const FeaturesAt& from,
                                     const FeatureLaw<V>& law, X&& at, U&& velocity, FeatureContact<V>& m, F&& visit,
                                     FeatureStiffnessBound* bound = nullptr, double duration = 0.0) {
    const double radius = from.features.radius;
    for_each_feature(
        neighbors,
        [&](Index k, std::size_t first, std::size_t last) {
            const Index* const triangles = neighbors.triangles.second.data();
            law.point(s, from, k, triangles + first, triangles + last, at, velocity, m);
            if (!m.gaps.empty()) visit(m);
            if constexpr (std::is_same_v<V, double>) {
                for (std::size_t pair = first; bound && pair < last; ++pair) {
                    const auto& t = s.triangles[triangles[pair]];
                    const auto n = near_triangle(from.position(k), at(t[0]), at(t[1]), at(t[2]));
                    const double away = root(n.square);
                    const Vec3<double> slip = n.weight[0] * velocity(t[0]) + n.weight[1] * velocity(t[1]) +
                                              n.weight[2] * velocity(t[2]) - from.velocity(k);
                    const double gap = away - radius;
                    bound->add_approaching(s, 3, t.data(), n.weight, law.scaling().gap(gap) - law.thickness(),
                                           law.scaling().closing(gap, dot(n.away, slip) / away), duration);
                }
            }
        },
        [&](std::size_t pair) {
            const auto& edge = s.edges[neighbors.edges.second[pair]];
            law.edges(edge, from, neighbors.edges.first[pair], at, velocity, m);
            if (!m.gaps.empty()) visit(m);
            if constexpr (std::is_same_v<V, double>) {
                if (!bound || !m.gaps.empty()) return;
                const auto& obstacle_edge = from.features.edges[neighbors.edges.first[pair]];
                const auto n = near_segments(at(edge[0]), at(edge[1]), from.position(obstacle_edge[0]),
                                             from.position(obstacle_edge[1]));
                const double away = root(n.square), weight[2] = {1.0 - n.first, n.first};
                const Vec3<double> u = from.velocity(obstacle_edge[0]), w = from.velocity(obstacle_edge[1]);
                const Vec3<double> slip =
                    weight[0] * velocity(edge[0]) + weight[1] * velocity(edge[1]) - u - n.second * (w - u);
                const double gap = away - radius;
                bound->add_approaching(s, 2, edge.data(), weight, law.scaling().gap(gap) - law.thickness(),
                                       law.scaling().closing(gap, -dot(n.away, slip) / away), duration);
            }
        });
}

/// Whether a pair may have intersected in a step that ended at a squared distance [m^2]. It has not if its relative
/// motion is below its gap. No point of a side moves further, relative to a corner of the other, than the side's own
/// corners.
inline bool feature_may_intersect(double square, double radius, const Vec3<double>* displacement, int corners,
                                  Vec3<double> first, Vec3<double> second) {
    double max_motion = 0.0;
    for (int k = 0; k < corners; ++k) max_motion = larger(root(norm2(displacement[k] - first)), max_motion);
    return !(max_motion + root(norm2(second - first)) < root(square) - radius);
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
            law_.reduce(contacts_.reduced.scaling(k, contact_.surface.count, contact_.surface.count + 1, t));
            JawRun::JawLoad jaw_load;
            double* const sums = run_.record_obstacles && step >= 0 ? sums_.data() + k * record_numbers : nullptr;
            for_each_feature_contact<double>(
                contact_.surface, neighbors_[k], from, law_, at, velocity, feature_contact_,
                [&](const FeatureContact<double>& m) {
                    bound_.include(contact_.surface, m);
                    law_.forces(
                        m,
                        [&](Index c, Vec3<double> force) {
                            f[4 * c] += force.x, f[4 * c + 1] += force.y, f[4 * c + 2] += force.z;
                        },
                        [&](Index point, Vec3<double> force) {
                            jaw_load.force += contacts_.obstacles[k].jaw_side * dot(pose.rotation[1], force);
                            if (sums) accumulate(sums, from, point, force, 1.0);
                        });
                    if (sums) sums[record_numbers - 1] += law_.dissipation(m);
                    if (sums) growth_work_ += run_.step * law_.growth_power(m);
                },
                &bound_, 2.0 * run_.step);
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
        const std::int64_t n = contact_.surface.count;
        has_previous_ = !positions_.empty();
        cloth_ = {};
        for (std::int64_t i = 0; has_previous_ && i < n; ++i)
            cloth_.include(load4(x + 4 * i) - load4(positions_.data() + 4 * i));
    }
    /// Update the neighbours of an obstacle, and check the motion since the last step for intersections.
    bool update_neighbors(std::int64_t k, const double* x, const Pose& pose) {
        if (intersected_) return false;
        const FeaturesAt from{contact_.obstacles[k], pose};
        FeatureVerletList& neighbors = neighbors_[k];
        double motion = 0.0, since = std::numeric_limits<double>::infinity();
        if (has_previous_) {
            MotionBound bound = cloth_;
            const Vec3<double> displacement = pose.position - poses_[k].position;
            bound.include(quad<double>{displacement.x, displacement.y, displacement.z, 0.0});
            since = motion = bound.diameter() + rotation_displacement(pose, poses_[k], from.features.reach);
        }
        // A pair within twice `motion` [m] of contact may come into contact in one of the next two steps.
        intersected_ = !neighbors.update(contact_.surface, x, from, law_.thickness(), 2.0 * motion, since);
        if (!intersected_ && motion > 0.0) check_intersections(neighbors, x, from, poses_[k], motion);
        poses_[k] = pose;
        return !intersected_;
    }
    void check_intersections(const FeatureVerletList& neighbors, const double* x, const FeaturesAt& current,
                             const Pose& previous_pose, double motion) {
        const Surface& s = contact_.surface;
        const Features& features = current.features;
        const FeaturesAt previous{features, previous_pose};
        const Quads at{x}, was{positions_.data()};
        const double radius = features.radius, threshold = (radius + motion) * (radius + motion);
        Vec3<double> displacement[3];
        const auto corner_motion = [&](Index c) { return at(c) - was(c); };
        const auto point_motion = [&](Index point) { return current.position(point) - previous.position(point); };
        for (std::size_t k = 0; k < neighbors.triangles.size() && !intersected_; ++k) {
            const Index point = neighbors.triangles.first[k], triangle = neighbors.triangles.second[k];
            const double square = FeatureVerletList::point_square(s, current, at, point, triangle);
            if (square > threshold) continue;
            for (int c = 0; c < 3; ++c) displacement[c] = corner_motion(s.triangles[triangle][c]);
            intersected_ =
                feature_may_intersect(square, radius, displacement, 3, point_motion(point), point_motion(point));
        }
        for (std::size_t k = 0; k < neighbors.edges.size() && !intersected_; ++k) {
            const Index edge = neighbors.edges.first[k];
            const double square = FeatureVerletList::edge_square(s, current, at, edge, neighbors.edges.second[k]);
            if (square > threshold) continue;
            for (int c = 0; c < 2; ++c) displacement[c] = corner_motion(s.edges[neighbors.edges.second[k]][c]);
            intersected_ = feature_may_intersect(square, radius, displacement, 2, point_motion(features.edges[edge][0]),
                                                 point_motion(features.edges[edge][1]));
        }
    }

    const FeatureContactModel& contact_;
    std::vector<FeatureVerletList>& neighbors_;
    const Contacts& contacts_;
    const Run& run_;
    FeatureLaw<double> law_;
    FeatureContact<double> feature_contact_;
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
