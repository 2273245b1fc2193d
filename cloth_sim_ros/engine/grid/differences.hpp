// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Quadratic hinges of a regular sheet as a table by rows. All hinges of both checkerboards have one of three vectors as
// their sum: second differences along a row and along a column, and the twist of a cell. Their coefficients are summed.
#pragma once

#include "grid/stencils.hpp"

namespace cloth::grid {

/// Second differences along a row and a column, and twist.
enum Difference : int { along_row, along_column, twist };
inline constexpr int n_differences = 3;

/// Difference that each hinge stencil has as its sum, with its upper left particle relative to that of the stencil.
struct DifferenceOfStencil {
    Difference difference;
    int row, column;
    /// Corner at the centre of a second difference.
    int center;
};
inline constexpr DifferenceOfStencil difference_of_stencil[n_hinge_stencils] = {
    {twist, 0, 0, -1},    {twist, 0, 0, -1},       {along_row, 0, 0, 0},
    {along_row, 1, 0, 1}, {along_column, 0, 0, 1}, {along_column, 0, 1, 0}};

/// Slots of quadratic hinges, see `row_slots`; empty also if weights are not those of a regular sheet.
inline std::vector<std::int64_t> curvature_slots(const Grid& grid, const List& list) {
    std::vector<std::int64_t> slots = row_slots<4>(grid, list);
    for (std::size_t e = 0; e < slots.size(); ++e) {
        const double *const p = list.params.data() + list.numbers * e, w[4] = {-(p[0] + p[1] + p[2]), p[0], p[1], p[2]};
        const int center = difference_of_stencil[slots[e] / grid.columns % n_hinge_stencils].center;
        const bool fits = center < 0 ? w[2] == w[3] && w[0] == w[1] && w[0] == -w[2]
                                     : w[2] == w[3] && w[1 - center] == 0.0 && w[center] == -2.0 * w[2];
        if (!fits) return {};
    }
    return slots;
}

/// Stiffness [N/m] of each difference of a row's upper left particles, in padded rows.
template <class T>
class CurvatureTable {
public:
    CurvatureTable() = default;
    CurvatureTable(const Grid& grid, const List& list, const std::vector<std::int64_t>& slots)
        : time(list.common[0]), pitch_(row_pitch<T>(grid.columns)) {
        std::vector<double> sums(grid.rows * n_differences * pitch_, 0.0);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const std::int64_t line = slots[e] / grid.columns, column = slots[e] % grid.columns;
            const DifferenceOfStencil to = difference_of_stencil[line % n_hinge_stencils];
            const double *const p = list.params.data() + list.numbers * e, weight = p[1];
            const std::int64_t row = line / n_hinge_stencils + to.row;
            sums[(row * n_differences + to.difference) * pitch_ + column + to.column] += p[3] * weight * weight;
        }
        numbers_.assign(sums.size() + 64 / sizeof(T), T(0));
        for (std::size_t i = 0; i < sums.size(); ++i) numbers_[i] = static_cast<T>(sums[i]);
    }
    bool empty() const { return numbers_.empty(); }
    const T* of(std::int64_t row) const { return numbers_.data() + row * n_differences * pitch_; }

    /// Damping time [s].
    double time = 0.0;

private:
    std::int64_t pitch_ = 0;
    Array<T> numbers_;
};

}  // namespace cloth::grid
