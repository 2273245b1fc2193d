// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What is asked of the cloth's contact with itself beside its forces: energy, power, bounds, derivative product, what is
// about to happen, and what would pass through what. Arrays are (3, n) by component.
#pragma once

#include "self_friction_measures.hpp"

namespace cloth {

/// An array (3, n) as quads, as particles stand inside runs.
inline Array<double> quads_of(const Plan& plan, const double* a) {
    Array<double> out(4 * plan.count, 0.0);
    for (int c = 0; a && c < 3; ++c)
        for (std::int64_t i = 0; i < plan.count; ++i) out[4 * plan.rank[i] + c] = a[c * plan.count + i];
    return out;
}

/// Call `what` with each meeting, and where and how fast particles are, at positions x and velocities v (quads, with
/// derivatives dx and dv where V has them).
/// Nothing meets where particles have no place.
template <class V, class F>
inline void for_each_meeting(SelfContact& self, const SelfLaw<V>& law, double thickness, const Quads (&x)[2],
                             const Quads (&v)[2], F&& what) {
    if (!self.find(x[0].from, thickness, 0.0)) return;
    const auto of = [](const Quads (&a)[2]) {
        return [&a](Index c) {
            if constexpr (std::is_same_v<V, double>)
                return a[0](c);
            else
                return with_slope(a[0](c), a[1](c));
        };
    };
    const auto at = of(x), moving = of(v);
    const Surface& s = self.surface;
    Meeting<V> m;
    const auto tell = [&] {
        if (!m.gaps.empty()) what(m, at, moving);
    };
    for_each_near(
        self,
        [&](Index i, std::size_t first, std::size_t last) {
            const Index* const triangles = self.triangles.second.data();
            law.particle(s, i, triangles + first, triangles + last, at, moving, m);
            tell();
        },
        [&](std::size_t k) {
            law.edges(s, s.edges[self.edges.first[k]], s.edges[self.edges.second[k]], at, moving, m);
            tell();
        });
}
template <class F>
inline void for_each_meeting(Plan& plan, double t, const double* x, const double* v, F&& what) {
    const Contacts& contacts = plan.contacts;
    const Array<double> places = quads_of(plan, x), speeds = quads_of(plan, v);
    const Quads at[2] = {{places.data()}, {nullptr}}, moving[2] = {{speeds.data()}, {nullptr}};
    SelfLaw<double> law(contacts.thickness, contacts.damping);
    std::vector<Scaling<double>> scalings;
    self_scalings(plan, t, scalings);
    law.reduce(&scalings);
    for_each_meeting<double>(*plan.self, law, contacts.thickness, at, moving,
                             [&](const Meeting<double>& m, auto& where, auto& speed) { what(law, m, where, speed); });
}

inline double self_energy(Plan& plan, double t, const double* x) {
    double total = 0.0;
    for_each_meeting(plan, t, x, nullptr, [&](const SelfLaw<double>& law, const Meeting<double>& m, auto& at, auto& moving) {
        total += law.energy(m) + layer_energy(plan, law, m, at, moving);
    });
    return total;
}
/// Power that damping and friction take [W].
inline double self_lost(Plan& plan, double t, const double* x, const double* v) {
    double lost = 0.0;
    for_each_meeting(plan, t, x, v, [&](const SelfLaw<double>& law, const Meeting<double>& m, auto& at, auto& moving) {
        lost += law.lost(m) + layer_lost(plan, law, m, at, moving);
    });
    return lost;
}
/// Power that friction between layers takes [W].
inline double self_rubbed(Plan& plan, double t, const double* x, const double* v) {
    double lost = 0.0;
    for_each_meeting(plan, t, x, v, [&](const SelfLaw<double>& law, const Meeting<double>& m, auto& at, auto& moving) {
        lost += layer_lost(plan, law, m, at, moving);
    });
    return lost;
}
/// Power of the growth of contacts with a reduced thickness [W].
inline double self_grown(Plan& plan, double t, const double* x, const double* v) {
    double grown = 0.0;
    for_each_meeting(plan, t, x, v, [&](const SelfLaw<double>& law, const Meeting<double>& m, auto&, auto&) {
        if (law.reduced()) grown += law.grown(m);
    });
    return grown;
}
/// Anchors on layers after runs, see settle_layers; obstacles' come before them.
inline void settle_self(Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                        const double* weights, const double* ends, double* out) {
    if (!plan.rubs()) return;
    const std::int64_t before = plan.contacts.obstacle_anchors(plan.count);
    for_each_meeting(plan, t, x, v, [&](const SelfLaw<double>& law, const Meeting<double>& m, auto& at, auto& moving) {
        settle_layers(plan, law, m, at, moving, runs, weights, ends + before, plan.anchor_count(), out + before);
    });
}

/// Add blocks that bound stiffness and damping: of a gap k g g', g = weights times the normal, at most 2 k |w_c| n n' at
/// corner c, for the weights of either side add up to one. What counts with the other sign only softens.
inline void add_self_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp) {
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    for_each_meeting(plan, t, x, nullptr, [&](const SelfLaw<double>& law, const Meeting<double>& m, auto& at, auto& moving) {
        add_layer_bounds(plan, law, m, at, moving, stiff, damp);
        for (const Gap<double>& g : m.gaps) {
            if (g.sign < 0.0) continue;
            const double faded = m.edges ? m.faded : 1.0;
            const double k = 2.0 * m.mass * faded * law.law(m.edges).stiffness(g.gap);
            const double c = 2.0 * m.mass * faded * law.law(m.edges).damping(g.gap);
            for (int corner = 0; corner < 4; ++corner) {
                if (!m.edges && corner && g.corner[corner] == g.corner[0]) continue;
                const double weight = absolute(g.weight[corner]);
                const std::int64_t i = own[g.corner[corner]];
                if (stiff) add_block(stiff, plan.count, i, outer(k * weight, g.normal, 0.0));
                if (damp) add_block(damp, plan.count, i, outer(c * weight, g.normal, 0.0));
            }
        }
    });
}

/// Add (df/dx) dx + (df/dv) dv to out, by the law itself on numbers with derivatives.
inline void add_self_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                             double* out) {
    const Contacts& contacts = plan.contacts;
    const Array<double> a = quads_of(plan, x), b = quads_of(plan, v), da = quads_of(plan, dx), db = quads_of(plan, dv);
    const Quads at[2] = {{a.data()}, {da.data()}}, moving[2] = {{b.data()}, {db.data()}};
    SelfLaw<Dual> law(contacts.thickness, contacts.damping);
    std::vector<Scaling<double>> scalings;
    self_scalings(plan, t, scalings);
    law.reduce(&scalings);
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    const auto of = [&](const Meeting<Dual>& m, auto& where, auto& speed) {
        add_layer_product(plan, law, m, where, speed, out);
        law.forces(m, [&](Index c, Vec3<Dual> force) {
            out[own[c]] += force.x.slope;
            out[plan.count + own[c]] += force.y.slope;
            out[2 * plan.count + own[c]] += force.z.slope;
        });
    };
    for_each_meeting<Dual>(*plan.self, law, contacts.thickness, at, moving, of);
}

/// Call `what` with each meeting within the whole thickness.
template <class F>
inline void for_each_whole_meeting(Plan& plan, const double* x, F&& what) {
    const Contacts& contacts = plan.contacts;
    const Array<double> places = quads_of(plan, x), speeds = quads_of(plan, nullptr);
    const Quads at[2] = {{places.data()}, {nullptr}}, moving[2] = {{speeds.data()}, {nullptr}};
    const SelfLaw<double> law(contacts.thickness, contacts.damping);
    for_each_meeting<double>(*plan.self, law, contacts.thickness, at, moving,
                             [&](const Meeting<double>& m, auto&, auto&) { what(m); });
}

/// How many particles and pairs of edges are in contact, and the least gap [m] of these, infinite where there are none.
inline void self_gaps(Plan& plan, const double* x, double* out) {
    out[0] = 0.0;
    out[1] = std::numeric_limits<double>::infinity();
    for_each_whole_meeting(plan, x, [&](const Meeting<double>& m) {
        out[0] += 1.0;
        out[1] = smaller(m.least(), out[1]);
    });
}
/// The least gap of each particle's contacts [m], in the caller's order: to triangles, edges and particles within the
/// thickness, and twice that of an edge of the particle with another edge.
inline void self_gap_row(Plan& plan, const double* x, double* out) {
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    for_each_whole_meeting(plan, x, [&](const Meeting<double>& m) {
        const double gap = m.edges ? 2.0 * m.least() : m.least();
        for (int k = 0; k < (m.edges ? 4 : 1); ++k) {
            double& to = out[own[m.gaps[0].corner[k]]];
            to = smaller(gap, to);
        }
    });
}

/// Squared frequency and damping rate that contact comes to where it takes up what it holds, and what comes into contact
/// within a duration [s] as it moves now, times `expected`. Infinite where particles have no place.
inline SelfRates self_ahead(Plan& plan, double t, double duration, double expected, const double* x, const double* v) {
    SelfContact& self = *plan.self;
    const double d = plan.contacts.thickness;
    const Array<double> places = quads_of(plan, x), speeds = quads_of(plan, v);
    Spread spread;
    for (std::int64_t i = 0; i < plan.count; ++i) spread.take(load4(speeds.data() + 4 * i));
    // At most half the shortest edge, so that neighbours in a flat sheet don't count. A later call sees farther pairs.
    const double beyond = smaller(spread.most() * duration, 0.5 * self.surface.shortest);
    Demand demand;
    LayerLoad load;
    SelfLaw<double> law(d, plan.contacts.damping);
    std::vector<Scaling<double>> scalings;
    self_scalings(plan, t, scalings);
    law.reduce(&scalings);
    if (!self.find(places.data(), d, beyond)) {
        const double none = std::numeric_limits<double>::infinity();
        return {none, none};
    }
    const Surface& s = self.surface;
    const Quads at{places.data()}, moving{speeds.data()};
    Meeting<double> m;
    // Edges keep half the thickness. Layers that come slower than this are stopped by their particles before that; edges
    // that meet all the same, in a twist, are seen by the run itself.
    const double fast = ContactLaw<double>::speed * root(0.5 * law.law(false).shape(0.5 * d) / expected);
    for_each_near(
        self,
        [&](Index i, std::size_t first, std::size_t last) {
            const Index* const triangles = self.triangles.second.data();
            law.particle(s, i, triangles + first, triangles + last, at, moving, m);
            demand.take(s, m);
            add_layer_loads(plan, law, m, at, moving, load);
            for (std::size_t k = first; k < last; ++k)
                demand.come(self.triangle_corners(k), false, law, at, moving, duration);
        },
        [&](std::size_t k) {
            law.edges(s, s.edges[self.edges.first[k]], s.edges[self.edges.second[k]], at, moving, m);
            demand.take(s, m);
            demand.come(self.edge_corners(k), true, law, at, moving, duration, fast);
        });
    demand.close();
    load.close();
    const double frequency = plan.contacts.frequency;
    const double rubbing = plan.rubs() ? larger(load.most(), 2.0 * frequency * frequency) : 0.0;
    return demand.rates(d, plan.contacts.damping, expected, rubbing, frequency);
}

/// Whether anything passes through anything on straight ways from x0 to x1: each pair is followed by its gap, which no
/// way is shorter than (additive continuous collision detection, Li et al., Codimensional IPC, 2021).
inline bool self_crosses(Plan& plan, const double* x0, const double* x1) {
    SelfContact& self = *plan.self;
    const double d = plan.contacts.thickness;
    const Array<double> from = quads_of(plan, x0), to = quads_of(plan, x1);
    Spread spread;
    for (std::int64_t i = 0; i < plan.count; ++i)
        spread.take(load4(to.data() + 4 * i) - load4(from.data() + 4 * i));
    const double most = spread.most();
    if (!self.find(from.data(), d, most)) return true;
    const Quads start{from.data()}, end{to.data()};
    const auto meets = [&](const std::array<Index, 4>& corner, bool edges) {
        Vec3<double> way[4];
        for (int k = 0; k < 4; ++k) way[k] = end(corner[k]) - start(corner[k]);
        const auto away = [&](int k) { return root(norm2(way[k] - way[0])); };
        const double other = larger(away(2), away(3)), length = edges ? away(1) + other : larger(away(1), other);
        double part = 0.0;
        for (int tries = 0; part < 1.0; ++tries) {
            Vec3<double> at[4];
            for (int k = 0; k < 4; ++k) at[k] = start(corner[k]) + part * way[k];
            const double square = edges ? near_segments(at[0], at[1], at[2], at[3]).square
                                        : near_triangle(at[0], at[1], at[2], at[3]).square;
            const double gap = root(square);
            if (!(gap > 1e-3 * d) || tries > 1000) return true;
            if (!(length > 0.0)) return false;
            part += gap / length;
        }
        return false;
    };
    bool crosses = false;
    for (std::size_t k = 0; k < self.triangles.size() && !crosses; ++k) crosses = meets(self.triangle_corners(k), false);
    for (std::size_t k = 0; k < self.edges.size() && !crosses; ++k) crosses = meets(self.edge_corners(k), true);
    return crosses;
}

/// Leaves the cloth's contact with itself out of a frame in which no part of the cloth can get near another. At the
/// frame's start no pair may be nearer than the thickness and the distance that particles cover in the frame at twice
/// their present relative speed, plus `slack`. If a run ends with a larger relative speed, all runs of the frame are
/// made again with this contact. Pairs kept from earlier calls make no difference, so no bit depends on it.
class SelfRest {
public:
    SelfRest(Plan& plan, double duration, const double* x0, const double* v0) : plan_(plan) {
        plan.self_rests = false;
        if (!plan.self) return;
        SelfContact& self = *plan.self;
        const Array<double> places = quads_of(plan, x0);
        speed_ = 2.0 * spread(v0) + slack;
        const double beyond = speed_ * duration;
        plan.self_rests = plan.contacts.thickness + beyond < SelfContact::usual * self.surface.shortest &&
                          self.find(places.data(), plan.contacts.thickness, beyond) && self.triangles.size() == 0 &&
                          self.edges.size() == 0;
    }
    /// Whether a run that ended with velocities v has to be made again.
    bool missed(const double* v) const { return plan_.self_rests && !(spread(v) <= speed_); }
    void wake() { plan_.self_rests = false; }

private:
    /// Speed that particles may gain [m/s].
    static constexpr double slack = 0.1;

    double spread(const double* v) const {
        const std::int64_t n = plan_.count;
        Spread all;
        for (std::int64_t i = 0; i < n; ++i) all.take(quad<double>{v[i], v[n + i], v[2 * n + i], 0.0});
        return all.most();
    }
    Plan& plan_;
    double speed_ = 0.0;
};

/// Six times the volume of a tetrahedron, of either sign.
inline double volume(Vec3<double> a, Vec3<double> b, Vec3<double> c, Vec3<double> e) {
    return dot(cross(b - a, c - a), e - a);
}

/// The first edge that passes through a triangle: its particles and the triangle's, five numbers, or -1 where none does.
/// What they have a corner in common with does not count.
inline void self_pierced(Plan& plan, const double* x, std::int64_t* out) {
    const Surface& s = plan.self->surface;
    const Array<double> places = quads_of(plan, x);
    const Quads at{places.data()};
    double longest = 0.0;
    for (const auto& e : s.edges) longest = larger(norm2(at(e[0]) - at(e[1])), longest);
    // A point of a triangle is no further from its edges than the radius of the circle within.
    NearPairs pairs;
    pairs.make(s, places.data(), 0.3 * root(longest));
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    const auto pierces = [&](const std::array<Index, 2>& e, Index triangle) {
        if (triangle < 0 || s.has(triangle, e[0]) || s.has(triangle, e[1])) return false;
        const auto& t = s.triangles[triangle];
        const Vec3<double> p = at(e[0]), q = at(e[1]), a = at(t[0]), b = at(t[1]), c = at(t[2]);
        if (!(volume(a, b, c, p) * volume(a, b, c, q) < 0.0)) return false;
        const double u = volume(p, q, a, b), v = volume(p, q, b, c), w = volume(p, q, c, a);
        if (!((u > 0.0 && v > 0.0 && w > 0.0) || (u < 0.0 && v < 0.0 && w < 0.0))) return false;
        const Index found[5] = {e[0], e[1], t[0], t[1], t[2]};
        for (int k = 0; k < 5; ++k) out[k] = own[found[k]];
        return true;
    };
    // Triangles of an edge lie about its ends.
    const auto with = [&](const std::array<Index, 2>& e, const std::array<Index, 2>& side) {
        for (Index k = s.start[side[0]]; k < s.start[side[0] + 1]; ++k)
            if (s.has(s.fan[k], side[1]) && pierces(e, s.fan[k])) return true;
        return false;
    };
    std::fill(out, out + 5, std::int64_t{-1});
    for (std::size_t k = 0; k < pairs.edges.size(); ++k) {
        const auto &a = s.edges[pairs.edges.first[k]], &b = s.edges[pairs.edges.second[k]];
        if (with(a, b) || with(b, a)) return;
    }
}

}  // namespace cloth
