// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Self-contact: Verlet lists (neighbour lists) of near pairs.
#pragma once

#include <array>
#include <cstring>
#include <memory>

#include "contact/motion_bound.hpp"
#include "contact/self_friction.hpp"
#include "contact/self_gaps.hpp"
#include "contact/sheet_separation.hpp"
#include "plan/workspace.hpp"

namespace cloth::contact {

/// Pairs of the last `find`, by Verlet lists of a surface, kept between calls. Positions are quads. Concurrent runs need
/// one each.
class SelfVerletList : public PairLists {
public:
    /// The surface must outlive the lists. `columns`: see Patches. Without `caches` each call rebuilds them, for tests.
    SelfVerletList(const Surface& surface, std::int64_t columns, bool caches)
        : surface(surface), caches(caches), patches_(surface, columns) {
        neighborhoods_.push_back(std::make_unique<Neighborhood>());
    }

    const Surface& surface;
    bool caches;
    /// Least range of a list, as a fraction of the shortest edge: next-nearest neighbours in a flat sheet are beyond
    /// it.
    static constexpr double min_reach = 0.6;

    /// Find the pairs of a particle and a triangle nearer than thickness + margin [m], and the pairs of edges nearer
    /// than thickness / 2 + margin. Return false if a position is not finite, or if thickness + margin is at least four
    /// times the shortest edge.
    bool find(const double* x, double thickness, double margin) {
        if (!(thickness + margin < 4.0 * surface.shortest) || !check_positions(x, thickness)) return false;
        for (ListLevel* level : levels()) level->margin_left = -1.0;
        const bool use_inner = inner_covers(x, margin), use_middle = margin <= max_inner_margin * thickness;
        const bool is_measured = !use_inner && (use_middle ? update_middle(x, margin, 0.0) : update_outer(x, margin));
        SurfacePairs& from = use_inner ? inner_.pairs : use_middle ? present().middle.pairs : present().outer.pairs;
        if (!is_measured) from.measure(surface, x);
        select(from, thickness + margin, 0.5 * thickness + margin);
        return true;
    }
    /// The same for each step of a run, with `gaps` in place of triangles. `motion`: upper bound of the relative motion
    /// of particles since the last call [m]; infinite after any other call.
    bool update(const double* x, double thickness, double margin, double motion) {
        if (!(thickness + margin < 4.0 * surface.shortest)) return false;
        double margin_left = std::numeric_limits<double>::infinity();
        for (ListLevel* level : levels()) margin_left = smaller(level->margin_left -= motion, margin_left);
        if (!caches || thickness != thickness_ || !(margin <= margin_left))
            if (thickness != thickness_ || !inner_covers(x, margin)) {
                if (!check_positions(x, thickness)) return false;
                rebuild_inner(x, margin);
            }
        gaps.find(x, thickness, thickness + margin);
        inner_.pairs.measure_edges(surface, x);
        edges.select(inner_.pairs.edges, 0.5 * thickness + margin);
        return true;
    }
    /// Whether `find` would find no pairs.
    bool has_no_pairs(const double* x, double thickness, double margin) {
        // Usually the nearest pair of the last search answers that.
        return !nearest_is_within(Quads{x}, thickness + margin) && find(x, thickness, margin) && empty();
    }
    /// Whether the nearest triangle of the last search is within a range [m] at positions at(i).
    template <class X>
    bool nearest_is_within(X&& at, double range) const {
        if (!triangles.size()) return false;
        const double* const squares = triangles.square.data();
        const auto nearest = std::min_element(squares, squares + triangles.size()) - squares;
        return pair_square<false>(pair_corners<false>(surface, triangles, nearest), at) < range * range;
    }
    /// Result of `update`, and the pairs of a particle and a triangle that it evaluated, in the order of `gaps.square`.
    SelfGaps gaps;
    const PairList& inner_pairs() const { return inner_.pairs.triangles; }

private:
    static constexpr double max_reach = 0.95;  ///< as a fraction of the shortest edge
    /// Margin of the inner list beyond the look-ahead distance: a multiple of that, within fractions of the thickness.
    /// The middle list has as much again, but at least another fraction.
    static constexpr double inner_margin_factor = 4.0, min_inner_margin = 0.02, max_inner_margin = 0.3,
                            min_middle_margin = 0.3;

    /// A level of the Verlet list: pairs, the distances of those that it omits from the level before, and a lower bound
    /// of the margin beyond the thickness that is left to these.
    struct ListLevel {
        SurfacePairs pairs;
        Patches::Distances omitted;
        double margin_left = -1.0;
        bool is_valid = false;
        /// A list is invalid while it is made: an exception may end that.
        void invalidate() { is_valid = false, margin_left = -1.0; }
    };

    /// The outer and the middle level, and the patches of the pairs of the outer one.
    struct Neighborhood {
        ListLevel outer, middle;
        Patches::Distances listed;
    };
    Neighborhood& present() { return *neighborhoods_.front(); }
    std::array<ListLevel*, 3> levels() { return {&present().outer, &present().middle, &inner_}; }
    /// Return whether positions are finite. Invalidates lists of another thickness.
    bool check_positions(const double* x, double thickness) {
        MotionBound motion;
        motion.include(x, nullptr, surface.count);
        if (!(motion.diameter() < 1e30)) return false;
        if (thickness != thickness_)
            for (const auto& lists : neighborhoods_) lists->outer.invalidate();
        thickness_ = thickness;
        return true;
    }
    /// Whether a list contains all pairs of the level before within the thickness and a margin. False for positions that
    /// are not finite.
    bool covers(ListLevel& level, const double* x, double margin) {
        if (!caches || !level.is_valid) return false;
        if (!(margin <= level.margin_left)) level.margin_left = patches_.bound(level.omitted, x) - thickness_;
        return margin <= level.margin_left;
    }
    /// Whether the outer list contains all pairs, after one of another neighborhood that does has taken its place.
    bool outer_covers(const double* x, double margin) {
        for (std::size_t k = 0; k < neighborhoods_.size(); ++k) {
            ListLevel& outer = neighborhoods_[k]->outer;
            // The surface has moved since it was the present one.
            if (k) outer.margin_left = -1.0;
            if (!covers(outer, x, margin)) continue;
            if (k) use(k);
            return true;
        }
        return false;
    }
    /// Let a neighborhood be the present one.
    void use(std::size_t k) {
        std::rotate(neighborhoods_.begin(), neighborhoods_.begin() + k, neighborhoods_.begin() + k + 1);
        present().middle.margin_left = -1.0;
        inner_.invalidate();
    }
    /// Whether the inner list contains all pairs.
    bool inner_covers(const double* x, double margin) {
        return outer_covers(x, margin) && covers(present().middle, x, margin) && covers(inner_, x, margin);
    }
    /// Let a list contain all pairs within the thickness and a margin. Return whether it is rebuilt, and measured.
    bool update_outer(const double* x, double margin) {
        if (outer_covers(x, margin)) return false;
        if (caches && neighborhoods_.size() < max_neighborhoods)
            neighborhoods_.push_back(std::make_unique<Neighborhood>());
        use(neighborhoods_.size() - 1);
        auto& [outer, middle, listed] = present();
        outer.invalidate(), middle.invalidate();
        // The longer its range, the longer it is valid; but beyond the shortest edge it contains all neighbours in a
        // flat sheet.
        const double range = thickness_ + margin, longer = smaller(1.5 * range, max_reach * surface.shortest);
        // Edges have half the thickness.
        outer.pairs.build(surface, x, larger(min_reach * surface.shortest, larger(1.2 * range, longer)),
                          0.5 * thickness_);
        patches_.set_beyond(outer.omitted, surface, x, outer.pairs.reach);
        patches_.clear(listed, x);
        for (std::size_t k = 0; k < outer.pairs.triangles.size(); ++k)
            patches_.include<false>(listed, outer.pairs.triangles.first[k], outer.pairs.triangles.second[k], 0.0);
        for (std::size_t k = 0; k < outer.pairs.edges.size(); ++k)
            patches_.include<true>(listed, outer.pairs.edges.first[k], outer.pairs.edges.second[k], 0.0);
        patches_.finish(listed);
        outer.margin_left = outer.pairs.reach - thickness_;
        outer.is_valid = true;
        return true;
    }
    bool update_middle(const double* x, double margin, double extra) {
        if (outer_covers(x, margin) && covers(present().middle, x, margin)) return false;
        margin += larger(extra, min_middle_margin * thickness_);
        const bool is_measured = update_outer(x, margin);
        auto& [outer, middle, listed] = present();
        if (!is_measured) outer.pairs.measure(surface, x);
        middle.invalidate(), inner_.invalidate();
        // Of the many pairs that are omitted, the nearest of each two patches is little further than the margin.
        middle.pairs.select(outer.pairs, thickness_ + margin, 0.5 * thickness_ + margin);
        patches_.set_uniform(middle.omitted, listed, x, thickness_ + margin);
        middle.margin_left = margin;
        middle.is_valid = true;
        return true;
    }
    void rebuild_inner(const double* x, double margin) {
        const double extra =
            smaller(larger(inner_margin_factor * margin, min_inner_margin * thickness_), max_inner_margin * thickness_);
        margin += extra;
        if (!update_middle(x, margin, extra)) present().middle.pairs.measure(surface, x);
        inner_.invalidate();
        prune(x, present().middle, margin, inner_);
        gaps.set_candidates(surface, inner_.pairs.triangles);
        inner_.margin_left = margin;
        inner_.is_valid = true;
    }
    /// Keep the pairs within the thickness and the margin, which are measured at x.
    void prune(const double* x, const ListLevel& from, double margin, ListLevel& to) {
        patches_.clear(to.omitted, x);
        const PairList &near = from.pairs.triangles, &near_edges = from.pairs.edges;
        for (const Index k : to.pairs.triangles.select(near, thickness_ + margin))
            patches_.include<false>(to.omitted, near.first[k], near.second[k], root(near.square[k]));
        for (const Index k : to.pairs.edges.select(near_edges, 0.5 * thickness_ + margin))
            patches_.include<true>(to.omitted, near_edges.first[k], near_edges.second[k],
                                   root(near_edges.square[k]) + 0.5 * thickness_);
        patches_.finish(to.omitted);
    }
    /// Neighborhoods at recent positions, the present one first: runs of a frame pass the same positions. Each level is
    /// a part of the one before; the inner one belongs to the present middle one.
    static constexpr std::size_t max_neighborhoods = 6;
    std::vector<std::unique_ptr<Neighborhood>> neighborhoods_;
    ListLevel inner_;
    Patches patches_;
    double thickness_ = 0.0;
};

/// Self-contact of a plan.
class SelfContact {
public:
    Surface surface;
    /// Columns of a sheet on a grid, zero of any other surface.
    std::int64_t columns = 0;
    /// Set a sheet on a grid, with distances at rest [m] between columns and between rows.
    void set_sheet(std::int64_t sheet_rows, std::int64_t sheet_columns, double column_spacing, double row_spacing) {
        columns = sheet_columns;
        separation_.set(surface, sheet_rows, sheet_columns, column_spacing, row_spacing);
        single_separation_.set(surface, sheet_rows, sheet_columns, column_spacing, row_spacing);
    }
    /// Friction coefficients between layers.
    FrictionCoefficients friction;
    bool has_friction() const { return friction.at_rest > 0.0; }

    /// Verlet lists of a workspace. Queries use those of the first.
    SelfVerletList& neighbors(int workspace = 0) {
        auto& lists = neighbors_[workspace];
        if (!lists) lists = std::make_unique<SelfVerletList>(surface, columns, caches_);
        return *lists;
    }
    /// Whether Verlet lists are kept between calls.
    void set_caches(bool caches) {
        caches_ = caches;
        for (const auto& lists : neighbors_)
            if (lists) lists->caches = caches;
    }

    /// Distance [m] that a sheet must keep from itself at the velocities at the start of a frame of a duration [s], so
    /// that runs skip contact. It leaves paths room to deviate.
    static double separation_needed(double thickness, double duration) { return thickness + max_deviation(duration); }
    /// Distance [m] by which two particles may leave such paths.
    static double max_deviation(double duration) { return speed_margin * duration; }
    /// Whether a regular sheet at positions x and velocities v, (3, n), stays separated from itself for a duration [s]
    /// at these velocities. False if that is not clear without a search for pairs.
    bool stays_separated(const double* x, const double* v, double thickness, double duration) {
        if (!separation_.applies()) return false;
        const std::array<double, 2> limits{duration, separation_needed(thickness, duration)};
        const std::size_t size = 3 * static_cast<std::size_t>(surface.count);
        const auto is_same = [&](const Array<double>& a, const double* b) {
            return a.size() == size && !std::memcmp(a.data(), b, size * sizeof(double));
        };
        if (!(limits == checked_limits_ && is_same(checked_x_, x) && is_same(checked_v_, v))) {
            checked_limits_ = {-1.0, -1.0};
            checked_x_.assign(x, x + size);
            checked_v_.assign(v, v + size);
            // What single precision shows, double precision would show too.
            is_separated_ = single_separation_.separated_motions(x, {{v, duration}}, limits[1]) != 0 ||
                            separation_.separated_motions(x, {{v, duration}}, limits[1]) != 0;
            checked_limits_ = limits;
        }
        return is_separated_;
    }
    /// Whether it is clear at little cost that a sheet keeps the thickness [m] from itself on its path from positions x0
    /// to x. Two particles together leave straight paths by up to a deviation [m].
    bool stayed_separated(const double* x0, const double* x, double deviation, double thickness) {
        return single_separation_.is_clear(x0, thickness + deviation, {{ways_to(x, x0, 0), 1.0}});
    }
    /// Whether it keeps it on its paths from x0 to a middle and from there to x. Each particle deviates from straight
    /// paths by up to these distances [m], (n,).
    bool stayed_separated(const double* x0, const double* middle, const double* x,
                          const std::array<std::vector<double>, 2>& deviations, double thickness) {
        return single_separation_.separated_motions(middle,
                                                    {{ways_to(x0, middle, 0), 1.0, deviations[0].data()},
                                                     {ways_to(x, middle, 1), 1.0, deviations[1].data()}},
                                                    thickness) == 3;
    }
    /// Whether it is clear without a search for pairs that no two parts of a sheet come nearer than a distance [m] within
    /// a duration [s], which may be negative, even if their relative speed closed their distance.
    bool stays_distant(const double* x, const double* v, double distance, double duration) {
        return single_separation_.separated_motions(x, {{v, duration, nullptr, true}}, distance) != 0;
    }
    /// Let the next frames record the paths of particles, or not.
    void record_paths(bool enabled) { path_frames_ = enabled ? max_path_frames : 0; }
    /// Whether the present frame records them; counts it.
    bool records_paths() {
        if (path_frames_ == 0) return false;
        --path_frames_;
        return true;
    }
    /// Whether it is clear without a search for pairs that a regular sheet at positions x, (3, n), is not in contact
    /// with itself. False for any other surface.
    bool is_clear(const double* x, double thickness) { return separation_.is_clear(x, thickness); }
    /// Speed that particles may gain in a frame [m/s].
    static constexpr double speed_margin = 0.1;

private:
    /// Bounds that make a search for pairs unnecessary where parts of a regular sheet are far from each other. Those in
    /// single precision allow for its rounding.
    SheetSeparation<double> separation_;
    SheetSeparation<float> single_separation_;
    /// Arguments and result of `stays_separated`.
    std::array<double, 2> checked_limits_{-1.0, -1.0};
    Array<double> checked_x_, checked_v_;
    /// Displacements [m] of `stayed_separated` from positions to x, (3, n); `k`: which of two.
    const double* ways_to(const double* x, const double* from, int k) {
        ways_[k].resize(3 * static_cast<std::size_t>(surface.count));
        for (std::size_t i = 0; i < ways_[k].size(); ++i) ways_[k][i] = x[i] - from[i];
        return ways_[k].data();
    }
    std::vector<double> ways_[2];
    /// Frames that will record the paths of particles, of so many after one that needed them.
    static constexpr int max_path_frames = 256;
    int path_frames_ = 0;
    bool is_separated_ = false;
    std::array<std::unique_ptr<SelfVerletList>, plan::max_concurrency> neighbors_;
    bool caches_ = true;
};

/// Call particle(i, begin, end, nearest) with each particle of pairs whose squared distance is below that of `distance`,
/// with their triangles, and with the squared distance of the nearest one.
template <class F>
inline void for_each_particle(const PairList& pairs, const std::vector<double>& square, double distance, F&& particle) {
    std::vector<Index> triangles;
    for (std::size_t first = 0, last; first < pairs.size(); first = last) {
        triangles.clear();
        double nearest = std::numeric_limits<double>::infinity();
        for (last = first; last < pairs.size() && pairs.first[last] == pairs.first[first]; ++last)
            if (square[last] < distance * distance) {
                triangles.push_back(pairs.second[last]);
                nearest = smaller(square[last], nearest);
            }
        if (!triangles.empty())
            particle(pairs.first[first], triangles.data(), triangles.data() + triangles.size(), nearest);
    }
}
/// Call particle(i, begin, end, nearest) with each particle in contact, its triangles and the squared distance of the
/// nearest one, and edge(corners, square) with each pair of edges in contact, after `find`. A reduced thickness is below
/// the full one.
template <class P, class E>
inline void for_each_neighbor(const SelfVerletList& neighbors, double thickness, P&& particle, E&& edge) {
    for_each_particle(neighbors.triangles, neighbors.triangles.square, thickness, particle);
    for (std::size_t k = 0; k < neighbors.edges.size(); ++k)
        if (neighbors.edges.square[k] < 0.25 * thickness * thickness)
            edge(pair_corners<true>(neighbors.surface, neighbors.edges, k), neighbors.edges.square[k]);
}

}  // namespace cloth::contact
