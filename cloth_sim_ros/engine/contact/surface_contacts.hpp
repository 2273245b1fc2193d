// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contacts with the surface in a query, by the cloth itself and by points and edges of obstacles. Arrays are (3, n) by
// component.
#pragma once

#include "contact/culling.hpp"
#include "contact/feature_run.hpp"
#include "contact/queries.hpp"

namespace cloth::contact {

/// Convert an array (3, n) to quads in the order of runs.
inline Array<double> quads_of(const Plan& plan, const double* a) {
    Array<double> out(4 * plan.count, 0.0);
    for (int c = 0; a && c < 3; ++c)
        for (std::int64_t i = 0; i < plan.count; ++i) out[4 * plan.rank[i] + c] = a[c * plan.count + i];
    return out;
}
/// Vector of a particle in an array (3, n), by its rank in the order of runs.
struct RankReader {
    const Plan& plan;
    const double* from;
    Vec3<double> operator()(Index c) const {
        const double* const particle = from + plan.particle_of_rank[c];
        return {particle[0], particle[plan.count], particle[2 * plan.count]};
    }
};
/// Numbers of a query by particle: an array (3, n), with derivatives if V has them.
template <class V>
class QueryNumbers {
public:
    QueryNumbers(const Plan& plan, const double* value, const double* slope) : value_(quads_of(plan, value)) {
        if constexpr (std::is_same_v<V, Dual>) slope_ = quads_of(plan, slope);
    }
    const double* quads() const { return value_.data(); }
    Vec3<V> operator()(Index c) const {
        if constexpr (std::is_same_v<V, Dual>)
            return with_slope(Quads{value_.data()}(c), Quads{slope_.data()}(c));
        else
            return Quads{value_.data()}(c);
    }

private:
    Array<double> value_, slope_;
};

/// Whether it is known without a search that a sheet at positions x, (3, n), is in contact with itself. Usually it is
/// if it was in the last search; then no bound of its distances helps.
inline bool is_surely_in_contact(const Plan& plan, const double* x) {
    return plan.self->neighbors().nearest_is_within(RankReader{plan, x}, plan.contacts.thickness);
}

/// A contact in a query: its law, and functions of the position and velocity of corners; of the cloth with an obstacle,
/// this and its features.
template <class V, class X, class U>
struct SurfaceContact {
    const SurfaceLaw<V>& law;
    const Contact<V>& contact;
    const X& at;
    const U& velocity;
    std::int64_t obstacle = -1;
    const FeaturesAt* from = nullptr;
    using Number = V;
};
/// Upper bound of the relative speed of two particles at velocities v, (3, n).
inline double max_relative_speed(const Plan& plan, const double* v) {
    const std::int64_t n = plan.count;
    MotionBound bound;
    for (std::int64_t i = 0; i < n; ++i) bound.include(Vec3<double>{v[i], v[n + i], v[2 * n + i]});
    return bound.diameter();
}

/// Time, positions and velocities of a query, with derivatives or null. With `ignore_reduction` all contacts have the
/// full thickness. With a duration [s], pairs that may meet within it are contacts too.
struct SurfaceState {
    double t;
    const double *x, *v = nullptr, *dx = nullptr, *dv = nullptr;
    bool ignore_reduction = false;
    double duration = 0.0;
};

/// Call `visit` with each contact of the cloth with itself. Positions that are not finite have no contact.
template <class V, class F>
inline void for_each_self_contact(Plan& plan, const SurfaceState& state, F&& visit) {
    const Contacts& contacts = plan.contacts;
    if (!plan.self) return;
    // Neighbours in a flat sheet don't count.
    const double margin = state.duration > 0.0 ? smaller(max_relative_speed(plan, state.v) * state.duration,
                                                         0.5 * plan.self->surface.shortest)
                                               : 0.0,
                 range = contacts.thickness + margin;
    const bool has_full_thickness = state.ignore_reduction || !contacts.reduced.any();
    if (!is_surely_in_contact(plan, state.x)) {
        if (state.duration > 0.0 && has_full_thickness) {
            if (plan.self->stays_distant(state.x, state.v, contacts.thickness, state.duration)) return;
        } else if (plan.self->is_clear(state.x, range)) {
            return;
        }
    }
    const QueryNumbers<V> at(plan, state.x, state.dx), velocity(plan, state.v, state.dv);
    SelfVerletList& neighbors = plan.self->neighbors();
    if (!neighbors.find(at.quads(), contacts.thickness, margin)) return;
    SurfaceLaw<V> law(range, contacts.damping);
    std::vector<Scaling<double>> scalings;
    if (!state.ignore_reduction) self_scalings(plan, state.t, scalings);
    law.reduce(&scalings);
    Contact<V> m;
    const auto emit = [&] {
        if (!m.gaps.empty()) visit(SurfaceContact{law, m, at, velocity});
    };
    // Whether sides at a distance may meet within the duration: where even their relative speed, in any direction, closes
    // the distance, with room for rounding. A thickness that grows closes it, too.
    const Surface& s = neighbors.surface;
    const auto may_meet = [&](double square, double thickness, const Index* a, int count, const Index* b) {
        if (!(state.duration > 0.0) || !has_full_thickness) return true;
        const Quads v{velocity.quads()};
        double speed_square = 0.0;
        for (int i = 0; i < count; ++i)
            for (int j = 0; j < 4 - count; ++j) speed_square = larger(norm2(v(a[i]) - v(b[j])), speed_square);
        return !(root(square) - state.duration * root(speed_square) >= 1.000001 * thickness);
    };
    for_each_neighbor(
        neighbors, range,
        [&](Index i, const Index* begin, const Index* end, double nearest) {
            if (std::none_of(begin, end, [&](Index t) {
                    return may_meet(nearest, contacts.thickness, &i, 1, s.triangles[t].data());
                }))
                return;
            law.particle(s, i, begin, end, at, velocity, m);
            emit();
        },
        [&](const std::array<Index, 4>& c, double square) {
            if (!may_meet(square, 0.5 * contacts.thickness, c.data(), 2, c.data() + 2)) return;
            law.edges(s, {c[0], c[1]}, {c[2], c[3]}, at, velocity, m);
            emit();
        });
}
/// The same with points and edges of obstacles.
template <class V, class F>
inline void for_each_feature_contact(Plan& plan, const SurfaceState& state, F&& visit) {
    const Contacts& contacts = plan.contacts;
    if (!plan.features || !plan.features->has_any(contacts)) return;
    FeatureContactModel& model = *plan.features;
    const QueryNumbers<V> cloth(plan, state.x, state.dx), cloth_velocity(plan, state.v, state.dv);
    Contact<V> m;
    const BoundingBall ball(state.x, plan.count);
    const double fastest = state.duration > 0.0 ? max_speed(state.v, plan.count) : 0.0;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        FeatureVerletList& neighbors = model.neighbors()[k];
        if (!model.has(contacts, k)) continue;
        if (!state.duration && ball.is_away(contacts, k, state.t, contacts.thickness)) continue;
        const Pose pose = contacts.obstacle_pose(k, state.t);
        const FeaturesAt from{model.obstacles[k], pose, pose.position - pose_at(contacts.path(k), state.t).position};
        const double speed = fastest + root(norm2(pose.velocity)) + root(norm2(pose.spin)) * from.features.reach,
                     margin = smaller(speed * state.duration, 2.0 * model.surface.shortest);
        if (margin && ball.is_away(contacts, k, state.t, contacts.thickness + margin)) continue;
        SurfaceLaw<V> law(contacts.thickness + margin, contacts.damping, model.mass);
        if (!neighbors.find(model.surface, cloth.quads(), from, contacts.thickness, margin)) continue;
        law.set_obstacle(from.features.radius, state.ignore_reduction
                                                   ? full_thickness<double>()
                                                   : contacts.feature_scaling(k, plan.count, state.t));
        const auto at = with_point_positions(from, cloth), velocity = with_point_velocities(from, cloth_velocity);
        for_each_feature_contact<V>(model.surface, neighbors, from, law, at, velocity, m, [&](const Contact<V>& one) {
            visit(SurfaceContact{law, one, at, velocity, k, &from});
        });
    }
}
template <class V, class F>
inline void for_each_surface_contact(Plan& plan, const SurfaceState& state, F&& visit) {
    for_each_self_contact<V>(plan, state, visit);
    for_each_feature_contact<V>(plan, state, visit);
}

}  // namespace cloth::contact
