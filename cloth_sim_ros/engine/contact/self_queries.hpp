// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of self-contact: energy, power, bounds, derivative product, prediction, continuous collision detection.
// Arrays are (3, n) by component.
#pragma once

#include "contact/culling.hpp"
#include "contact/queries.hpp"
#include "contact/self_friction_queries.hpp"

namespace cloth::contact {

/// Convert an array (3, n) to quads in the order of runs.
inline Array<double> quads_of(const Plan& plan, const double* a) {
    Array<double> out(4 * plan.count, 0.0);
    for (int c = 0; a && c < 3; ++c)
        for (std::int64_t i = 0; i < plan.count; ++i) out[4 * plan.rank[i] + c] = a[c * plan.count + i];
    return out;
}
/// Numbers of a query by particle: an array (3, n), with derivatives if V has them.
template <class V>
class QueryNumbers {
public:
    QueryNumbers(const Plan& plan, const double* const (&numbers)[2]) : value_(quads_of(plan, numbers[0])) {
        if constexpr (std::is_same_v<V, Dual>) slope_ = quads_of(plan, numbers[1]);
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

/// Call visit(law, contact, at, velocity) with each contact at time t, positions x and velocities v, with derivatives if
/// V has them. Positions that are not finite have no contact. With `ignore_reduction` all contacts have the full
/// thickness.
template <class V, class F>
inline void for_each_self_contact(Plan& plan, double t, const double* const (&x)[2], const double* const (&v)[2],
                                  F&& visit, bool ignore_reduction = false) {
    const Contacts& contacts = plan.contacts;
    if (plan.self->is_clear(x[0], contacts.thickness)) return;
    const QueryNumbers<V> at(plan, x), velocity(plan, v);
    SelfVerletList& neighbors = plan.self->neighbors();
    if (!neighbors.find(at.quads(), contacts.thickness, 0.0)) return;
    SurfaceLaw<V> law(contacts.thickness, contacts.damping);
    std::vector<Scaling<double>> scalings;
    if (!ignore_reduction) self_scalings(plan, t, scalings);
    law.reduce(&scalings);
    Contact<V> m;
    const auto emit = [&] {
        if (!m.gaps.empty()) visit(law, m, at, velocity);
    };
    for_each_neighbor(
        neighbors, contacts.thickness,
        [&](Index i, const Index* begin, const Index* end) {
            law.particle(neighbors.surface, i, begin, end, at, velocity, m);
            emit();
        },
        [&](const std::array<Index, 4>& c) {
            law.edges(neighbors.surface, {c[0], c[1]}, {c[2], c[3]}, at, velocity, m);
            emit();
        });
}

double self_energy(Plan& plan, double t, const double* x) {
    double total = 0.0;
    for_each_self_contact<double>(plan, t, {x, nullptr}, {nullptr, nullptr},
                                  [&](const auto& law, const auto& m, auto& at, auto& velocity) {
                                      total += law.energy(m) + layer_energy(plan, law, m, at, velocity);
                                  });
    return total;
}
double self_dissipation(Plan& plan, double t, const double* x, const double* v) {
    double dissipation = 0.0;
    for_each_self_contact<double>(plan, t, {x, nullptr}, {v, nullptr},
                                  [&](const auto& law, const auto& m, auto& at, auto& velocity) {
                                      dissipation += law.dissipation(m) + layer_dissipation(plan, law, m, at, velocity);
                                  });
    return dissipation;
}
double self_friction_power(Plan& plan, double t, const double* x, const double* v) {
    double dissipation = 0.0;
    for_each_self_contact<double>(plan, t, {x, nullptr}, {v, nullptr},
                                  [&](const auto& law, const auto& m, auto& at, auto& velocity) {
                                      dissipation += layer_dissipation(plan, law, m, at, velocity);
                                  });
    return dissipation;
}
double self_growth_power(Plan& plan, double t, const double* x, const double* v) {
    double power = 0.0;
    for_each_self_contact<double>(plan, t, {x, nullptr}, {v, nullptr},
                                  [&](const auto& law, const auto& m, auto&, auto&) {
                                      if (law.reduced()) power += law.growth_power(m);
                                  });
    return power;
}
void combine_self_anchors(Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                          const double* weights, const double* ends, double* out) {
    if (!plan.has_self_friction()) return;
    const std::int64_t offset = plan.contacts.obstacle_anchors(plan.count);
    for_each_self_contact<double>(plan, t, {x, nullptr}, {v, nullptr},
                                  [&](const auto& law, const auto& m, auto& at, auto& velocity) {
                                      combine_layer_anchors(plan, law, m, at, velocity, runs, weights, ends + offset,
                                                            plan.anchor_count(), out + offset);
                                  });
}

/// Add the bounds of a contact: of a gap k g g', at corner c, `mobility` k |w_c| n n'.
inline void add_gap_bounds(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, double mobility,
                           double* stiff, double* damp) {
    for (const GapTerm<double>& g : m.gaps) {
        if (g.sign < 0.0) continue;
        const double mass = mobility * m.mass * (m.edges ? m.fade_factor : 1.0);
        const double k = mass * law.law(m.edges).stiffness(g.gap), c = mass * law.law(m.edges).damping(g.gap);
        for (int corner = 0; corner < 4; ++corner) {
            if (g.corner[corner] < 0 || (!m.edges && corner && g.corner[corner] == g.corner[0])) continue;
            const double weight = absolute(g.weight[corner]);
            const std::int64_t i = plan.particle_of_rank[g.corner[corner]];
            if (stiff) add_block(stiff, plan.count, i, outer(k * weight, g.normal, 0.0));
            if (damp) add_block(damp, plan.count, i, outer(c * weight, g.normal, 0.0));
        }
    }
}
void add_self_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp) {
    for_each_self_contact<double>(plan, t, {x, nullptr}, {nullptr, nullptr},
                                  [&](const auto& law, const auto& m, auto& at, auto& velocity) {
                                      add_layer_bounds(plan, law, m, at, velocity, stiff, damp);
                                      add_gap_bounds(plan, law, m, 2.0, stiff, damp);
                                  });
}

/// Function that adds the derivative of a force to out, (3, n), unless it acts on an obstacle.
inline auto add_slope_to(const Plan& plan, double* out) {
    return [&plan, out](Index c, Vec3<Dual> force) {
        if (c < 0) return;
        const std::int64_t i = plan.particle_of_rank[c];
        out[i] += force.x.slope;
        out[plan.count + i] += force.y.slope;
        out[2 * plan.count + i] += force.z.slope;
    };
}
void add_self_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                      double* out) {
    for_each_self_contact<Dual>(plan, t, {x, dx}, {v, dv},
                                [&](const auto& law, const auto& m, auto& at, auto& velocity) {
                                    add_layer_product(plan, law, m, at, velocity, add_slope_to(plan, out));
                                    law.forces(m, add_slope_to(plan, out));
                                });
}

void self_gaps(Plan& plan, const double* x, double* out) {
    out[0] = 0.0;
    out[1] = std::numeric_limits<double>::infinity();
    for_each_self_contact<double>(
        plan, 0.0, {x, nullptr}, {nullptr, nullptr},
        [&](const auto&, const auto& m, auto&, auto&) {
            out[0] += 1.0;
            out[1] = smaller(m.min_gap(), out[1]);
        },
        true);
}
void self_gap_row(Plan& plan, const double* x, double* out) {
    for_each_self_contact<double>(
        plan, 0.0, {x, nullptr}, {nullptr, nullptr},
        [&](const auto&, const auto& m, auto&, auto&) {
            const double gap = m.edges ? 2.0 * m.min_gap() : m.min_gap();
            for (int k = 0; k < (m.edges ? 4 : 1); ++k) {
                double& to = out[plan.particle_of_rank[m.gaps[0].corner[k]]];
                to = smaller(gap, to);
            }
        },
        true);
}

ContactBounds predict_self_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                   const double* v) {
    SelfContact& self = *plan.self;
    SelfVerletList& neighbors = self.neighbors();
    const double d = plan.contacts.thickness;
    // A reduced thickness is below the full one.
    if (self.stays_separated(x, v, d, duration)) {
        neighbors.clear_pairs();
        return {};
    }
    const Array<double> positions = quads_of(plan, x), velocities = quads_of(plan, v);
    MotionBound motion;
    motion.include(velocities.data(), nullptr, plan.count);
    // At most half the shortest edge, so that neighbours in a flat sheet don't count. The next call sees pairs further
    // away.
    const double margin = smaller(motion.diameter() * duration, 0.5 * self.surface.shortest);
    StiffnessBound bound;
    RowSums load;
    SurfaceLaw<double> law(d, plan.contacts.damping);
    std::vector<Scaling<double>> scalings;
    self_scalings(plan, t, scalings);
    law.reduce(&scalings);
    if (!neighbors.find(positions.data(), d, margin)) {
        const double infinite = std::numeric_limits<double>::infinity();
        return {infinite, infinite};
    }
    const Surface& s = self.surface;
    const Quads at{positions.data()}, velocity{velocities.data()};
    Contact<double> m;
    // Edges have half the thickness. Slower layers are stopped by their particles before that. Edges that touch
    // nevertheless, in a twist, are seen by the run itself.
    const double min_edge_speed = ContactLaw<double>::speed * root(0.5 * law.law(false).shape(0.5 * d) / expected);
    for_each_neighbor(
        neighbors, d,
        [&](Index i, const Index* begin, const Index* end) {
            law.particle(s, i, begin, end, at, velocity, m);
            bound.include(s, m);
            for_each_layer_bound(plan, law, m, at, velocity, [&](Index c, double k) { load.add(s, c, k); });
        },
        [&](const std::array<Index, 4>& c) {
            law.edges(s, {c[0], c[1]}, {c[2], c[3]}, at, velocity, m);
            bound.include(s, m);
        });
    bound.add_approaching<false>(s, neighbors.triangles, law, at.from, velocity.from, duration);
    bound.add_approaching<true>(s, neighbors.edges, law, at.from, velocity.from, duration, min_edge_speed);
    bound.flush();
    load.flush();
    const double frequency = plan.contacts.frequency;
    const double friction_omega2 = plan.has_self_friction() ? larger(load.max(), 2.0 * frequency * frequency) : 0.0;
    return bound.bounds(d, plan.contacts.damping, expected, friction_omega2, frequency);
}

bool ccd_self(Plan& plan, const double* x0, const double* x1) {
    SelfVerletList& neighbors = plan.self->neighbors();
    const double d = plan.contacts.thickness;
    const Array<double> from = quads_of(plan, x0), to = quads_of(plan, x1);
    MotionBound motion;
    motion.include(to.data(), from.data(), plan.count);
    const double max_motion = motion.diameter();
    if (!neighbors.find(from.data(), d, max_motion)) return true;
    const Quads start{from.data()}, end{to.data()};
    for (std::size_t k = 0; k < neighbors.triangles.size(); ++k)
        if (ccd_pair<false>(pair_corners<false>(neighbors.surface, neighbors.triangles, k), 0.0, 1e-3 * d, start, end))
            return true;
    for (std::size_t k = 0; k < neighbors.edges.size(); ++k)
        if (ccd_pair<true>(pair_corners<true>(neighbors.surface, neighbors.edges, k), 0.0, 1e-3 * d, start, end))
            return true;
    return false;
}

SelfCulling::SelfCulling(Plan& plan, double duration, const double* x0, const double* v0)
    : plan_(plan), x0_(x0), duration_(duration) {
    plan.self_culled = false;
    if (!plan.self) return;
    SelfContact& self = *plan.self;
    plan.self_culled = is_separated_ = self.stays_separated(x0, v0, plan.contacts.thickness, duration);
    if (is_separated_) return;
    const Array<double> positions = quads_of(plan, x0);
    speed_limit_ = 2.0 * relative_speed(v0) + SelfContact::speed_margin;
    const double margin = speed_limit_ * duration;
    plan.self_culled = plan.contacts.thickness + margin < SelfVerletList::min_reach * self.surface.shortest &&
                       self.neighbors().has_no_pairs(positions.data(), plan.contacts.thickness, margin);
}

bool SelfCulling::is_violated(const double* x, const double* v, bool is_next_start) const {
    if (!plan_.self_culled) return false;
    if (!is_separated_) return !(relative_speed(v) <= speed_limit_);
    return !plan_.self->stayed_separated(x0_, x, v, plan_.contacts.thickness, duration_, is_next_start);
}

double SelfCulling::relative_speed(const double* v) const {
    const std::int64_t n = plan_.count;
    MotionBound bound;
    for (std::int64_t i = 0; i < n; ++i) bound.include(quad<double>{v[i], v[n + i], v[2 * n + i], 0.0});
    return bound.diameter();
}

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

}  // namespace cloth::contact
