// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact of the cloth with itself: who is near whom, and what steps have to follow.
#pragma once

#include "self_friction.hpp"
#include "self_gaps.hpp"

namespace cloth {

/// Upper bound of how far any two particles have moved relative to each other: the diagonal of the box that holds all
/// displacements. NaN where a displacement is not finite.
class Spread {
public:
    CLOTH_INLINE void take(quad<double> way) {
        low_ = smaller(way, low_);
        high_ = larger(way, high_);
        none_ = fma(way, quad<double>{}, none_);
    }
    double most() const {
        const quad<double> w = high_ - low_ + none_;
        return root(norm2(Vec3<double>{w[0], w[1], w[2]}));
    }

private:
    quad<double> low_ = quad<double>{} + 1e300, high_ = quad<double>{} - 1e300, none_{};
};

/// What of a surface is near itself, kept from one call to the next. Positions are quads.
class SelfContact {
public:
    Surface surface;
    /// Friction between layers.
    Roughness rough;
    bool rubs() const { return rough.still > 0.0; }
    /// Of the last `find`: pairs that are near.
    PairList triangles, edges;
    std::vector<double> triangle_squares, edge_squares;
    /// Least reach of a list of pairs, as a fraction of the shortest edge: neighbours of neighbours in a flat sheet are
    /// beyond it.
    static constexpr double usual = 0.6;
    bool keeps = true;  ///< false makes a new list every time, for tests

    std::array<Index, 4> triangle_corners(std::size_t k) const {
        const auto& t = surface.triangles[triangles.second[k]];
        return {triangles.first[k], t[0], t[1], t[2]};
    }
    std::array<Index, 4> edge_corners(std::size_t k) const {
        const auto &a = surface.edges[edges.first[k]], &b = surface.edges[edges.second[k]];
        return {a[0], a[1], b[0], b[1]};
    }

    /// Find the pairs of a particle and a triangle that are nearer than thickness + beyond [m], and the pairs of edges
    /// that are nearer than thickness / 2 + beyond. False where a position is not finite, or where thickness + beyond
    /// is at least four times the shortest edge.
    bool find(const double* x, double thickness, double beyond) {
        if (!(thickness + beyond < 4.0 * surface.shortest)) return false;
        const bool often = beyond <= usually * thickness;
        if (!(often ? holds_middle(x, thickness, beyond) : holds_far(x, thickness, beyond))) {
            if (!sees(x, thickness)) return false;
            if (often)
                take_middle(x, beyond);
            else
                take_far(x, beyond);
        }
        const NearPairs& from = often ? middle_.pairs : far_.pairs;
        from.triangle_squares(surface, x, all_);
        choose(from.triangles, thickness + beyond, triangles, &triangle_squares);
        from.edge_squares(surface, x, all_);
        choose(from.edges, 0.5 * thickness + beyond, edges, &edge_squares);
        return true;
    }
    /// The same for a run, in every step: `gaps` in place of triangles. `moved` is how far particles have moved relative to
    /// each other since the last call [m], at most; after anything else than that it is infinite.
    bool follow(const double* x, double thickness, double beyond, double moved) {
        if (!(thickness + beyond < 4.0 * surface.shortest)) return false;
        way_ += moved;
        if (!keeps || thickness != thickness_ || !(beyond + way_ <= near_.beyond)) {
            if (!sees(x, thickness)) return false;
            way_ = since(x, near_.places);
            if (!keeps || !(beyond + way_ <= near_.beyond)) {
                take_near(x, beyond);
                way_ = 0.0;
            }
        }
        gaps.find(x, thickness, thickness + beyond);
        near_.pairs.edge_squares(surface, x, all_);
        choose(near_.pairs.edges, 0.5 * thickness + beyond, edges, &edge_squares);
        return true;
    }
    /// What `follow` found, and the pairs of a particle and a triangle that it looked at, as many as `gaps.square`.
    SelfGaps gaps;
    const PairList& followed() const { return near_.pairs.triangles; }

private:
    static constexpr double neighbours = 0.95;  ///< as a fraction of the shortest edge
    /// Extra reach of a list that is looked at in some steps, as a fraction of the thickness, and of one that is looked at
    /// in every step: as many times the way that is looked ahead, but no less than a fraction of the thickness.
    static constexpr double usually = 0.3, steps = 6.0, least = 0.02;

    /// Pairs, where particles were as they were found, and how far beyond the thickness they reach.
    struct Found {
        NearPairs pairs;
        Array<double> places;
        double beyond = -1.0;
    };

    /// How far particles have moved relative to each other since they were at some places, none of them known at first.
    double since(const double* x, const Array<double>& places) const {
        Spread spread;
        if (static_cast<std::int64_t>(places.size()) == 4 * surface.count)
            for (std::int64_t i = 0; i < surface.count; ++i) spread.take(load4(x + 4 * i) - load4(places.data() + 4 * i));
        else
            for (std::int64_t i = 0; i < surface.count; ++i) spread.take(load4(x + 4 * i));
        return spread.most();
    }
    /// Whether particles are where pairs can be found. Lists of another thickness are forgotten.
    bool sees(const double* x, double thickness) {
        if (!(since(x, far_.places) < 1e30)) return false;
        if (thickness != thickness_) far_.pairs.reach = middle_.beyond = near_.beyond = -1.0;
        thickness_ = thickness;
        return true;
    }
    /// Whether a list has all pairs within the thickness and beyond. It has none for positions that are not finite.
    bool holds_far(const double* x, double thickness, double beyond) const {
        return keeps && thickness == thickness_ && thickness + beyond + since(x, far_.places) <= far_.pairs.reach;
    }
    bool holds_middle(const double* x, double thickness, double beyond) const {
        return keeps && thickness == thickness_ && beyond + since(x, middle_.places) <= middle_.beyond;
    }
    void take_far(const double* x, double beyond) {
        if (holds_far(x, thickness_, beyond)) return;
        // The further it reaches, the longer it holds; but from the shortest edge on it has all neighbours in a flat sheet.
        const double wanted = thickness_ + beyond, longer = smaller(1.5 * wanted, neighbours * surface.shortest);
        // Edges keep half the thickness.
        far_.pairs.make(surface, x, larger(usual * surface.shortest, larger(1.2 * wanted, longer)), 0.5 * thickness_);
        far_.places.assign(x, x + 4 * surface.count);
    }
    void take_middle(const double* x, double beyond) {
        if (holds_middle(x, thickness_, beyond)) return;
        take_far(x, beyond + usually * thickness_);
        narrow(x, far_.pairs, beyond + usually * thickness_, middle_);
    }
    void take_near(const double* x, double beyond) {
        beyond += smaller(larger(steps * beyond, least * thickness_), usually * thickness_);
        take_middle(x, beyond);
        narrow(x, middle_.pairs, beyond, near_);
        gaps.offer(surface, near_.pairs.triangles, x, thickness_ + beyond);
    }
    /// Those of some pairs that are within the thickness and beyond.
    void narrow(const double* x, const NearPairs& from, double beyond, Found& to) {
        from.triangle_squares(surface, x, all_);
        choose(from.triangles, thickness_ + beyond, to.pairs.triangles, nullptr);
        from.edge_squares(surface, x, all_);
        choose(from.edges, 0.5 * thickness_ + beyond, to.pairs.edges, nullptr);
        to.places.assign(x, x + 4 * surface.count);
        to.beyond = beyond;
    }
    void choose(const PairList& from, double reach, PairList& to, std::vector<double>* squares) const {
        to.clear();
        if (squares) squares->clear();
        for (std::size_t k = 0; k < from.size(); ++k)
            if (all_[k] < reach * reach) {
                to.add(from.first[k], from.second[k]);
                if (squares) squares->push_back(all_[k]);
            }
    }
    /// Each a part of the one before.
    Found far_, middle_, near_;
    double thickness_ = 0.0, way_ = 0.0;
    std::vector<double> all_;
};

/// Squared frequency [1/s^2] and damping rate [1/s].
struct SelfRates {
    double omega2 = 0.0, damping = 0.0;
};

/// What contact has taken up and will have to: energy per mass in units of U^2/2 of particles and of edges; and by how much
/// stiffness over mass exceeds that of a single gap, at the particle that most acts on (Gershgorin: a pair's stiffness
/// k g g' is at most 2 k |g_c| at each of its corners).
class Demand {
public:
    /// Least stiffness over mass, relative to that of a single gap: two layers in contact push each other.
    static constexpr double usual = 2.0;
    double reached[2] = {}, gap = 1e30;

    /// A particle's or a pair of edges' meeting at its closing speed.
    template <class V>
    void take(const Surface& s, const Meeting<V>& m) {
        if (m.gaps.empty()) return;
        gap = smaller(m.least(), gap);
        enter(m.edges, m.closing(), value_of(m.shape));
        for (const auto& g : m.gaps)
            for (int k = 0; k < 4; ++k) {
                const Index c = g.corner[k];
                if ((!m.edges && k && c == g.corner[0]) || !s.moves[c]) continue;
                const double weight = absolute(value_of(g.weight[k]));
                add(m.edges, c, s.count, 2.0 * g.sign * m.mass * weight / s.masses[c]);
            }
    }
    /// A gap that closes at a speed and holds an energy already. Where two masses meet, one may stand still: then all of
    /// m w^2/2 goes into half of m U^2/2 b.
    void enter(bool edges, double closing, double shape = 0.0) {
        reach(edges, energy_to_stop(closing, shape));
    }
    void reach(bool edges, double energy) { reached[edges] = larger(energy, reached[edges]); }
    /// Take in what stiffness adds up to at particles, over that of a single gap, and forget it: the fourth number of
    /// each of so many quads, times one over the mass.
    void gather(const Surface& s, double* f) {
        // Four at a time: each waits for the one before it.
        quad<double> most[4] = {};
        for (std::int64_t i = 0; i < s.count; ++i) {
            const quad<double> all = load4(f + 4 * i);
            most[i % 4] = larger(quad<double>(all * s.inverse[i]), most[i % 4]);
            store4(f + 4 * i, quad<double>{all[0], all[1], all[2], 0.0});
        }
        for (const quad<double>& each : most) crowd_[0] = larger(each[3], crowd_[0]);
    }
    /// Take in a pair that is not in contact yet and comes into contact within a duration [s]: the step has to be short
    /// enough for its closing speed before that. What closes slower than `from` [m/s] does not count.
    void come(const std::array<Index, 4>& corner, bool edges, const SelfLaw<double>& law, const Quads& at,
              const Quads& moving, double duration, double from = 0.0) {
        Vec3<double> way, speed;
        const Vec3<double> v[4] = {moving(corner[0]), moving(corner[1]), moving(corner[2]), moving(corner[3])};
        if (edges) {
            const auto n = near_segments(at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3]));
            way = n.away;
            speed = v[0] + n.first * (v[1] - v[0]) - v[2] - n.second * (v[3] - v[2]);
        } else {
            const auto n = near_triangle(at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3]));
            way = n.away;
            speed = v[0] - n.weight[0] * v[1] - n.weight[1] * v[2] - n.weight[2] * v[3];
        }
        const Scaling<double> scaling =
            edges ? law.scaling({corner[0], corner[1]}, {corner[2], corner[3]}) : law.scaling(corner[0]);
        const double away = root(norm2(way)), closing = scaling.closing(away, -dot(way, speed) / away);
        const double left = scaling.gap(away) - law.thickness(edges);
        if (left >= 0.0 && left < duration * closing && closing >= from) enter(edges, closing);
    }
    /// Look at what was added since the last time.
    void close() {
        for (int edges = 0; edges < 2; ++edges) {
            for (const Index c : touched_[edges]) {
                crowd_[edges] = larger(load_[edges][c], crowd_[edges]);
                load_[edges][c] = 0.0;
            }
            touched_[edges].clear();
        }
    }
    /// `rubbing` [1/s^2] is the squared frequency of anchors' springs, which act wherever particles meet.
    SelfRates rates(double thickness, double damping, double expected = 1.0, double rubbing = 0.0,
                    double frequency = 1.0) const {
        SelfRates r;
        if (reached[0] > 0.0) {
            r.omega2 += rubbing;
            r.damping += FrictionLaw<double>::damping_share / frequency * rubbing;
        }
        for (int edges = 0; edges < 2; ++edges) {
            if (!(reached[edges] > 0.0)) continue;
            const double d = edges ? 0.5 * thickness : thickness, crowd = larger(crowd_[edges], usual);
            const ContactLaw<double> law(d, damping);
            const double at = stopping_gap(expected * reached[edges]) * d;
            r.omega2 += crowd * law.stiffness(at);
            r.damping += crowd * law.damping(at);
        }
        return r;
    }

private:
    void add(bool edges, Index c, std::int64_t count, double load) {
        auto& all = load_[edges];
        if (all.empty()) all.assign(count, 0.0);
        if (all[c] == 0.0) touched_[edges].push_back(c);
        all[c] += load;
    }
    double crowd_[2] = {};
    std::vector<double> load_[2];
    std::vector<Index> touched_[2];
};

/// Call `particle(i, first, last)` with ranges of a particle's triangles, and `edge(k)` with each pair of edges, that
/// `find` found.
template <class P, class E>
inline void for_each_near(const SelfContact& self, P&& particle, E&& edge) {
    const PairList& t = self.triangles;
    for (std::size_t first = 0, last; first < t.size(); first = last) {
        for (last = first; last < t.size() && t.first[last] == t.first[first];) ++last;
        particle(t.first[first], first, last);
    }
    for (std::size_t k = 0; k < self.edges.size(); ++k) edge(k);
}

}  // namespace cloth
