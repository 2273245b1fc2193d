// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// One evaluation of a sheet: its rows pass through a window of three, which stays in the first cache.
#pragma once

#include "beside.hpp"
#include "grid_air.hpp"
#include "grid_bends.hpp"
#include "grid_takers.hpp"

namespace cloth {

class GridForces {
    using T = double;

public:
    /// Accelerations at the start of a run without steps go where its velocities at the end would.
    GridForces(Plan& plan, const Run& run)
        : plan_(plan), run_(run), grid_(*plan.grid), beside_(plan, run), window_(plan.room<T>().window),
          bends_(plan.row_tables<T>()), cells_(plan.cell_table<T>()), pitch_(plan.tables.pitch), moving_(plan.mode() != Mode::still) {
        const std::int64_t kept = cells_.empty() ? 0 : 2 * air_row_size<T>(pitch_);
        window_.resize((rows_of_window * (seen + 3) + 2 * 3 * 3 + 3) * pitch_ + kept + 64 / sizeof(T));
        beside_.hold(1);
        beside_.touch_rows(1, pitch_);
    }
    Done go() {
        if (beside_.needed()) {
            beside_.make({0, plan_.count});
            for (std::int64_t row = 0; row < grid_.rows; ++row) {
                load_row(row);
                beside_.show(position, row, row_of(row), pitch_);
                beside_.show(seen, row, row_of(row) + seen * pitch_, pitch_);
            }
            const Done done = beside_.forces(-1, 0);
            if (done != Done::well) return done;
        }
        const TakeRow<T> take = row_taker<T>(grid_.shape(), plan_.mode());
        const GridConstants<T> constants = grid_constants<T>(plan_);
        T *const ring = window_.data() + rows_of_window * (seen + 3) * pitch_, *const bent = ring + 3 * 3 * pitch_;
        T *const out = bent + 3 * 3 * pitch_, *const kept = out + 3 * pitch_;
        std::fill(ring, window_.data() + window_.size(), T(0));
        load_row(0);
        load_row(1);
        // Rows of whole vectors are written where they belong.
        const bool whole = row_length<T>(grid_.columns) == grid_.columns;
        for (std::int64_t row = 0; row < grid_.rows; ++row) {
            load_row(row + 2);
            RowPlace<T> at;
            for (int k = 0; k < 3; ++k) {
                at.row[k] = row_of(row + k);
                at.ring[k] = ring + (row + k) % 3 * 3 * pitch_;
            }
            at.entry = plan_.tables.of(row);
            at.pitch = pitch_;
            at.length = row_length<T>(grid_.columns);
            at.accelerations = whole ? run_.v + row * grid_.columns : out;
            at.apart = whole ? plan_.count : pitch_;
            beside_.add_row(0, row, -1, at, false);
            T* sums[3];
            for (int k = 0; k < 3; ++k) sums[k] = bent + (row + k) % 3 * 3 * pitch_;
            if (!bends_.empty()) take_bends(bends_, row, at, sums, true, nullptr, false);
            if (!cells_.empty()) take_air(at, cells_.of(row), plan_.cells_air(), kept, row, true, nullptr);
            take(at, constants, {}, true);
            for (int c = 0; !whole && c < 3; ++c)
                std::copy_n(out + c * pitch_, grid_.columns, run_.v + c * plan_.count + row * grid_.columns);
        }
        return Done::well;
    }

private:
    static constexpr int rows_of_window = 3;

    T* row_of(std::int64_t row) { return window_.data() + row % rows_of_window * (seen + 3) * pitch_; }
    void load_row(std::int64_t row) {
        for (int c = 0; c < 3; ++c) {
            copy(row, run_.x0 + c * plan_.count, row_of(row) + (position + c) * pitch_);
            if (moving_) copy(row, run_.v0 + c * plan_.count, row_of(row) + (seen + c) * pitch_);
        }
    }
    void copy(std::int64_t row, const double* from, T* to) const {
        std::int64_t j = 0;
        if (row < grid_.rows) {
            from += row * grid_.columns;
            for (; j + lanes<T> <= grid_.columns; j += lanes<T>) store(to + j, load(from + j));
            for (; j < grid_.columns; ++j) to[j] = from[j];
        }
        // Whole vectors cover a pitch; those that begin in the row end in it or are filled one by one.
        for (; j % lanes<T>; ++j) to[j] = T(0);
        for (; j < pitch_; j += lanes<T>) store(to + j, vec<T>{});
    }

    Plan& plan_;
    const Run& run_;
    const Grid& grid_;
    Beside<T> beside_;
    Array<T>& window_;
    const std::vector<RowTable<T>>& bends_;
    const CellTable<T>& cells_;
    const std::int64_t pitch_;
    const bool moving_;
};

}  // namespace cloth
