// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Plan: a compiled scene of particles and parts whose forces, bounds, energies and costs add up.
#pragma once

#include <array>
#include <atomic>
#include <memory>
#include <optional>

#include "contact/layer_anchors.hpp"
#include "contact/obstacles.hpp"
#include "grid/cells.hpp"
#include "grid/curvature_bounds.hpp"
#include "grid/differences.hpp"
#include "grid/stencils.hpp"
#include "mesh/elements.hpp"
#include "plan/frame_request.hpp"
#include "plan/grips.hpp"
#include "plan/motion_record.hpp"
#include "plan/workspace.hpp"

namespace cloth::contact {
class SelfContact;
struct FeatureContactModel;
}  // namespace cloth::contact

namespace cloth::plan {

using mesh::is_mass, mesh::is_plastic, contact::Contacts, contact::FeatureContactModel, contact::layer_sides,
    contact::LayerAnchors, contact::ReducedThickness, contact::SelfContact, grid::CurvatureBounds, grid::CurvatureTable,
    grid::Grid, grid::GridTables, grid::Mode, grid::StepFactors, laws::anchor_numbers, laws::Scaling, mesh::List;

struct Plan {
    Plan();
    ~Plan();

    std::int64_t count = 0;
    std::vector<double> masses, inverse;
    /// Inverse masses, zero also for particles whose motion a gripper prescribes.
    std::vector<double> free_inverse;
    std::optional<Grid> grid;
    GridTables<double> tables;
    GridTables<float> single_tables;
    std::vector<List> lists;
    /// Slots of the lists that rows of the grid evaluate, see `row_slots`; empty for the others.
    std::vector<std::vector<std::int64_t>> slots;
    /// The list whose panels are cells evaluated by rows, see `cell_slots`; -1 if there is none.
    std::int64_t air_list = -1;
    /// The same of added mass.
    std::int64_t mass_list = -1;
    /// The list of quadratic hinges evaluated by rows, see `curvature_slots`; and the bound of its stiffness of each
    /// particle [N/m], empty before the first query.
    std::int64_t curvature_list = -1;
    std::vector<double> curvature_bounds;
    /// The same of each hinge, and whether the cells of the first two lists are in order, see `are_cells_in_order`.
    CurvatureBounds curvature_terms;
    bool air_in_order = false, mass_in_order = false;
    /// The list of plastic elements, whose first parameters are plastic lengths at the start of runs; -1 if there is
    /// none. Whether evaluations leave it out.
    std::int64_t plastic_list = -1;
    bool omits_plastic = false;
    /// Rate of linear drag [1/s], accelerations by gravity and by wind through that drag [m/s^2].
    double drag = 0.0, gravity[3] = {}, wind[3] = {};
    Grips grips;
    /// Positions and velocities (2, 3, n) at the start of the present frame, if particles are prescribed.
    std::vector<double> prescribed_start;
    /// Records of the runs of a frame.
    std::vector<MotionRecord> motions;
    Contacts contacts;
    /// Self-contact, with the thickness and damping of `contacts`.
    std::unique_ptr<SelfContact> self;
    /// Whether runs may skip self-contact, see `SelfCulling`.
    bool self_culled = false;
    /// Contact with points and edges of obstacles, with the thickness and damping of `contacts`.
    std::unique_ptr<FeatureContactModel> features;
    Callback callback = nullptr;
    /// Order of particles in runs without a grid, where neighbours are close together: ranks, and the inverse.
    std::vector<std::int64_t> rank, particle_of_rank;

    std::array<Workspace<double>, max_concurrency> workspaces;
    std::array<Workspace<float>, max_concurrency> single_workspaces;
    /// Memory of `velocity_displacement`, empty until its first call.
    std::vector<double> lanczos_memory;
    /// Whether a call is running.
    mutable std::atomic_flag busy;

    template <class T>
    Workspace<T>& workspace(int index = 0) {
        if constexpr (sizeof(T) == 8)
            return workspaces[index];
        else
            return single_workspaces[index];
    }
    void set_ranks(std::vector<std::int64_t> ranks) {
        rank = std::move(ranks);
        particle_of_rank.resize(count);
        for (std::int64_t i = 0; i < count; ++i) particle_of_rank[rank[i]] = i;
    }
    template <class T>
    const GridTables<T>& grid_tables();
    void set_grips(Grips next) {
        grips = std::move(next);
        free_inverse = inverse;
        for (std::int64_t grip = 0; grip < grips.count(); ++grip)
            if (grips.prescribed[grip]) free_inverse[grips.particle[grip]] = 0.0;
    }
    void add_list(List list) {
        if (is_plastic(list.kind)) plastic_list = static_cast<std::int64_t>(lists.size());
        lists.push_back(std::move(list));
        slots.clear();
        curvature_bounds.clear();
        curvature_terms = {};
        workspaces[0].has_tables = single_workspaces[0].has_tables = false;
    }
    /// Assign lists to rows of the grid: hinges, then springs between their wings, then the first list of panels.
    /// Sheets without hinges have their springs in families.
    void assign_lists();
    /// Whether lists exist that no row evaluates; and whether any of these are not hinges.
    bool has_off_grid_lists();
    bool has_fast_off_grid_lists();
    /// Common coefficients of the panels evaluated by rows.
    const double* cells_air() const { return lists[air_list].common; }
    const double* cells_mass() const { return lists[mass_list].common; }
    /// Whether air is carried along.
    bool has_added_mass() const {
        for (const List& list : lists)
            if (is_mass(list.kind)) return true;
        return false;
    }
    /// Hinges, springs and panels evaluated by rows; stored in the first workspace only.
    template <class T>
    const std::vector<RowTable<T>>& row_tables() {
        return workspace_with_tables<T>().tables;
    }
    template <class T>
    const CellTable<T>& cell_table() {
        return workspace_with_tables<T>().cells;
    }
    template <class T>
    const CellTable<T>& mass_table() {
        return workspace_with_tables<T>().mass_cells;
    }
    template <class T>
    const CurvatureTable<T>& curvature_table() {
        return workspace_with_tables<T>().curvature;
    }
    template <class T>
    const Workspace<T>& workspace_with_tables();
    /// Partition the lists among threads by borders between particles: those that no row evaluates, and all hinges of
    /// `multirate` runs.
    template <class T>
    std::vector<Partition<T>>& partitions(const std::vector<std::int64_t>& borders, bool multirate, int index);
    /// Borders between particles, in the order of runs, that distribute listed elements evenly. Blocks of contact are
    /// not split.
    std::vector<std::int64_t> even_borders(int threads) const;
    /// Whether there are hinges.
    bool has_hinges() const {
        for (const List& list : lists)
            if (list.slow) return true;
        return false;
    }
    bool has_contact() const { return contacts.count() || self != nullptr; }
    bool has_self_friction() const;
    /// Number of plastic lengths.
    std::int64_t plastic_count() const { return plastic_list < 0 ? 0 : lists[plastic_list].count; }
    /// Size of all anchors.
    std::int64_t anchor_count() const {
        return contacts.obstacle_anchors(count) + (has_self_friction() ? layer_sides * anchor_numbers * count : 0);
    }
    LayerAnchors layer_anchors() const {
        return {contacts.anchors.data() + contacts.obstacle_anchors(count), particle_of_rank.data(), count};
    }
    bool is_self_active() const { return self != nullptr && !self_culled; }
    bool is_feature_active() const;
    /// Whether forces act on triangles and edges of the cloth: in double precision, on one thread a run.
    bool is_surface_active() const { return is_self_active() || is_feature_active(); }
    double body_acceleration(int axis) const { return gravity[axis] + wind[axis]; }
    /// Whether runs may be concurrent: then they write into their workspaces only, after `prepare_tables`. Python
    /// evaluates forces in one thread.
    bool has_independent_runs() const { return !callback; }
    template <class T>
    void prepare_tables() {
        assign_lists();
        if (!grid) return;
        grid_tables<T>();
        workspace_with_tables<T>();
    }
    /// Dependence of the forces on velocities.
    Mode mode() const {
        if (grid && grid->damped()) return Mode::damped;
        bool uses_velocity = drag > 0.0 || grips.count() || contacts.count() || is_self_active() || callback;
        for (const List& list : lists) uses_velocity = uses_velocity || list.damped;
        return uses_velocity ? Mode::drag : Mode::position_only;
    }
};

/// One run of the leapfrog: a number of equal steps.
struct Run {
    double t, step;
    std::int64_t steps;
    bool single_precision;
    int bands;
    const double *x0, *v0;                ///< at the start, (3, n)
    double *x, *v;                        ///< at the end; v may be null
    double* gripper_record;               ///< (grippers, record_numbers), or null
    double* power_integrals;              ///< time integrals of dissipated and external power [J], or null
    double* contact_record = nullptr;     ///< (obstacles, record_numbers), then the `ContactSummary`, or null
    bool record_obstacles = false;        ///< whether the work of obstacles is recorded
    double* anchors = nullptr;            ///< at the end, (obstacles, anchor_numbers, n), or null
    double* jaw_states = nullptr;         ///< jaw states at the end, (jaws, jaw_state_size), or null
    std::int64_t multirate = 1;           ///< steps per evaluation of hinges, in the middle one; odd, divides `steps`
    double* activity = nullptr;           ///< see FrameRequest::activities, or null
    const double* previous_v0 = nullptr;  ///< velocities at the start of the interval before, or null
    double previous_ratio = 0.0;          ///< length of the run relative to that interval
    int workspace = 0;                    ///< index of the workspace
    double* plastic_lengths = nullptr;    ///< at the end, or null
    MotionRecord* motion = nullptr;       ///< its velocities in each step, or null

    /// The `ContactSummary` in the record.
    double* contact_summary(const Plan& plan) const { return contact_record + plan.contacts.count() * record_numbers; }
    /// Whether the velocities after a step are those of the middle of the run.
    bool ends_first_half(std::int64_t step) const { return activity && step >= 0 && step + 1 == steps / 2; }
    /// Whether hinges are evaluated in a step. At the start they are evaluated without effect on the motion.
    bool evaluates_hinges(std::int64_t step) const { return step < 0 || step % multirate == multirate / 2; }
};

/// Largest difference of a particle's velocity changes over both halves of a run, and its largest change of jerk.
class HalfDifference {
public:
    explicit HalfDifference(const Run& run)
        : run_(&run), first_(run.steps / 2), scale_(first_ ? 0.5 * static_cast<double>(run.steps) : 1.0),
          later_(scale_ / static_cast<double>(run.steps - first_)),
          earlier_(first_ ? scale_ / static_cast<double>(first_) : 0.0),
          before_(run.previous_ratio / (2.0 + 2.0 * run.previous_ratio)) {}
    /// Add particle i of n, with its velocities in the middle and at the end, components `stride` apart.
    template <class T>
    void add(std::int64_t i, std::int64_t n, const T* middle, const T* end, std::int64_t stride) {
        double square = 0.0, jerk_square = 0.0;
        for (int c = 0; c < 3; ++c) {
            const double v0 = run_->v0[c * n + i], v = static_cast<double>(end[c * stride]);
            const double half = first_ ? static_cast<double>(middle[c * stride]) : v0;
            const double difference = fma(later_, v - half, -earlier_ * (half - v0));
            square = fma(difference, difference, square);
            if (!run_->previous_v0 || !first_) continue;
            // At constant jerk, the velocity change differs from that of an equal interval before by four such differences.
            const double from_before = fma(-run_->previous_ratio, v0 - run_->previous_v0[c * n + i], v - v0);
            const double jerk_change = fma(-before_, from_before, difference);
            jerk_square = fma(jerk_change, jerk_change, jerk_square);
        }
        max_square_ = square > max_square_ ? square : max_square_;
        max_jerk_square_ = jerk_square > max_jerk_square_ ? jerk_square : max_jerk_square_;
    }
    void add(const HalfDifference& part) {
        max_square_ = part.max_square_ > max_square_ ? part.max_square_ : max_square_;
        max_jerk_square_ = part.max_jerk_square_ > max_jerk_square_ ? part.max_jerk_square_ : max_jerk_square_;
    }
    void store(double* activity) const { activity[0] = root(max_square_), activity[1] = root(max_jerk_square_); }

private:
    const Run* run_;
    std::int64_t first_;
    double scale_, later_, earlier_, max_square_ = 0.0, max_jerk_square_ = 0.0;
    /// Half difference at constant jerk, relative to the difference from the interval before.
    double before_;
};

enum class RunStatus : int { ok, callback_failed };

/// Factors of a step: the start is step -1; the last step drifts half a step.
template <class T>
inline StepFactors<T> motion_of(const Run& run, std::int64_t step) {
    const double h = run.step, drift = step + 1 == run.steps ? 0.5 * h : h;
    if (step < 0) return {T(0), T(0.5 * h), T(0), T(0.5 * h)};
    return {T(h), T(0.25 * h), T(0.25 * h), T(drift)};
}
/// Factors of a single evaluation: nothing moves, and zero velocities become accelerations.
template <class T>
inline constexpr StepFactors<T> evaluation{T(1), T(0), T(0), T(0)};
inline double midpoint_time(const Run& run, std::int64_t step) {
    return step < 0 ? run.t : run.t + (step + 0.5) * run.step;
}

/// Value at the end of a run; in single precision the change is added to the initial value.
template <class T>
inline double final_value(double initial, double origin, T value, T compensation_) {
    if constexpr (sizeof(T) == 8)
        return static_cast<double>(value);
    else
        return initial + ((static_cast<double>(value) - static_cast<double>(static_cast<T>(initial - origin))) +
                          static_cast<double>(compensation_));
}

/// Scaling of the self-contact of each particle at a time t, by rank; empty without reduction.
inline void self_scalings(const Plan& plan, double t, std::vector<Scaling<double>>& out) {
    const ReducedThickness& reduced = plan.contacts.reduced;
    out.clear();
    if (!reduced.any()) return;
    out.resize(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i)
        out[plan.rank[i]] = reduced.scaling(plan.contacts.count(), i, plan.count + 1, t);
}

}  // namespace cloth::plan
