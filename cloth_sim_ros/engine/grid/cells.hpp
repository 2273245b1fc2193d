// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Panels of air on the cells of a regular sheet, as a table by rows.
#pragma once

#include "grid/grid.hpp"
#include "mesh/elements.hpp"

namespace cloth::grid {

using mesh::List;

/// Cell of each panel of a list, row * columns + column of its upper left particle. Empty if a panel is not a cell, two
/// cover the same cell, or more than a third of the cells have none.
inline std::vector<std::int64_t> cell_slots(const Grid& grid, const List& list) {
    std::vector<std::int64_t> slots;
    std::vector<char> occupied(grid.count(), 0);
    for (std::int64_t e = 0; e < list.count; ++e) {
        const std::int64_t* const p = list.corners.data() + 4 * e;
        const std::int64_t first = *std::min_element(p, p + 4), below = first + grid.columns;
        // Either orientation around the cell: opposite corners decide.
        const auto opposite = [p](std::int64_t a, std::int64_t b) {
            return (p[0] == a && p[2] == b) || (p[2] == a && p[0] == b) || (p[1] == a && p[3] == b) ||
                   (p[3] == a && p[1] == b);
        };
        const bool inside = first / grid.columns + 1 < grid.rows && first % grid.columns + 1 < grid.columns;
        if (!inside || !opposite(first, below + 1) || !opposite(first + 1, below) || occupied[first]) return {};
        occupied[first] = 1;
        slots.push_back(first);
    }
    const std::int64_t all = (grid.rows - 1) * (grid.columns - 1);
    return 3 * list.count >= 2 * all ? slots : std::vector<std::int64_t>{};
}

/// Whether the elements of a list are cells in the order of rows, each with its corners in order around it from the
/// upper left one. `slots`: see `cell_slots`.
inline bool are_cells_in_order(const Grid& grid, const List& list, const std::vector<std::int64_t>& slots) {
    for (std::size_t e = 0; e < slots.size(); ++e) {
        const std::int64_t first = slots[e], below = first + grid.columns, *const p = list.corners.data() + 4 * e;
        if (p[0] != first || p[1] != first + 1 || p[2] != below + 1 || p[3] != below) return false;
        if (e > 0 && slots[e - 1] >= first) return false;
    }
    return !slots.empty();
}

/// Share of a corner in the panel of each cell, in padded rows: 1/4, or 0 without a panel. Equal rows share one.
template <class T>
class CellTable {
public:
    CellTable() = default;
    CellTable(const Grid& grid, const std::vector<std::int64_t>& slots) {
        const std::int64_t pitch = row_pitch<T>(grid.columns);
        std::vector<T> all(grid.rows * grid.columns, T(0));
        for (const std::int64_t slot : slots) all[slot] = T(0.25);
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            const T* const from = all.data() + row * grid.columns;
            if (row == 0 || !std::equal(from, from + grid.columns, from - grid.columns)) {
                numbers_.insert(numbers_.end(), from, from + grid.columns);
                numbers_.resize(numbers_.size() + pitch - grid.columns, T(0));
            }
            entry_.push_back(static_cast<std::int64_t>(numbers_.size()) - pitch);
            has_cells_.push_back(std::any_of(from, from + grid.columns, [](T share) { return share > T(0); }));
        }
        numbers_.resize(numbers_.size() + 64 / sizeof(T), T(0));
    }
    bool empty() const { return entry_.empty(); }
    const T* of(std::int64_t row) const { return numbers_.data() + entry_[row]; }
    /// The same, or null for a row without cells.
    const T* cells_of(std::int64_t row) const { return has_cells_[row] ? of(row) : nullptr; }

private:
    Array<T> numbers_;
    std::vector<std::int64_t> entry_;
    std::vector<char> has_cells_;
};

}  // namespace cloth::grid
