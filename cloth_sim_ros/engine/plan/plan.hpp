// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// A scene as the engine sees it: particles, and parts whose forces, bounds, energies and costs add up.
#pragma once

#include <array>
#include <atomic>
#include <optional>

#include "contact/feature_neighbors.hpp"
#include "contact/obstacles.hpp"
#include "contact/self_contact.hpp"
#include "grid/cells.hpp"
#include "grid/stencils.hpp"
#include "mesh/elements.hpp"
#include "plan/grips.hpp"
#include "plan/workspace.hpp"

namespace cloth {

/// Forces of the caller's own: adds to f at time t [s], positions x [m] and velocities v [m/s], all (3, n), and, where they
/// are asked for, to the powers that damping takes and that else is given [W]. Other than `callback_ok` ends the run.
using Callback = int (*)(double t, const double* x, const double* v, double* f, double* powers);
inline constexpr int callback_ok = 1611516433;  // no number that a call which never returned is likely to leave behind

struct Plan {
    std::int64_t count = 0;
    std::vector<double> masses, inverse;
    std::optional<Grid> grid;
    GridTables<double> tables;
    GridTables<float> single_tables;
    std::vector<List> lists;
    /// Where those that a sheet's rows take have their numbers, see `row_slots`; empty for each other.
    std::vector<std::vector<std::int64_t>> slots;
    /// The list whose panels are the cells of a sheet that its rows take, see `cell_slots`; -1 if there is none.
    std::int64_t air_list = -1;
    /// Rate of linear drag [1/s], and accelerations by gravity and by wind through that drag [m/s^2].
    double drag = 0.0, gravity[3] = {}, wind[3] = {};
    Grips grips;
    Contacts contacts;
    /// The cloth's contact with itself, by the thickness and damping of `contacts`.
    std::optional<SelfContact> self;
    /// Whether runs may leave it out: nothing gets near enough while they last, see `SelfCulling`.
    bool self_culled = false;
    /// Points and edges of obstacles, by the thickness and damping of `contacts`.
    std::optional<FeatureContactModel> features;
    Callback callback = nullptr;
    /// Where particles stand inside runs without a grid: neighbours close together.
    std::vector<std::int64_t> order, rank;
    /// The inverse of `rank`, where layers rub.
    std::vector<std::int64_t> particle_of_rank;

    std::array<Workspace<double>, max_concurrency> workspaces;
    std::array<Workspace<float>, max_concurrency> single_workspaces;
    /// Whether a call is at work.
    mutable std::atomic_flag busy;

    template <class T>
    Workspace<T>& workspace(int index = 0) {
        if constexpr (sizeof(T) == 8)
            return workspaces[index];
        else
            return single_workspaces[index];
    }
    template <class T>
    const GridTables<T>& grid_tables() {
        if constexpr (sizeof(T) == 8) {
            return tables;
        } else {
            if (single_tables.numbers.empty()) single_tables = GridTables<float>(*grid, inverse.data());
            return single_tables;
        }
    }
    void add_list(List list) {
        lists.push_back(std::move(list));
        slots.clear();
        workspaces[0].has_tables = single_workspaces[0].has_tables = false;
    }
    /// Find out which lists a sheet's rows take: its hinges, and then the springs between their wings; and its first list
    /// of panels. Sheets without hinges have their springs in families.
    void assign_lists() {
        if (slots.size() == lists.size()) return;
        std::vector<std::vector<std::int64_t>> list_slots(lists.size());
        bool hinges = false;
        for (std::size_t k = 0; grid && k < lists.size(); ++k) {
            if (lists[k].kind == Kind::crossed) list_slots[k] = row_slots<Crossed>(*grid, lists[k]);
            if (lists[k].kind == Kind::altitude) list_slots[k] = row_slots<Altitude>(*grid, lists[k]);
            hinges = hinges || !list_slots[k].empty();
        }
        for (std::size_t k = 0; hinges && k < lists.size(); ++k)
            if (lists[k].kind == Kind::spring) list_slots[k] = row_slots<Spring>(*grid, lists[k]);
        air_list = -1;
        for (std::size_t k = 0; grid && air_list < 0 && k < lists.size(); ++k) {
            if (lists[k].kind == Kind::panel4) list_slots[k] = cell_slots(*grid, lists[k]);
            if (lists[k].kind == Kind::panel4 && !list_slots[k].empty()) air_list = static_cast<std::int64_t>(k);
        }
        slots = std::move(list_slots);
    }
    /// Whether there are lists that no rows take; and whether any of these are others than hinges.
    bool has_off_grid_lists() {
        assign_lists();
        for (std::size_t k = 0; k < lists.size(); ++k)
            if (slots[k].empty()) return true;
        return false;
    }
    bool has_fast_off_grid_lists() {
        assign_lists();
        for (std::size_t k = 0; k < lists.size(); ++k)
            if (slots[k].empty() && !lists[k].slow) return true;
        return false;
    }
    /// What the panels that a sheet's rows take have in common.
    const double* cells_air() const { return lists[air_list].common; }
    /// The hinges and springs that a sheet's rows take, and its panels; they stand in the first room alone.
    template <class T>
    const std::vector<RowTable<T>>& row_tables() {
        return workspace_with_tables<T>().tables;
    }
    template <class T>
    const CellTable<T>& cell_table() {
        return workspace_with_tables<T>().cells;
    }
    template <class T>
    const Workspace<T>& workspace_with_tables() {
        Workspace<T>& first = workspace<T>();
        if (first.has_tables) return first;
        assign_lists();
        first.tables.clear();
        for (std::size_t k = 0; k < lists.size(); ++k)
            if (!slots[k].empty() && static_cast<std::int64_t>(k) != air_list)
                first.tables.emplace_back(*grid, lists[k], slots[k]);
        first.cells = air_list < 0 ? CellTable<T>() : CellTable<T>(*grid, slots[air_list]);
        first.has_tables = true;
        return first;
    }
    /// The lists shared out among threads by borders between particles: those that no rows take, and all hinges where
    /// runs are `sparse`.
    template <class T>
    std::vector<Partition<T>>& partitions(const std::vector<std::int64_t>& borders, bool multirate, int index) {
        auto& cached = workspace<T>(index).partitions[multirate][borders.size() > 2];
        bool is_current = cached.size() + 1 == borders.size();
        for (std::size_t k = 0; is_current && k < cached.size(); ++k)
            is_current = cached[k].first == borders[k] && cached[k].last == borders[k + 1] && cached[k].lists.size() == lists.size();
        if (is_current) return cached;
        assign_lists();
        // Kept once it is whole: there may not be memory enough.
        std::vector<Partition<T>> fresh(borders.size() - 1);
        for (std::size_t k = 0; k < fresh.size(); ++k) {
            Partition<T>& partition = fresh[k];
            partition.first = partition.low = borders[k];
            partition.last = partition.high = borders[k + 1];
            for (const List& list : lists) {
                partition.lists.emplace_back();
                if (!slots[partition.lists.size() - 1].empty() && !(multirate && list.slow)) continue;
                partition.lists.back() = list.template select<T>(rank.data(), count, partition.first, partition.last);
                const Elements<T>& elements = partition.lists.back();
                for (int c = 0; c < list.width; ++c)
                    for (const std::uint32_t corner : elements.corner[c]) {
                        if (corner / 4 == static_cast<std::uint64_t>(count)) continue;
                        partition.low = std::min<std::int64_t>(partition.low, corner / 4);
                        partition.high = std::max<std::int64_t>(partition.high, corner / 4 + 1);
                    }
            }
            partition.f.assign(4 * (count + 1), T(0));
        }
        return cached = std::move(fresh);
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
    bool has_hinges() const {
        for (const List& list : lists)
            if (list.slow) return true;
        return false;
    }
    bool has_contact() const { return contacts.count() || self; }
    bool has_self_friction() const { return self && self->has_friction(); }
    /// Numbers of all anchors.
    std::int64_t anchor_count() const {
        return contacts.obstacle_anchors(count) + (has_self_friction() ? layer_sides * anchor_numbers * count : 0);
    }
    LayerAnchors layer_anchors() const {
        return {contacts.anchors.data() + contacts.obstacle_anchors(count), particle_of_rank.data(), count};
    }
    bool is_self_active() const { return self && !self_culled; }
    bool is_feature_active() const { return features && features->any(); }
    /// Whether something acts on the cloth's triangles and edges: in double precision, and by one thread.
    bool is_surface_active() const { return is_self_active() || is_feature_active(); }
    double body_acceleration(int axis) const { return gravity[axis] + wind[axis]; }
    /// Whether runs may be made at once: then they write into their rooms alone, once `prepare_tables` has been called.
    bool has_independent_runs() const { return !has_contact() && !features && !callback; }
    template <class T>
    void prepare_tables() {
        assign_lists();
        if (!grid) return;
        grid_tables<T>();
        workspace_with_tables<T>();
    }
    /// Whether forces depend on velocities, and how.
    Mode mode() const {
        if (grid && grid->damped()) return Mode::damped;
        bool uses_velocity = drag > 0.0 || grips.count() || contacts.count() || is_self_active() || callback;
        for (const List& list : lists) uses_velocity = uses_velocity || list.damped;
        return uses_velocity ? Mode::drag : Mode::position_only;
    }
};

/// One run of the leapfrog: so many equal steps.
struct Run {
    double t, step;
    std::int64_t steps;
    bool single_precision;
    int bands;
    const double *x0, *v0;  ///< at the start, (3, n)
    double *x, *v;          ///< at the end; v may be null
    double* gripper_record;         ///< (grippers, record_numbers), or null
    double* power_integrals;         ///< time integrals of lost and given power [J], or null
    double* contact_record = nullptr;  ///< (obstacles, record_numbers), then what `ContactSummary` has, or null
    bool record_obstacles = false;         ///< whether what obstacles do is booked
    double* anchors = nullptr;  ///< those at the end, (obstacles, anchor_numbers, n), or null
    double* jaw_states = nullptr;  ///< where pads are at the end, (pinches, jaw_state_size), or null
    std::int64_t multirate = 1;     ///< hinges act in the middle one of so many steps, for all of them; odd, divides `steps`
    int workspace = 0;               ///< which of the plan's rooms it writes into

    /// Whether hinges are asked for in a step. At the start they are only looked at.
    bool evaluates_hinges(std::int64_t step) const { return step < 0 || step % multirate == multirate / 2; }
};

enum class RunStatus : int { ok, callback_failed };

/// Factors of the steps of a run: the start, then one for each step; the last drifts half a step.
template <class T>
inline StepFactors<T> motion_of(const Run& run, std::int64_t step) {
    const double h = run.step, drift = step + 1 == run.steps ? 0.5 * h : h;
    if (step < 0) return {T(0), T(0.5 * h), T(0), T(0.5 * h)};
    return {T(h), T(0.25 * h), T(0.25 * h), T(drift)};
}
/// Of a single evaluation: it moves nothing, and velocities that were zero become accelerations.
template <class T>
inline constexpr StepFactors<T> evaluation{T(1), T(0), T(0), T(0)};
inline double midpoint_time(const Run& run, std::int64_t step) { return step < 0 ? run.t : run.t + (step + 0.5) * run.step; }

/// A number at the end of a run: in single precision what changed is added to what it was.
template <class T>
inline double final_value(double initial, double origin, T value, T compensation_) {
    if constexpr (sizeof(T) == 8)
        return static_cast<double>(value);
    else
        return initial + ((static_cast<double>(value) - static_cast<double>(static_cast<T>(initial - origin))) +
                         static_cast<double>(compensation_));
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
