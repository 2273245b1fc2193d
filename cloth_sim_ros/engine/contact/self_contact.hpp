// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Self-contact: Verlet lists (neighbour lists) of near pairs, and stiffness bounds for step control.
#pragma once

#include <array>
#include <cstring>
#include <memory>

#include "contact/self_friction.hpp"
#include "contact/self_gaps.hpp"
#include "contact/sheet_separation.hpp"
#include "plan/workspace.hpp"

namespace cloth::contact {

using laws::stopping_gap;

/// Upper bound of the relative motion of any two particles: diagonal of the bounding box of all displacements. NaN if a
/// displacement is not finite.
class MotionBound {
public:
    CLOTH_INLINE void include(quad<double> displacement) {
        low_ = smaller(displacement, low_);
        high_ = larger(displacement, high_);
        nan_check_ = fma(displacement, quad<double>{}, nan_check_);
    }
    double diameter() const {
        const quad<double> w = high_ - low_ + nan_check_;
        return root(norm2(Vec3<double>{w[0], w[1], w[2]}));
    }

private:
    quad<double> low_ = quad<double>{} + 1e300, high_ = quad<double>{} - 1e300, nan_check_{};
};

/// Verlet lists of a surface, kept between calls. Positions are quads. Concurrent runs need one each.
class SelfVerletList {
public:
    /// The surface must outlive the lists. Without `caches` each call rebuilds them, for tests.
    SelfVerletList(const Surface& surface, bool caches) : surface(surface), caches(caches) {}

    const Surface& surface;
    bool caches;
    /// Pairs of the last `find`.
    PairList triangles, edges;
    std::vector<double> triangle_squares, edge_squares;
    /// Least range of a list, as a fraction of the shortest edge: next-nearest neighbours in a flat sheet are beyond
    /// it.
    static constexpr double min_reach = 0.6;

    /// Forget the pairs of the last `find`.
    void clear_pairs() {
        triangles.clear();
        edges.clear();
        triangle_squares.clear();
        edge_squares.clear();
    }

    std::array<Index, 4> triangle_corners(std::size_t k) const {
        const auto& t = surface.triangles[triangles.second[k]];
        return {triangles.first[k], t[0], t[1], t[2]};
    }
    std::array<Index, 4> edge_corners(std::size_t k) const {
        const auto &a = surface.edges[edges.first[k]], &b = surface.edges[edges.second[k]];
        return {a[0], a[1], b[0], b[1]};
    }

    /// Find the pairs of a particle and a triangle nearer than thickness + margin [m], and the pairs of edges nearer
    /// than thickness / 2 + margin. Return false if a position is not finite, or if thickness + margin is at least four
    /// times the shortest edge.
    bool find(const double* x, double thickness, double margin) {
        if (!(thickness + margin < 4.0 * surface.shortest)) return false;
        const bool use_middle = margin <= middle_margin * thickness;
        if (!(use_middle ? covers_middle(x, thickness, margin) : covers_outer(x, thickness, margin))) {
            if (!check_positions(x, thickness)) return false;
            if (use_middle)
                rebuild_middle(x, margin);
            else
                rebuild_outer(x, margin);
        }
        const SurfacePairs& from = use_middle ? middle_.pairs : outer_.pairs;
        from.triangle_squares(surface, x, squares_);
        filter(from.triangles, thickness + margin, triangles, &triangle_squares);
        from.edge_squares(surface, x, squares_);
        filter(from.edges, 0.5 * thickness + margin, edges, &edge_squares);
        return true;
    }
    /// The same for each step of a run, with `gaps` in place of triangles. `motion`: upper bound of the relative motion
    /// of particles since the last call [m]; infinite after any other call.
    bool update(const double* x, double thickness, double margin, double motion) {
        if (!(thickness + margin < 4.0 * surface.shortest)) return false;
        motion_ += motion;
        if (!caches || thickness != thickness_ || !(margin + motion_ <= inner_.margin)) {
            if (!check_positions(x, thickness)) return false;
            motion_ = motion_since(x, inner_.positions);
            if (!caches || !(margin + motion_ <= inner_.margin)) {
                rebuild_inner(x, margin);
                motion_ = motion_since(x, inner_.positions);
            }
        }
        gaps.find(x, thickness, thickness + margin);
        inner_.pairs.edge_squares(surface, x, squares_);
        filter(inner_.pairs.edges, 0.5 * thickness + margin, edges, &edge_squares);
        return true;
    }
    /// Result of `update`, and the pairs of a particle and a triangle that it evaluated, as many as `gaps.square`.
    SelfGaps gaps;
    const PairList& inner_pairs() const { return inner_.pairs.triangles; }

private:
    static constexpr double max_reach = 0.95;  ///< as a fraction of the shortest edge
    /// Margin of the middle list, as a fraction of the thickness, and of the inner list: a multiple of the look-ahead
    /// distance, at least a fraction of the thickness.
    static constexpr double middle_margin = 0.3, inner_margin_factor = 6.0, min_inner_margin = 0.02;

    /// A level of the Verlet list: pairs, positions when they were found, and margin beyond the thickness.
    struct ListLevel {
        SurfacePairs pairs;
        Array<double> positions;
        double margin = -1.0;
    };

    /// Relative motion of particles since reference positions; since the origin if there are none.
    double motion_since(const double* x, const Array<double>& reference) const {
        MotionBound motion;
        if (static_cast<std::int64_t>(reference.size()) == 4 * surface.count)
            for (std::int64_t i = 0; i < surface.count; ++i)
                motion.include(load4(x + 4 * i) - load4(reference.data() + 4 * i));
        else
            for (std::int64_t i = 0; i < surface.count; ++i) motion.include(load4(x + 4 * i));
        return motion.diameter();
    }
    /// Return whether positions are finite. Clears lists of another thickness.
    bool check_positions(const double* x, double thickness) {
        if (!(motion_since(x, outer_.positions) < 1e30)) return false;
        if (thickness != thickness_) outer_.margin = middle_.margin = inner_.margin = -1.0;
        thickness_ = thickness;
        return true;
    }
    /// Whether a list contains all pairs within the thickness and the margin. False for positions that are not finite.
    bool covers_outer(const double* x, double thickness, double margin) const {
        return caches && thickness == thickness_ && margin + motion_since(x, outer_.positions) <= outer_.margin;
    }
    bool covers_middle(const double* x, double thickness, double margin) const {
        return caches && thickness == thickness_ && margin + motion_since(x, middle_.positions) <= middle_.margin;
    }
    void rebuild_outer(const double* x, double margin) {
        if (covers_outer(x, thickness_, margin)) return;
        // The longer its range, the longer it is valid; but beyond the shortest edge it contains all neighbours in a
        // flat sheet.
        const double range = thickness_ + margin, longer = smaller(1.5 * range, max_reach * surface.shortest);
        // Edges have half the thickness.
        outer_.pairs.build(surface, x, larger(min_reach * surface.shortest, larger(1.2 * range, longer)),
                           0.5 * thickness_);
        outer_.positions.assign(x, x + 4 * surface.count);
        outer_.margin = outer_.pairs.reach - thickness_;
    }
    void rebuild_middle(const double* x, double margin) {
        if (covers_middle(x, thickness_, margin)) return;
        rebuild_outer(x, margin + middle_margin * thickness_);
        prune(x, outer_, margin + middle_margin * thickness_, middle_);
    }
    void rebuild_inner(const double* x, double margin) {
        margin +=
            smaller(larger(inner_margin_factor * margin, min_inner_margin * thickness_), middle_margin * thickness_);
        rebuild_middle(x, margin);
        prune(x, middle_, margin, inner_);
        gaps.set_candidates(surface, inner_.pairs.triangles, x, thickness_ + margin);
    }
    /// Keep the pairs within the thickness and the margin. Without pairs, both levels are valid as long as each other.
    void prune(const double* x, const ListLevel& from, double margin, ListLevel& to) {
        const SurfacePairs& pairs = from.pairs;
        if (pairs.empty()) {
            to.pairs.clear();
            to.positions = from.positions;
            to.margin = from.margin;
            return;
        }
        pairs.triangle_squares(surface, x, squares_);
        filter(pairs.triangles, thickness_ + margin, to.pairs.triangles, nullptr);
        pairs.edge_squares(surface, x, squares_);
        filter(pairs.edges, 0.5 * thickness_ + margin, to.pairs.edges, nullptr);
        to.positions.assign(x, x + 4 * surface.count);
        to.margin = margin;
    }
    void filter(const PairList& from, double reach, PairList& to, std::vector<double>* squares) const {
        to.clear();
        if (squares) squares->clear();
        for (std::size_t k = 0; k < from.size(); ++k)
            if (squares_[k] < reach * reach) {
                to.add(from.first[k], from.second[k]);
                if (squares) squares->push_back(squares_[k]);
            }
    }
    /// Each level is a part of the one before.
    ListLevel outer_, middle_, inner_;
    double thickness_ = 0.0, motion_ = 0.0;
    std::vector<double> squares_;
};

/// Self-contact of a plan.
class SelfContact {
public:
    Surface surface;
    /// Bound that makes a search for pairs unnecessary where parts of a regular sheet are far from each other.
    SheetSeparation separation;
    /// Friction coefficients between layers.
    FrictionCoefficients friction;
    bool has_friction() const { return friction.at_rest > 0.0; }

    /// Verlet lists of a workspace. Queries use those of the first.
    SelfVerletList& neighbors(int workspace = 0) {
        auto& lists = neighbors_[workspace];
        if (!lists) lists = std::make_unique<SelfVerletList>(surface, caches_);
        return *lists;
    }
    /// Whether Verlet lists are kept between calls.
    void set_caches(bool caches) {
        caches_ = caches;
        for (const auto& lists : neighbors_)
            if (lists) lists->caches = caches;
    }

    /// Distance [m] that a sheet must keep from itself in a frame of a duration [s], if runs skip contact. It covers
    /// what paths in the frame deviate from straight ones.
    static double separation_needed(double thickness, double duration) { return thickness + speed_margin * duration; }
    /// Whether a regular sheet at positions x and velocities v, (3, n), stays separated from itself for a duration [s]
    /// at these velocities. False if that is not clear without a search for pairs.
    bool stays_separated(const double* x, const double* v, double thickness, double duration) {
        if (!separation.applies()) return false;
        const std::array<double, 2> limits{duration, separation_needed(thickness, duration)};
        const std::size_t size = 3 * static_cast<std::size_t>(surface.count);
        const auto is_same = [&](const Array<double>& a, const double* b) {
            return a.size() == size && !std::memcmp(a.data(), b, size * sizeof(double));
        };
        if (!(limits == checked_limits_ && is_same(checked_x_, x) && is_same(checked_v_, v)))
            keep_check(x, v, limits, separation.bound(x, {v, duration}, limits[1]) >= limits[1]);
        return is_separated_;
    }
    /// Whether a sheet that `stays_separated` has done so on its way from positions x0 to x and velocities v at the end
    /// of a frame: on straight paths, and backwards from the end at the velocities v.
    bool stayed_separated(const double* x0, const double* x, const double* v, double thickness, double duration) {
        const double needed = separation_needed(thickness, duration);
        const auto reversed = [&](auto&& component) -> const double* {
            motion_back_.resize(3 * static_cast<std::size_t>(surface.count));
            for (std::size_t k = 0; k < motion_back_.size(); ++k) motion_back_[k] = component(k);
            return motion_back_.data();
        };
        const SheetSeparation::Motion straight{reversed([&](std::size_t k) { return x0[k] - x[k]; }), 1.0};
        if (separation.is_clear(x, {straight, {v, duration}}, needed)) {
            // A next frame that starts here stays separated.
            keep_check(x, v, {duration, needed}, true);
            return true;
        }
        return separation.bound(x, straight, needed) >= needed &&
               separation.bound(x, {reversed([&](std::size_t k) { return -v[k]; }), duration}, needed) >= needed;
    }
    /// Whether it is clear without a search for pairs that a regular sheet at positions x, (3, n), is not in contact
    /// with itself. False for any other surface.
    bool is_clear(const double* x, double thickness) { return separation.is_clear(x, {}, thickness); }
    /// Speed that particles may gain in a frame [m/s].
    static constexpr double speed_margin = 0.1;

private:
    void keep_check(const double* x, const double* v, const std::array<double, 2>& limits, bool is_separated) {
        const std::size_t size = 3 * static_cast<std::size_t>(surface.count);
        checked_limits_ = limits;
        checked_x_.assign(x, x + size);
        checked_v_.assign(v, v + size);
        is_separated_ = is_separated;
    }
    /// Arguments and result of `stays_separated`.
    std::array<double, 2> checked_limits_{-1.0, -1.0};
    Array<double> checked_x_, checked_v_;
    /// Velocities or displacement of `stayed_separated`, reversed.
    std::vector<double> motion_back_;
    bool is_separated_ = false;
    std::array<std::unique_ptr<SelfVerletList>, plan::max_concurrency> neighbors_;
    bool caches_ = true;
};

/// Stiffness bound of self-contact: the energy per mass that it absorbs, in units of U^2/2, for particles and for
/// edges; and the largest row sum of stiffness over mass relative to a single gap (Gershgorin: a pair's stiffness k g
/// g' is at most 2 k |g_c| at each of its corners).
class StiffnessBound {
public:
    /// Least row sum relative to a single gap: two layers in contact push each other.
    static constexpr double min_row_sum = 2.0;
    double encountered[2] = {}, gap = 1e30;

    /// Include the contact of a particle or of a pair of edges.
    template <class V>
    void include(const Surface& s, const Contact<V>& m) {
        if (m.gaps.empty()) return;
        gap = smaller(m.min_gap(), gap);
        add_contact(m.edges, m.max_closing(), value_of(m.shape));
        for (const auto& g : m.gaps)
            for (int k = 0; k < 4; ++k) {
                const Index c = g.corner[k];
                if ((!m.edges && k && c == g.corner[0]) || !s.is_free[c]) continue;
                const double weight = absolute(value_of(g.weight[k]));
                add(m.edges, c, s.count, 2.0 * g.sign * m.mass * weight / s.masses[c]);
            }
    }
    /// Add a gap with a closing speed and a contact energy. One of the two masses may be at rest: then m w^2/2 is
    /// converted into half of m U^2/2 b.
    void add_contact(bool edges, double closing, double shape = 0.0) {
        include_energy(edges, energy_to_stop(closing, shape));
    }
    void include_energy(bool edges, double energy) { encountered[edges] = larger(energy, encountered[edges]); }
    /// Include the row sums collected as the fourth number of each quad, times the inverse mass, and clear them.
    void gather_row_sums(const Surface& s, double* f) {
        // Four independent maxima, because each waits for the one before.
        quad<double> max[4] = {};
        for (std::int64_t i = 0; i < s.count; ++i) {
            const quad<double> force = load4(f + 4 * i);
            max[i % 4] = larger(quad<double>(force * s.inverse[i]), max[i % 4]);
            store4(f + 4 * i, quad<double>{force[0], force[1], force[2], 0.0});
        }
        for (const quad<double>& lane_max : max) row_sum_[0] = larger(lane_max[3], row_sum_[0]);
    }
    /// Add a pair that comes into contact within a duration [s], because the step has to be short enough for its
    /// closing speed before that. Slower ones than `min_speed` [m/s] are ignored.
    void add_approaching(const std::array<Index, 4>& corner, bool edges, const SelfLaw<double>& law, const Quads& at,
                         const Quads& velocity, double duration, double min_speed = 0.0) {
        Vec3<double> offset, relative_velocity;
        const Vec3<double> v[4] = {velocity(corner[0]), velocity(corner[1]), velocity(corner[2]), velocity(corner[3])};
        if (edges) {
            const auto n = near_segments(at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3]));
            offset = n.away;
            relative_velocity = v[0] + n.first * (v[1] - v[0]) - v[2] - n.second * (v[3] - v[2]);
        } else {
            const auto n = near_triangle(at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3]));
            offset = n.away;
            relative_velocity = v[0] - n.weight[0] * v[1] - n.weight[1] * v[2] - n.weight[2] * v[3];
        }
        const Scaling<double> scaling =
            edges ? law.scaling({corner[0], corner[1]}, {corner[2], corner[3]}) : law.scaling(corner[0]);
        const double distance = root(norm2(offset)),
                     closing = scaling.closing(distance, -dot(offset, relative_velocity) / distance);
        const double remaining = scaling.gap(distance) - law.thickness(edges);
        if (remaining >= 0.0 && remaining < duration * closing && closing >= min_speed) add_contact(edges, closing);
    }
    /// Include the row sums collected since the last call, and clear them.
    void flush() {
        for (int edges = 0; edges < 2; ++edges) {
            for (const Index c : loaded_[edges]) {
                row_sum_[edges] = larger(load_[edges][c], row_sum_[edges]);
                load_[edges][c] = 0.0;
            }
            loaded_[edges].clear();
        }
    }
    /// `friction_omega2` [1/s^2]: squared frequency of the anchor springs, which act at every contact.
    ContactBounds bounds(double thickness, double damping, double expected = 1.0, double friction_omega2 = 0.0,
                         double frequency = 1.0) const {
        ContactBounds r;
        if (encountered[0] > 0.0) {
            r.omega2 += friction_omega2;
            r.damping += FrictionLaw<double>::damping_per_frequency / frequency * friction_omega2;
        }
        for (int edges = 0; edges < 2; ++edges) {
            if (!(encountered[edges] > 0.0)) continue;
            const double d = edges ? 0.5 * thickness : thickness, row_sum = larger(row_sum_[edges], min_row_sum);
            const ContactLaw<double> law(d, damping);
            const double at = stopping_gap(expected * encountered[edges]) * d;
            r.omega2 += row_sum * law.stiffness(at);
            r.damping += row_sum * law.damping(at);
        }
        return r;
    }

private:
    void add(bool edges, Index c, std::int64_t count, double load) {
        auto& all = load_[edges];
        if (all.empty()) all.assign(count, 0.0);
        if (all[c] == 0.0) loaded_[edges].push_back(c);
        all[c] += load;
    }
    double row_sum_[2] = {};
    std::vector<double> load_[2];
    std::vector<Index> loaded_[2];
};

/// Call particle(i, first, last) with the range of triangles of each particle, and edge(k) with each pair of edges of
/// `find`.
template <class P, class E>
inline void for_each_neighbor(const SelfVerletList& neighbors, P&& particle, E&& edge) {
    const PairList& t = neighbors.triangles;
    for (std::size_t first = 0, last; first < t.size(); first = last) {
        for (last = first; last < t.size() && t.first[last] == t.first[first];) ++last;
        particle(t.first[first], first, last);
    }
    for (std::size_t k = 0; k < neighbors.edges.size(); ++k) edge(k);
}

}  // namespace cloth::contact
