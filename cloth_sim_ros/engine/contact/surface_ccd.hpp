// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Continuous collision detection of the surface, by the cloth itself and by points and edges of obstacles, and
// intersections at the start. Arrays are (3, n) by component.
#pragma once

#include "contact/surface_contacts.hpp"

namespace cloth::contact {

bool ccd_self(Plan& plan, const double* x0, const double* x1) {
    SelfVerletList& neighbors = plan.self->neighbors();
    const double d = plan.contacts.thickness;
    const Array<double> from = quads_of(plan, x0), to = quads_of(plan, x1);
    MotionBound motion;
    motion.include(to.data(), from.data(), plan.count);
    const double max_motion = motion.diameter();
    if (!neighbors.find(from.data(), d, max_motion)) return true;
    const Quads start{from.data()}, end{to.data()};
    return neighbors.any([&](auto edges, const PairList& pairs, std::size_t k) {
        return ccd_pair<edges()>(pair_corners<edges()>(neighbors.surface, pairs, k), 0.0, 1e-3 * d, start, end);
    });
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
    motion.include(to, from, s.count);
    if (!neighbors.find(s, from, begin, thickness, max_relative_motion(motion, features, start_pose, end_pose)))
        return true;
    const auto start_at = with_point_positions(begin, start), end_at = with_point_positions(finish, end);
    return neighbors.any([&](auto edges, const PairList& pairs, std::size_t k) {
        return ccd_pair<edges()>(feature_corners<edges()>(s, features, pairs, k), features.radius, 1e-3 * thickness,
                                 start_at, end_at);
    });
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
/// For each gripper, whether a jaw intersects the cloth at x while it moves from a half opening [m] to its present one.
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

/// First edge that intersects a triangle: its two particles and those of the triangle, or -1 if there is none. Pairs
/// with a common corner do not count.
void find_self_intersection(Plan& plan, const double* x, std::int64_t* out) {
    const Surface& s = plan.self->surface;
    std::fill(out, out + 5, std::int64_t{-1});
    if (plan.self->is_clear(x, plan.contacts.thickness)) return;
    const Array<double> positions = quads_of(plan, x);
    const Quads at{positions.data()};
    // A point of a triangle is no further from its edges than the radius of the inscribed circle.
    SurfacePairs pairs;
    pairs.build(s, positions.data(), 0.3 * longest_edge(s, at));
    const auto intersects = [&](const std::array<Index, 2>& e, Index triangle) {
        if (triangle < 0 || s.has(triangle, e[0]) || s.has(triangle, e[1])) return false;
        const auto& t = s.triangles[triangle];
        if (!segment_intersects(at(e[0]), at(e[1]), at(t[0]), at(t[1]), at(t[2]))) return false;
        const Index hit[5] = {e[0], e[1], t[0], t[1], t[2]};
        for (int k = 0; k < 5; ++k) out[k] = plan.particle_of_rank[hit[k]];
        return true;
    };
    // The triangles of an edge are about its ends.
    const auto any_triangle_of = [&](const std::array<Index, 2>& e, const std::array<Index, 2>& edge) {
        for (Index k = s.start[edge[0]]; k < s.start[edge[0] + 1]; ++k)
            if (s.has(s.fan[k], edge[1]) && intersects(e, s.fan[k])) return true;
        return false;
    };
    for (std::size_t k = 0; k < pairs.edges.size(); ++k) {
        const auto &a = s.edges[pairs.edges.first[k]], &b = s.edges[pairs.edges.second[k]];
        if (any_triangle_of(a, b) || any_triangle_of(b, a)) return;
    }
}

/// Find an initial intersection at time t, three numbers: the obstacle, and two particles of the edge inside it or of
/// the triangle that its feature intersects; -1 if there is none.
void find_feature_intersection(Plan& plan, double t, const double* x, std::int64_t* out) {
    const FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Surface& s = contact.surface;
    const Array<double> positions = quads_of(plan, x);
    const Quads at{positions.data()};
    std::fill(out, out + 3, std::int64_t{-1});
    const double min_step = 1e-3 * contacts.thickness;
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
        const PosedObstacle<double> posed(pose, obstacle);
        for (const auto& e : s.edges) {
            const Vec3<double> a = at(e[0]), b = at(e[1]);
            const double length = root(norm2(b - a));
            for (double distance = 0.0; distance < length;) {
                const double gap = gap_of(posed, obstacle, a + (distance / length) * (b - a));
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
