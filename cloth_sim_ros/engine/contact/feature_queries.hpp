// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of contact with points and edges of obstacles: energy, powers, bounds, derivative product, prediction,
// continuous collision detection. Arrays are (3, n) by component.
#pragma once

#include "contact/feature_run.hpp"
#include "contact/self_queries.hpp"

namespace cloth::contact {

/// Call visit(law, contact, obstacle, from) with each contact at time t, positions x and velocities v, with derivatives
/// if V has them. Positions that are not finite have no contact. With `ignore_reduction` all contacts have the full
/// thickness.
template <class V, class F>
inline void for_each_feature_contact(Plan& plan, double t, const double* const (&x)[2], const double* const (&v)[2],
                                     F&& visit, bool ignore_reduction = false) {
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    if (!contact.has_any(contacts)) return;
    const QueryNumbers<V> at(plan, x), velocity(plan, v);
    SurfaceLaw<V> law(contacts.thickness, contacts.damping, contact.mass);
    Contact<V> m;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        FeatureVerletList& neighbors = contact.neighbors()[k];
        if (!contact.has(contacts, k)) continue;
        const Pose pose = contacts.obstacle_pose(k, t);
        const FeaturesAt from{contact.obstacles[k], pose, pose.position - pose_at(contacts.path(k), t).position};
        if (!neighbors.find(contact.surface, at.quads(), from, law.thickness(false), 0.0)) continue;
        law.set_obstacle(from.features.radius, ignore_reduction
                                                   ? full_thickness<double>()
                                                   : contacts.reduced.scaling(k, plan.count, plan.count + 1, t));
        for_each_feature_contact<V>(contact.surface, neighbors, from, law, with_point_positions(from, at),
                                    with_point_velocities(from, velocity), m,
                                    [&](const Contact<V>& one) { visit(law, one, k, from); });
    }
}

double feature_energy(Plan& plan, double t, const double* x) {
    double total = 0.0;
    for_each_feature_contact<double>(
        plan, t, {x, nullptr}, {nullptr, nullptr},
        [&](const auto& law, const auto& m, auto, const auto&) { total += law.energy(m); });
    return total;
}
void add_feature_wrenches(Plan& plan, double t, const double* x, const double* v, double weight, double* wrenches) {
    for_each_feature_contact<double>(plan, t, {x, nullptr}, {v, nullptr},
                                     [&](const auto& law, const auto& m, std::int64_t k, const FeaturesAt& from) {
                                         double* const to = wrenches + k * record_numbers;
                                         law.forces(m, [&](Index c, Vec3<double> force) {
                                             if (c < 0) FeatureRun::accumulate(to, from, ~c, force, weight);
                                         });
                                         to[record_numbers - 1] += weight * law.dissipation(m);
                                     });
}
double feature_growth_power(Plan& plan, double t, const double* x, const double* v) {
    double power = 0.0;
    for_each_feature_contact<double>(
        plan, t, {x, nullptr}, {v, nullptr},
        [&](const auto& law, const auto& m, auto, const auto&) { power += law.growth_power(m); });
    return power;
}
void add_feature_jaw_forces(Plan& plan, double t, const double* x, const double* v, std::vector<double>& jaw_forces) {
    for_each_feature_contact<double>(plan, t, {x, nullptr}, {v, nullptr},
                                     [&](const auto& law, const auto& m, std::int64_t k, const FeaturesAt& from) {
                                         const Obstacle& obstacle = plan.contacts.obstacles[k];
                                         if (obstacle.parallel_jaw < 0) return;
                                         law.forces(m, [&](Index c, Vec3<double> force) {
                                             if (c < 0)
                                                 jaw_forces[obstacle.parallel_jaw] +=
                                                     obstacle.jaw_side * dot(from.pose.rotation[1], force);
                                         });
                                     });
}
void add_feature_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp) {
    for_each_feature_contact<double>(
        plan, t, {x, nullptr}, {nullptr, nullptr},
        [&](const auto& law, const auto& m, auto, const auto&) { add_gap_bounds(plan, law, m, 1.0, stiff, damp); });
}
void add_feature_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                         double* out) {
    for_each_feature_contact<Dual>(plan, t, {x, dx}, {v, dv}, [&](const auto& law, const auto& m, auto, const auto&) {
        law.forces(m, add_slope_to(plan, out));
    });
}
void feature_gaps(Plan& plan, double t, const double* x, double* out) {
    for_each_feature_contact<double>(
        plan, t, {x, nullptr}, {nullptr, nullptr},
        [&](const auto&, const auto& m, std::int64_t k, const auto&) {
            out[2 * k + 1] = smaller(m.min_gap(), out[2 * k + 1]);
        },
        true);
}
void feature_gap_column(Plan& plan, double t, const double* x, double* out) {
    for_each_feature_contact<double>(
        plan, t, {x, nullptr}, {nullptr, nullptr},
        [&](const auto&, const auto& m, std::int64_t k, const auto&) {
            double& to = out[k * (plan.count + 1) + plan.count];
            to = smaller(2.0 * m.min_gap(), to);
        },
        true);
}

ContactBounds predict_feature_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                      const double* v) {
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    // Usually particles alone keep all obstacles out.
    if (!contact.has_any(contacts)) return {};
    SurfaceLaw<double> law = contact.law(contacts);
    const double infinite = std::numeric_limits<double>::infinity();
    const Array<double> positions = quads_of(plan, x), velocities = quads_of(plan, v);
    const Quads at{positions.data()}, velocity{velocities.data()};
    FeatureStiffnessBound bound(contact.mass);
    Contact<double> m;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        FeatureVerletList& neighbors = contact.neighbors()[k];
        if (!contact.has(contacts, k)) continue;
        const Pose pose = contacts.driven_pose(k, t, duration);
        const FeaturesAt from{contact.obstacles[k], pose};
        bound.set_obstacle(contacts, k);
        law.set_obstacle(from.features.radius, contacts.reduced.scaling(k, plan.count, plan.count + 1, t));
        MotionBound motion;
        for (std::int64_t i = 0; i < plan.count; ++i) motion.include(load4(velocities.data() + 4 * i));
        motion.include(quad<double>{pose.velocity.x, pose.velocity.y, pose.velocity.z, 0.0});
        const double speed = motion.diameter() + root(norm2(pose.spin)) * from.features.reach;
        // The next call sees pairs further away.
        const double margin = smaller(speed * duration, 2.0 * contact.surface.shortest);
        if (!neighbors.find(contact.surface, positions.data(), from, law.thickness(false), margin))
            return {infinite, infinite};
        for_each_feature_contact<double>(
            contact.surface, neighbors, from, law, with_point_positions(from, at),
            with_point_velocities(from, velocity), m, [&](const auto& term) { bound.include(contact.surface, term); },
            &bound, duration);
    }
    bound.flush();
    if (bound.gap <= 0.0) return {infinite, infinite};
    return bound.bounds(law, expected);
}

/// Whether the features of an obstacle intersect the cloth while the obstacle moves between two poses and the particles
/// (quads) move straight. Conservative advancement: each step is one gap long.
inline bool ccd_obstacle_features(FeatureContactModel& contact, std::int64_t k, double thickness,
                                  const Pose& start_pose, const Pose& end_pose, const double* from, const double* to) {
    const Surface& s = contact.surface;
    const Quads start{from}, end{to};
    FeatureVerletList& neighbors = contact.neighbors()[k];
    const Features& features = contact.obstacles[k];
    const FeaturesAt begin{features, start_pose}, finish{features, end_pose};
    MotionBound motion;
    for (std::int64_t i = 0; i < s.count; ++i) motion.include(load4(to + 4 * i) - load4(from + 4 * i));
    const Vec3<double> displacement = end_pose.position - start_pose.position;
    motion.include(quad<double>{displacement.x, displacement.y, displacement.z, 0.0});
    const double max_motion = motion.diameter() + rotation_displacement(start_pose, end_pose, features.reach);
    if (!neighbors.find(s, from, begin, thickness, max_motion)) return true;
    const auto start_at = with_point_positions(begin, start), end_at = with_point_positions(finish, end);
    const auto any_intersects = [&](auto edges, const PairList& pairs) {
        for (std::size_t k = 0; k < pairs.size(); ++k)
            if (ccd_pair<edges()>(feature_corners<edges()>(s, features, pairs, k), features.radius, 1e-3 * thickness,
                                  start_at, end_at))
                return true;
        return false;
    };
    return any_intersects(std::false_type{}, neighbors.triangles) || any_intersects(std::true_type{}, neighbors.edges);
}
bool ccd_features(Plan& plan, double t, double duration, const double* x0, const double* x1) {
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Array<double> from = quads_of(plan, x0), to = quads_of(plan, x1);
    const double thickness = contact.law(contacts).thickness(false);
    for (std::int64_t k = 0; k < contacts.count(); ++k)
        if (contact.has(contacts, k) &&
            ccd_obstacle_features(contact, k, thickness, contacts.obstacle_pose(k, t),
                                  contacts.obstacle_pose(k, t + duration), from.data(), to.data()))
            return true;
    return false;
}
void ccd_jaws(Plan& plan, double t, const double* x, const double* half_openings, std::int64_t* out) {
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Array<double> at = quads_of(plan, x);
    const double thickness = contact.law(contacts).thickness(false);
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        const std::int64_t jaw = contacts.obstacles[k].parallel_jaw;
        if (jaw < 0 || !contact.has(contacts, k)) continue;
        const Pose previous_pose = contacts.shifted_pose(pose_at(contacts.path(k), t), k, half_openings[jaw], 0.0);
        if (ccd_obstacle_features(contact, k, thickness, previous_pose, contacts.obstacle_pose(k, t), at.data(),
                                  at.data()))
            out[jaw] = 1;
    }
}

FeatureCulling::FeatureCulling(Plan& plan, double t, double duration, const double* x0, const double* v0)
    : plan_(plan) {
    if (!plan.features) return;
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Surface& s = contact.surface;
    std::fill(contact.is_active.begin(), contact.is_active.end(), 0);
    if (s.triangles.empty() || !contact.has_any(contacts)) return;
    const double thickness = contact.law(contacts).thickness(false);
    speed_limit_ = 2.0 * max_particle_speed(v0) + speed_margin;
    Array<double> positions;
    // Ball about the cloth.
    Vec3<double> center{};
    double radius = 0.0;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        FeatureVerletList& neighbors = contact.neighbors()[k];
        const Features& features = contact.obstacles[k];
        if (!contact.has(contacts, k)) continue;
        const double* const path = contacts.path(k);
        auto [path_length, path_angle] = max_path_motion(path, duration);
        const Pose pose = contacts.obstacle_pose(k, t);
        // Jaws rotate about their gripper. The cloth may push them back faster than they are driven.
        const double lever = root(norm2(pose.position - pose_at(path, t).position));
        if (contacts.jaw_of(k)) path_length += 2.0 * contacts.max_jaw_speed(k) * duration;
        const double margin = speed_limit_ * duration + path_length + path_angle * (lever + features.reach);
        if (positions.empty()) {
            positions = quads_of(plan, x0);
            const AxisBox box = box_of_edges(s, {positions.data()});
            center = box.center();
            radius = 0.5 * root(norm2(box.high - box.low));
        }
        // Distance between the bounding balls of cloth and obstacle.
        const double distance = root(norm2(center - pose.position)) - radius - features.reach - features.radius;
        if (distance > thickness + margin) continue;
        const bool is_valid = neighbors.find(s, positions.data(), {features, pose}, thickness, margin);
        contact.is_active[k] = !is_valid || neighbors.triangles.size() || neighbors.edges.size();
    }
    for (std::int64_t k = 0; k < contacts.count(); ++k)
        covers_all_ = covers_all_ && (contact.is_active[k] || !contact.has(contacts, k));
}

void FeatureCulling::disable() {
    if (!plan_.features) return;
    plan_.features->activate_all(plan_.contacts);
    covers_all_ = true;
}

double FeatureCulling::max_particle_speed(const double* v) const {
    const std::int64_t n = plan_.count;
    double square = 0.0;
    for (std::int64_t i = 0; i < n; ++i) {
        const double square_i = norm2(Vec3<double>{v[i], v[n + i], v[2 * n + i]});
        square = square_i <= square ? square : square_i;  // a speed that is NaN is kept
        if (!(square_i < std::numeric_limits<double>::infinity())) return square_i;
    }
    return root(square);
}

void activate_features(Plan& plan) {
    if (plan.features) plan.features->activate_all(plan.contacts);
}
void deactivate_features(Plan& plan) {
    if (plan.features) std::fill(plan.features->is_active.begin(), plan.features->is_active.end(), 0);
}

void find_feature_intersection(Plan& plan, double t, const double* x, std::int64_t* out) {
    const FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Surface& s = contact.surface;
    const Array<double> positions = quads_of(plan, x);
    const Quads at{positions.data()};
    std::fill(out, out + 3, std::int64_t{-1});
    const double origin[3] = {}, min_step = 1e-3 * contacts.thickness;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        const Features& features = contact.obstacles[k];
        if (!contact.has(contacts, k)) continue;
        const Pose pose = contacts.obstacle_pose(k, t);
        const FeaturesAt from{features, pose};
        const auto report = [&](Index a, Index b) {
            out[0] = k, out[1] = plan.particle_of_rank[a], out[2] = plan.particle_of_rank[b];
        };
        // Edges of the cloth that enter the obstacle, sampled in steps of one gap.
        const Obstacle& obstacle = contacts.obstacles[k];
        const PosedObstacle<double> posed(pose, origin, obstacle);
        for (const auto& e : s.edges) {
            const Vec3<double> a = at(e[0]), b = at(e[1]);
            const double length = root(norm2(b - a));
            for (double distance = 0.0; distance < length;) {
                const double gap = with_shape(obstacle.shape, [&](auto shape) {
                    return contact_kinematics<shape.value, true, double>(posed, obstacle.size,
                                                                         a + (distance / length) * (b - a), {})
                        .gap;
                });
                if (!(gap > 0.0)) return report(e[0], e[1]);
                distance += larger(gap, min_step);
            }
        }
        // Features that intersect a triangle.
        for (const auto& c : s.triangles) {
            const Vec3<double> p[3] = {at(c[0]), at(c[1]), at(c[2])};
            const AxisBox box = AxisBox({p[0], p[1], p[2]}).expanded(features.radius);
            for (std::size_t j = 0; features.radius > 0.0 && j < features.points.size(); ++j) {
                const Vec3<double> q = from.position(static_cast<Index>(j));
                if (box.overlaps(AxisBox(q)) &&
                    !(near_triangle(q, p[0], p[1], p[2]).square > features.radius * features.radius))
                    return report(c[0], c[1]);
            }
            for (const auto& edge : features.edges) {
                const Vec3<double> q = from.position(edge[0]), r = from.position(edge[1]);
                if (box.overlaps(AxisBox({q, r})) && segment_intersects(q, r, p[0], p[1], p[2]))
                    return report(c[0], c[1]);
            }
        }
    }
}

}  // namespace cloth::contact
