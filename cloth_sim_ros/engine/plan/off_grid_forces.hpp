// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Forces of a run besides the springs of a sheet: listed elements, forces in Python, grippers, contact.
#pragma once

#include <memory>

#include "plan/plan.hpp"

namespace cloth::contact {
template <class T>
class ObstacleRun;
class SelfRun;
class FeatureRun;
struct ParticleSlots;
}  // namespace cloth::contact

namespace cloth::plan {

using contact::FeatureRun, contact::ObstacleRun, contact::ParticleSlots, contact::SelfRun, grid::position,
    grid::RowView, grid::Slot, mesh::PowerSums;

/// Forces outside the grid loop, with the data that a run keeps between its steps.
template <class T>
struct OffGridForces {
    Plan& plan;
    const Run& run;
    const bool multirate;       ///< whether hinges are evaluated once in several steps
    const bool has_lists;       ///< whether lists exist that no row of the grid evaluates
    const bool has_fast_lists;  ///< whether any of these are not hinges
    double origin[3] = {};
    Array<T>&x, &v;                                          ///< positions and damping velocities, a quad per particle
    std::vector<Partition<T>>* partitions = nullptr;         ///< partitions by thread, with their forces
    std::vector<double> callback_x, callback_v, callback_f;  ///< arrays for the callback, (3, n)
    std::vector<PoseCache> poses;                            ///< one per thread
    std::vector<double> grip_sums;                           ///< (grips, record_numbers)
    std::vector<T> quarter_impulse_factors;                  ///< from hinge force to a quarter of the impulse over mass
    std::vector<T> inverse;                                  ///< 1/m of each particle of multirate runs, by rank
    std::unique_ptr<ObstacleRun<T>> contact;
    std::unique_ptr<SelfRun> self;
    std::unique_ptr<FeatureRun> features;

    OffGridForces(Plan& plan, const Run& run);
    ~OffGridForces();
    /// Whether grips prescribe the motion of particles.
    bool has_prescribed() const { return plan.grips.has_prescribed; }
    bool needed() const { return has_lists || is_single_threaded(); }
    /// Whether these forces are needed in a step.
    bool is_active(std::int64_t step) const {
        return needed() &&
               (!multirate || run.evaluates_hinges(step) || has_fast_lists || self || features || needs_full_arrays());
    }
    /// Whether a callback or the powers need all positions by component.
    bool needs_full_arrays() const { return plan.callback || run.power_integrals; }
    /// Whether the run is limited to one thread.
    bool is_single_threaded() const { return needs_full_arrays() || plan.is_surface_active(); }
    /// Whether an obstacle is near enough for contact, or jaws exist.
    bool has_near_obstacles() const { return !plan.contacts.active.empty() || !plan.contacts.parallel_jaws.empty(); }
    void prepare_poses(int threads) {
        for (int k = 0; plan.grips.count() && k < threads; ++k) poses.emplace_back(plan.grips.paths, run.t, run.step);
    }
    /// Set up contact for the rows of a sheet with a row pitch, or for blocks of particles by rank.
    void init_contact_by_rows(int threads, std::int64_t pitch);
    void init_contact_by_ranks(int threads);
    void init_contact(int threads, std::int64_t blocks, std::int64_t pitch, const ParticleSlots& slot_of);
    void allocate(const std::vector<std::int64_t>& borders);
    /// Compute the forces of lists and callback on the particles of a partition at a step, and record the powers.
    RunStatus compute_forces(std::int64_t step, int thread);
    /// Evaluate hinges in a step that stands for `multirate` steps: their impulse and their dissipation count as often.
    /// The velocity just before such an impulse lacks half of it, but the damping needs the mean velocity. The missing
    /// half is predicted by the mean of the last two, as in every step.
    void add_hinge_impulses(std::int64_t step, Partition<T>& partition, PowerSums* list_powers);
    RunStatus add_callback_forces(std::int64_t step, T* f, bool record, const PowerSums& list_powers);
    /// Copy positions or velocities from a row of the sheet, components `pitch` numbers apart.
    void import_row(Slot slot, std::int64_t row, const T* from, std::int64_t pitch) {
        const std::int64_t columns = plan.grid->columns;
        T* const to = (slot == position ? x : v).data() + 4 * row * columns;
        for (std::int64_t j = 0; j < columns; j += lanes<T>) {
            quad<T> rows[lanes<T>];
            interleave(load(from + j), load(from + pitch + j), load(from + 2 * pitch + j), rows);
            const std::int64_t n_lanes = std::min<std::int64_t>(lanes<T>, columns - j);
            for (std::int64_t k = 0; k < n_lanes; ++k) store4(to + 4 * (j + k), rows[k]);
        }
    }
    /// Advance the jaws to a step, after all threads have finished the one before.
    void advance_jaws(int thread, std::int64_t step);
    /// Add contact with obstacles to the particles of a partition.
    void add_contact(int thread, std::int64_t step, T* f);
    /// Record the velocities of a row of the sheet after a step, or of a partition's particles as quads, if the run
    /// records its motion. Blocks that contact skips must not be faster than assumed.
    void record_row_motion(int thread, std::int64_t row, std::int64_t step, const T* at, std::int64_t pitch);
    void record_motion(int thread, std::int64_t step, const T* v, std::int64_t first, std::int64_t last);
    void record_block_velocities(int thread, std::int64_t block, std::int64_t step,
                                 const VelocityBounds<vec<T>>& bounds);
    /// Add the forces of contact, grippers, lists and callback to the force row of a sheet's row.
    void add_row_forces(int thread, std::int64_t row, std::int64_t step, const RowView<T>& at, bool record);
    /// Position, relative to the origin, and velocity of a particle.
    struct Motion {
        Vec3<double> x, v;
    };
    /// Force on the particle of a grip at a step, from its motion in the run.
    Vec3<T> grip_force(int thread, std::int64_t grip, std::int64_t step, const Motion& particle, bool record);
    /// Motion of a prescribed particle's point after a step; record the force on it in the step, mass times `a`.
    Motion prescribe(int thread, std::int64_t grip, std::int64_t step, Vec3<T> a, bool record);
    /// Inertia [N] of the air at a prescribed particle in a step, from the mass block there.
    Vec3<T> air_inertia(std::int64_t grip, std::int64_t step, const Sym3<T>& block);
    /// Replace the mass of the air at the prescribed particles of a row by its inertia.
    void hold_row(std::int64_t row, std::int64_t step, const RowView<T>& at);
    /// The same for a row of the sheet that has moved.
    void prescribe_row(int thread, std::int64_t row, std::int64_t step, const RowView<T>& at, bool record);
    /// A run whose surface may have intersected itself or an obstacle has no result.
    void finish_surface()
        requires(sizeof(T) == 8);
    /// Record that no obstacle was near.
    void record_no_contact();
    /// Copy the plastic lengths of the plan to the elements of the partitions, or those of the elements to the run.
    void load_plastic_lengths();
    void store_plastic_lengths() const;
    /// Sum up the records, in order of the grips and of the blocks.
    void finish();
};

}  // namespace cloth::plan
