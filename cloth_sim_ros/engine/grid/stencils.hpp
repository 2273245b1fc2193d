// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Hinges of a regular sheet as tables by rows. A hinge has one of few stencils, the same for all columns of a row.
// Therefore its corners are vectors of rows, and nothing is gathered.
#pragma once

#include "grid/grid.hpp"
#include "mesh/elements.hpp"

namespace cloth::grid {

using mesh::Kind, mesh::List;

/// Stencil of an element: row and column of each corner relative to the topmost row and the leftmost column.
struct Stencil {
    int row[4], column[4];
};
/// Hinges of both checkerboard triangulations (sheets/surface.py): over a diagonal, then over an edge.
inline constexpr int n_hinge_stencils = 6, n_spring_stencils = 2;
inline constexpr Stencil hinge_stencils[n_hinge_stencils] = {
    {{1, 0, 0, 1}, {1, 0, 1, 0}}, {{0, 1, 0, 1}, {1, 0, 0, 1}}, {{0, 1, 0, 0}, {1, 1, 0, 2}},
    {{0, 1, 1, 1}, {1, 1, 0, 2}}, {{1, 1, 0, 2}, {1, 0, 0, 0}}, {{1, 1, 0, 2}, {1, 0, 1, 1}}};
/// Springs between the wings of the hinges over an edge.
inline constexpr Stencil spring_stencils[n_spring_stencils] = {{{0, 0}, {0, 2}}, {{0, 2}, {0, 0}}};

/// Of elements with this number of corners.
template <int Corners>
inline constexpr int n_stencils = Corners == 4 ? n_hinge_stencils : n_spring_stencils;
template <int Corners>
constexpr Stencil stencil_of(int k) {
    return Corners == 4 ? hinge_stencils[k] : spring_stencils[k];
}

/// Slot of each element of a list in tables by rows. Empty if an element matches no stencil, two have the same slot, or
/// so many slots are free that evaluating all would be slower.
template <int Corners>
inline std::vector<std::int64_t> row_slots(const Grid& grid, const List& list) {
    std::vector<std::int64_t> slots;
    std::vector<char> occupied(grid.count() * n_stencils<Corners>, 0), rows(grid.rows * n_stencils<Corners>, 0);
    for (std::int64_t e = 0; e < list.count; ++e) {
        const std::int64_t* const p = list.corners.data() + e * Corners;
        std::int64_t top = p[0] / grid.columns, left = p[0] % grid.columns;
        for (int c = 1; c < Corners; ++c) {
            top = std::min(top, p[c] / grid.columns);
            left = std::min(left, p[c] % grid.columns);
        }
        const auto matches = [&](int k) {
            const Stencil stencil = stencil_of<Corners>(k);
            for (int c = 0; c < Corners; ++c)
                if (p[c] / grid.columns != top + stencil.row[c] || p[c] % grid.columns != left + stencil.column[c])
                    return false;
            return true;
        };
        int k = 0;
        while (k < n_stencils<Corners> && !matches(k)) ++k;
        if (k == n_stencils<Corners>) return {};
        const std::int64_t row = top * n_stencils<Corners> + k, slot = row * grid.columns + left;
        if (occupied[slot]) return {};
        occupied[slot] = rows[row] = 1;
        slots.push_back(slot);
    }
    const std::int64_t all = std::count(rows.begin(), rows.end(), 1) * grid.columns;
    return 3 * list.count >= 2 * all ? slots : std::vector<std::int64_t>{};
}

/// A list as rows: for each row and stencil the parameters of the law, zero without an element.
template <class T>
class RowTable {
public:
    RowTable(const Grid& grid, const List& list, const std::vector<std::int64_t>& slots)
        : kind(list.kind), damped(list.damped) {
        const std::int64_t n_of_row = list.width == 4 ? n_hinge_stencils : n_spring_stencils,
                           pitch = row_pitch<T>(grid.columns);
        size_ = n_of_row * list.numbers * pitch;
        numbers_.assign(grid.rows * size_ + 64 / sizeof(T), T(0));
        has_.assign(grid.rows, 0);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const std::int64_t line = slots[e] / grid.columns, column = slots[e] % grid.columns;
            has_[line / n_of_row] = 1;
            for (std::int64_t p = 0; p < list.numbers; ++p)
                numbers_[(line * list.numbers + p) * pitch + column] =
                    static_cast<T>(list.params[e * list.numbers + p]);
        }
    }
    /// Whether a row, inside the sheet or not, owns an element.
    bool has(std::int64_t row) const { return row >= 0 && row < static_cast<std::int64_t>(has_.size()) && has_[row]; }
    const T* of(std::int64_t row) const { return numbers_.data() + row * size_; }

    Kind kind;
    bool damped;

private:
    std::int64_t size_;
    Array<T> numbers_;
    std::vector<char> has_;
};

}  // namespace cloth::grid
