// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// One force evaluation of a sheet: its rows pass through a window of three rows, which fits the first-level cache.
#pragma once

#include "grid/air.hpp"
#include "grid/curvature.hpp"
#include "grid/dispatch.hpp"
#include "grid/hinges.hpp"
#include "plan/off_grid_forces.hpp"

namespace cloth::grid {

using plan::OffGridForces, plan::Run, plan::RunStatus;

class GridForces {
    using T = double;

public:
    /// The accelerations are written to the end velocities of the run, which has no steps.
    GridForces(Plan& plan, const Run& run)
        : plan_(plan), run_(run), grid_(*plan.grid), off_grid_(plan, run), window_(plan.workspace<T>().window),
          hinges_(plan.row_tables<T>()), cells_(plan.cell_table<T>()), mass_cells_(plan.mass_table<T>()),
          curvature_(plan.curvature_table<T>()), carries_air_(plan.has_added_mass()), pitch_(plan.tables.pitch),
          uses_velocity_(plan.mode() != Mode::position_only) {
        n_cell_numbers_ = cells_.empty() ? 0 : 2 * air_row_size<T>(pitch_);
        const std::int64_t n_mass_numbers = carries_air_ ? 2 * block_numbers * pitch_ : 0;
        window_.resize((rows_of_window * (damping_velocity + 3) + 3 * 3 * 3 + 3) * pitch_ + n_cell_numbers_ +
                       n_mass_numbers + 64 / sizeof(T));
        off_grid_.prepare_poses(1);
        off_grid_.init_contact_by_rows(1, pitch_);
    }
    RunStatus execute() {
        if (off_grid_.needed()) {
            off_grid_.allocate({0, plan_.count});
            for (std::int64_t row = 0; row < grid_.rows; ++row) {
                load_row(row);
                off_grid_.import_row(position, row, row_of(row), pitch_);
                off_grid_.import_row(damping_velocity, row, row_of(row) + damping_velocity * pitch_, pitch_);
            }
            const RunStatus done = off_grid_.compute_forces(-1, 0);
            if (done != RunStatus::ok) return done;
        }
        const StepRow<T> step = select_row_step<T>(grid_.shape(), plan_.mode(), carries_air_);
        const GridConstants<T> constants = grid_constants<T>(plan_);
        T *const force_rows = window_.data() + rows_of_window * (damping_velocity + 3) * pitch_, *const hinge_forces =
                                                                                                     force_rows +
                                                                                                     3 * 3 * pitch_;
        T* const curvature_forces = hinge_forces + 3 * 3 * pitch_;
        T *const out = curvature_forces + 3 * 3 * pitch_, *const cell_rows = out + 3 * pitch_;
        std::fill(force_rows, window_.data() + window_.size(), T(0));
        load_row(0);
        load_row(1);
        // Rows of whole vectors are written in place.
        const bool whole = row_length<T>(grid_.columns) == grid_.columns;
        for (std::int64_t row = 0; row < grid_.rows; ++row) {
            load_row(row + 2);
            RowView<T> at;
            for (int k = 0; k < 3; ++k) {
                at.row[k] = row_of(row + k);
                at.force_rows[k] = force_rows + (row + k) % 3 * 3 * pitch_;
            }
            at.entry = plan_.tables.of(row);
            at.pitch = pitch_;
            at.length = row_length<T>(grid_.columns);
            at.accelerations = whole ? run_.v + row * grid_.columns : out;
            at.acceleration_pitch = whole ? plan_.count : pitch_;
            T* mass_rows[2]{};
            if (carries_air_) {
                for (int k = 0; k < 2; ++k)
                    mass_rows[k] = cell_rows + n_cell_numbers_ + ((row & 1) ^ k) * block_numbers * pitch_;
                at.mass = mass_rows[0];
                if (mass_cells_.empty()) std::fill_n(at.mass, block_numbers * pitch_, T(0));
            }
            off_grid_.add_row_forces(0, row, -1, at, false);
            T* hinge_rows[3];
            for (int k = 0; k < 3; ++k) hinge_rows[k] = hinge_forces + (row + k) % 3 * 3 * pitch_;
            if (!hinges_.empty()) add_hinge_row(hinges_, row, at, hinge_rows, true, nullptr, false);
            if (!curvature_.empty()) {
                T* curvature_rows[3];
                for (int k = 0; k < 3; ++k) curvature_rows[k] = curvature_forces + (row + k) % 3 * 3 * pitch_;
                add_curvature_row(curvature_, row, at, curvature_rows, true, nullptr);
            }
            if (!cells_.empty())
                add_air_row(at, cells_.of(row), plan_.cells_air(), cell_rows, row, true, !mass_cells_.empty(), nullptr);
            const T* const cells_below = cells_.empty() ? nullptr : air_cells(cell_rows, pitch_, row);
            if (!mass_cells_.empty())
                add_mass_row(at, mass_cells_.cells_of(row), plan_.cells_mass(), cells_below, mass_rows);
            if (carries_air_ && off_grid_.has_prescribed()) off_grid_.hold_row(row, -1, at);
            step(at, constants, {}, true);
            for (int c = 0; !whole && c < 3; ++c)
                std::copy_n(out + c * pitch_, grid_.columns, run_.v + c * plan_.count + row * grid_.columns);
        }
        return RunStatus::ok;
    }

private:
    static constexpr int rows_of_window = 3;

    T* row_of(std::int64_t row) { return window_.data() + row % rows_of_window * (damping_velocity + 3) * pitch_; }
    void load_row(std::int64_t row) {
        for (int c = 0; c < 3; ++c) {
            copy(row, run_.x0 + c * plan_.count, row_of(row) + (position + c) * pitch_);
            if (uses_velocity_) copy(row, run_.v0 + c * plan_.count, row_of(row) + (damping_velocity + c) * pitch_);
        }
    }
    void copy(std::int64_t row, const double* from, T* to) const {
        std::int64_t j = 0;
        if (row < grid_.rows) {
            from += row * grid_.columns;
            for (; j + lanes<T> <= grid_.columns; j += lanes<T>) store(to + j, load(from + j));
            for (; j < grid_.columns; ++j) to[j] = from[j];
        }
        // Whole vectors cover the pitch; those that begin in the row end in it or are filled one by one.
        for (; j % lanes<T>; ++j) to[j] = T(0);
        for (; j < pitch_; j += lanes<T>) store(to + j, vec<T>{});
    }

    Plan& plan_;
    const Run& run_;
    const Grid& grid_;
    OffGridForces<T> off_grid_;
    Array<T>& window_;
    const std::vector<RowTable<T>>& hinges_;
    const CellTable<T>&cells_, &mass_cells_;
    const CurvatureTable<T>& curvature_;
    const bool carries_air_;
    std::int64_t n_cell_numbers_ = 0;
    const std::int64_t pitch_;
    const bool uses_velocity_;
};

}  // namespace cloth::grid
