// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// A scene as the engine sees it: particles, and parts whose forces, bounds, energies and costs add up.
#pragma once

#include <array>
#include <atomic>
#include <optional>

#include "contact.hpp"
#include "contact_feature_pairs.hpp"
#include "grid_cells.hpp"
#include "grid_lies.hpp"
#include "held.hpp"
#include "list.hpp"
#include "self_contact.hpp"

namespace cloth {

/// Forces of the caller's own: adds to f at time t [s], positions x [m] and velocities v [m/s], all (3, n), and, where they
/// are asked for, to the powers that damping takes and that else is given [W]. Other than `called_well` ends the run.
using Callback = int (*)(double t, const double* x, const double* v, double* f, double* powers);
inline constexpr int called_well = 1611516433;  // no number that a call which never returned is likely to leave behind

/// Particles that one thread looks after, and the listed elements that touch them: those at a border are taken by both
/// sides, so that every particle's sum runs in one order.
template <class T>
struct Share {
    std::int64_t first = 0, last = 0;  ///< its own particles
    std::int64_t low = 0, high = 0;    ///< those that its elements touch
    std::vector<Elements<T>> lists;
    Array<T> f;
    /// Where hinges are asked for less often than the rest: their forces, and the velocities that they see.
    Array<T> bent, seen;
};
/// What runs write into, kept from one to the next: memory that is new costs more than a short run.
template <class T>
struct Rooms {
    std::vector<Array<T>> state, ring, boxes;
    Array<T> quads[2], more[3], window, contact_masses;
    /// Where rows take their hinges, and where these are asked for less often; of one thread, and of several.
    std::vector<Share<T>> shares[2][2];
    /// Halves of hinges' next impulses over masses as foretold, in turn, and quarters of the last ones.
    Array<T> leads[3];
    std::vector<RowTable<T>> tables;
    CellTable<T> cells;
    bool tabled = false;  ///< whether `tables` and `cells` are of the plan's lists
};

/// Runs that are made at once at most: each writes into rooms of its own.
inline constexpr int max_abreast = 2;

struct Plan {
    std::int64_t count = 0;
    std::vector<double> masses, inverse;
    std::optional<Grid> grid;
    Tables<double> tables;
    Tables<float> narrow_tables;
    std::vector<List> lists;
    /// Where those that a sheet's rows take have their numbers, see `row_places`; empty for each other.
    std::vector<std::vector<std::int64_t>> places;
    /// The list whose panels are the cells of a sheet that its rows take, see `cell_places`; -1 if there is none.
    std::int64_t air = -1;
    /// Rate of linear drag [1/s], and accelerations by gravity and by wind through that drag [m/s^2].
    double drag = 0.0, gravity[3] = {}, wind[3] = {};
    Held held;
    Contacts contacts;
    /// The cloth's contact with itself, by the thickness and damping of `contacts`.
    std::optional<SelfContact> self;
    /// Whether runs may leave it out: nothing gets near enough while they last, see `SelfRest`.
    bool self_rests = false;
    /// Points and edges of obstacles, by the thickness and damping of `contacts`.
    std::optional<FeatureContact> features;
    Callback callback = nullptr;
    /// Where particles stand inside runs without a grid: neighbours close together.
    std::vector<std::int64_t> order, rank;
    /// The inverse of `rank`, where layers rub.
    std::vector<std::int64_t> own;

    std::array<Rooms<double>, max_abreast> rooms;
    std::array<Rooms<float>, max_abreast> narrow_rooms;
    /// Whether a call is at work.
    mutable std::atomic_flag at_work;

    template <class T>
    Rooms<T>& room(int number = 0) {
        if constexpr (sizeof(T) == 8)
            return rooms[number];
        else
            return narrow_rooms[number];
    }
    template <class T>
    const Tables<T>& grid_tables() {
        if constexpr (sizeof(T) == 8) {
            return tables;
        } else {
            if (narrow_tables.numbers.empty()) narrow_tables = Tables<float>(*grid, inverse.data());
            return narrow_tables;
        }
    }
    void add_list(List list) {
        lists.push_back(std::move(list));
        places.clear();
        rooms[0].tabled = narrow_rooms[0].tabled = false;
    }
    /// Find out which lists a sheet's rows take: its hinges, and then the springs between their wings; and its first list
    /// of panels. Sheets without hinges have their springs in families.
    void place_lists() {
        if (places.size() == lists.size()) return;
        std::vector<std::vector<std::int64_t>> found(lists.size());
        bool hinges = false;
        for (std::size_t k = 0; grid && k < lists.size(); ++k) {
            if (lists[k].kind == Kind::crossed) found[k] = row_places<Crossed>(*grid, lists[k]);
            if (lists[k].kind == Kind::altitude) found[k] = row_places<Altitude>(*grid, lists[k]);
            hinges = hinges || !found[k].empty();
        }
        for (std::size_t k = 0; hinges && k < lists.size(); ++k)
            if (lists[k].kind == Kind::spring) found[k] = row_places<Spring>(*grid, lists[k]);
        air = -1;
        for (std::size_t k = 0; grid && air < 0 && k < lists.size(); ++k) {
            if (lists[k].kind == Kind::panel4) found[k] = cell_places(*grid, lists[k]);
            if (lists[k].kind == Kind::panel4 && !found[k].empty()) air = static_cast<std::int64_t>(k);
        }
        places = std::move(found);
    }
    /// Whether there are lists that no rows take; and whether any of these are others than hinges.
    bool lists_beside() {
        place_lists();
        for (std::size_t k = 0; k < lists.size(); ++k)
            if (places[k].empty()) return true;
        return false;
    }
    bool springs_beside() {
        place_lists();
        for (std::size_t k = 0; k < lists.size(); ++k)
            if (places[k].empty() && !lists[k].slow) return true;
        return false;
    }
    /// What the panels that a sheet's rows take have in common.
    const double* cells_air() const { return lists[air].common; }
    /// The hinges and springs that a sheet's rows take, and its panels; they stand in the first room alone.
    template <class T>
    const std::vector<RowTable<T>>& row_tables() {
        return tabled<T>().tables;
    }
    template <class T>
    const CellTable<T>& cell_table() {
        return tabled<T>().cells;
    }
    template <class T>
    const Rooms<T>& tabled() {
        Rooms<T>& own = room<T>();
        if (own.tabled) return own;
        place_lists();
        own.tables.clear();
        for (std::size_t k = 0; k < lists.size(); ++k)
            if (!places[k].empty() && static_cast<std::int64_t>(k) != air)
                own.tables.emplace_back(*grid, lists[k], places[k]);
        own.cells = air < 0 ? CellTable<T>() : CellTable<T>(*grid, places[air]);
        own.tabled = true;
        return own;
    }
    /// The lists shared out among threads by borders between particles: those that no rows take, and all hinges where
    /// runs are `sparse`.
    template <class T>
    std::vector<Share<T>>& shares(const std::vector<std::int64_t>& borders, bool sparse, int number) {
        auto& kept = room<T>(number).shares[sparse][borders.size() > 2];
        bool known = kept.size() + 1 == borders.size();
        for (std::size_t k = 0; known && k < kept.size(); ++k)
            known = kept[k].first == borders[k] && kept[k].last == borders[k + 1] && kept[k].lists.size() == lists.size();
        if (known) return kept;
        place_lists();
        // Kept once it is whole: there may not be memory enough.
        std::vector<Share<T>> all(borders.size() - 1);
        for (std::size_t k = 0; k < all.size(); ++k) {
            Share<T>& share = all[k];
            share.first = share.low = borders[k];
            share.last = share.high = borders[k + 1];
            for (const List& list : lists) {
                share.lists.emplace_back();
                if (!places[share.lists.size() - 1].empty() && !(sparse && list.slow)) continue;
                share.lists.back() = list.template taken<T>(rank.data(), count, share.first, share.last);
                const Elements<T>& elements = share.lists.back();
                for (int c = 0; c < list.width; ++c)
                    for (const std::uint32_t place : elements.corner[c]) {
                        if (place / 4 == static_cast<std::uint64_t>(count)) continue;
                        share.low = std::min<std::int64_t>(share.low, place / 4);
                        share.high = std::max<std::int64_t>(share.high, place / 4 + 1);
                    }
            }
            share.f.assign(4 * (count + 1), T(0));
        }
        return kept = std::move(all);
    }
    /// Borders between particles, as they stand inside runs, that share listed elements out evenly. Particles that contact
    /// looks at together stay together.
    std::vector<std::int64_t> even_borders(int threads) const {
        std::vector<double> work(count, 1.0);
        double total = static_cast<double>(count);
        for (const List& list : lists)
            for (std::int64_t corner : list.corners) {
                work[rank[corner]] += list.width;
                total += list.width;
            }
        std::vector<std::int64_t> borders{0};
        double done = 0.0;
        for (std::int64_t i = 0; i < count; ++i) {
            done += work[i];
            const auto next = static_cast<double>(borders.size());
            if (static_cast<int>(borders.size()) < threads && done >= total * next / threads) borders.push_back(i + 1);
        }
        while (static_cast<int>(borders.size()) <= threads) borders.push_back(count);
        if (contacts.count())
            for (std::int64_t& border : borders)
                border = std::min((border + contact_block / 2) / contact_block * contact_block, count);
        borders.back() = count;
        return borders;
    }
    /// Whether there are hinges.
    bool bends() const {
        for (const List& list : lists)
            if (list.slow) return true;
        return false;
    }
    bool touches() const { return contacts.count() || self; }
    bool rubs() const { return self && self->rubs(); }
    /// Numbers of all anchors.
    std::int64_t anchor_count() const {
        return contacts.obstacle_anchors(count) + (rubs() ? layer_sides * anchor_numbers * count : 0);
    }
    LayerAnchors layer_anchors() const {
        return {contacts.anchors.data() + contacts.obstacle_anchors(count), own.data(), count};
    }
    bool self_acts() const { return self && !self_rests; }
    bool features_act() const { return features && features->any(); }
    /// Whether something acts on the cloth's triangles and edges: in double precision, and by one thread.
    bool surface_acts() const { return self_acts() || features_act(); }
    double push(int axis) const { return gravity[axis] + wind[axis]; }
    /// Whether runs may be made at once: then they write into their rooms alone, once `lay_tables` has been called.
    bool apart() const { return !touches() && !features && !callback; }
    template <class T>
    void lay_tables() {
        place_lists();
        if (!grid) return;
        grid_tables<T>();
        tabled<T>();
    }
    /// Whether forces depend on velocities, and how.
    Mode mode() const {
        if (grid && grid->damped()) return Mode::damped;
        bool moving = drag > 0.0 || held.count() || contacts.count() || self_acts() || callback;
        for (const List& list : lists) moving = moving || list.damped;
        return moving ? Mode::drag : Mode::still;
    }
};

/// One run of the leapfrog: so many equal steps.
struct Run {
    double t, step;
    std::int64_t steps;
    bool narrow;
    int bands;
    const double *x0, *v0;  ///< at the start, (3, n)
    double *x, *v;          ///< at the end; v may be null
    double* booked;         ///< (grippers, booked_numbers), or null
    double* powers;         ///< time integrals of lost and given power [J], or null
    double* touched = nullptr;  ///< (obstacles, booked_numbers), then what `Touched` has, or null
    bool books = false;         ///< whether what obstacles do is booked
    double* anchors = nullptr;  ///< those at the end, (obstacles, anchor_numbers, n), or null
    double* pinched = nullptr;  ///< where pads are at the end, (pinches, pinch_numbers), or null
    std::int64_t every = 1;     ///< hinges act in the middle one of so many steps, for all of them; odd, divides `steps`
    int room = 0;               ///< which of the plan's rooms it writes into

    /// Whether hinges are asked for in a step. At the start they are only looked at.
    bool bends(std::int64_t step) const { return step < 0 || step % every == every / 2; }
};

enum class Done : int { well, callback_failed };

/// Factors of the steps of a run: the start, then one for each step; the last drifts half a step.
template <class T>
inline Motion<T> motion_of(const Run& run, std::int64_t step) {
    const double h = run.step, drift = step + 1 == run.steps ? 0.5 * h : h;
    if (step < 0) return {T(0), T(0.5 * h), T(0), T(0.5 * h)};
    return {T(h), T(0.25 * h), T(0.25 * h), T(drift)};
}
/// Of a single evaluation: it moves nothing, and velocities that were zero become accelerations.
template <class T>
inline constexpr Motion<T> evaluation{T(1), T(0), T(0), T(0)};
inline double middle_of(const Run& run, std::int64_t step) { return step < 0 ? run.t : run.t + (step + 0.5) * run.step; }

/// A number at the end of a run: in single precision what changed is added to what it was.
template <class T>
inline double ended(double before, double origin, T value, T carry) {
    if constexpr (sizeof(T) == 8)
        return static_cast<double>(value);
    else
        return before + ((static_cast<double>(value) - static_cast<double>(static_cast<T>(before - origin))) +
                         static_cast<double>(carry));
}

/// How the contact of each particle with the cloth is reduced at a time t, in the order of its surface; none where it is
/// not.
inline void self_scalings(const Plan& plan, double t, std::vector<Scaling<double>>& out) {
    const ReducedThickness& reduced = plan.contacts.reduced;
    out.clear();
    if (!reduced.any()) return;
    out.resize(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i)
        out[plan.rank[i]] = reduced.scaling(plan.contacts.count(), i, plan.count + 1, t);
}

}  // namespace cloth
