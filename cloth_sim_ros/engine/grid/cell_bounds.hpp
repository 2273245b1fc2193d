// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of panels and of added mass on the cells of a sheet, row by row. Each particle gets the sums of
// `add_list_bounds`, bit for bit.
#pragma once

#include "grid/cells.hpp"
#include "grid/curvature_bounds.hpp"
#include "grid/queries.hpp"
#include "laws/bound.hpp"

namespace cloth::grid {

using laws::law_params;

/// Bounds of a law of four corners on the cells of a list.
template <class Law>
class CellBounds {
public:
    CellBounds(const Grid& grid, const CellTable<double>& cells, const double* common,
               const PaddedRows<double>& positions)
        : cells_(cells), common_(common), positions_(positions), length_(row_length<double>(grid.columns)),
          pitch_(length_ + gap), numbers_(2 * parts * pitch_ + gap, 0.0) {}
    /// Add the bounds of a row's particles. Rows have to be processed in order from the first.
    CLOTH_SCHEDULED void add_row(std::int64_t row, BlockRow& to) {
        using V = vec<double>;
        const auto params = law_params<Law, V>(nullptr, common_);
        double *const below = cells_of(row), *const above = cells_of(row + 1);
        for (std::int64_t j = 0; j < length_; j += lanes<double>) {
            const auto point = [&](int down, int right)
                                   CLOTH_INLINED { return padded_point(positions_, row + down, j + right, 0); };
            const Vec3<V> first = point(0, 0), d[3] = {point(0, 1) - first, point(1, 1) - first, point(1, 0) - first};
            laws::Bound<V> bounds[4];
            Law::bounds(params, d, bounds);
            const auto present = load(cells_.of(row) + j) > V{};
            const Sym3<V>& c = bounds[0].damp;
            const V values[7] = {bounds[0].isotropic, c.xx, c.yy, c.zz, c.xy, c.xz, c.yz};
            for (int k = 0; k < parts; ++k) store(below + k * pitch_ + j, select(present, values[k], V{}));
        }
        for (std::int64_t j = 0; j < length_; j += lanes<double>) {
            const auto add = [&](double* numbers, int part) CLOTH_INLINED {
                const double *const up = above + part * pitch_ + j, *const down = below + part * pitch_ + j;
                const V sum = (((load(numbers + j) + load(up - 1)) + load(up)) + load(down - 1)) + load(down);
                store(numbers + j, sum);
            };
            for (int axis = 0; axis < 3; ++axis) add(to.stiff(axis), 0);
            for (int c = 0; c < (is_isotropic ? 3 : 6); ++c) add(to.damp(c), is_isotropic ? 1 : 1 + c);
        }
    }

private:
    /// Stiffness of a corner, and its damping: a number or a block. Zeros stand left of the first cell of each row, and
    /// above the first row.
    static constexpr bool is_isotropic = requires { Law::carries_mass; };
    static constexpr int parts = is_isotropic ? 2 : 7;
    static constexpr std::int64_t gap = 64 / sizeof(double);
    double* cells_of(std::int64_t row) { return numbers_.data() + gap + (row & 1) * parts * pitch_; }

    const CellTable<double>& cells_;
    const double* common_;
    const PaddedRows<double>& positions_;
    std::int64_t length_, pitch_;
    Array<double> numbers_;
};

}  // namespace cloth::grid
