// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of panels and of added mass on the cells of a sheet, and of its quadratic hinges, row by row. Each particle
// gets the sums of `add_list_bounds`, bit for bit.
#pragma once

#include "grid/cells.hpp"
#include "grid/queries.hpp"
#include "laws/quadratic.hpp"

namespace cloth::grid {

using laws::law_params;

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

/// Blocks of the particles of a row: stiffness, then damping, each as six rows of numbers.
struct BlockRow {
    explicit BlockRow(const Grid& grid) : pitch(row_pitch<double>(grid.columns)), numbers(12 * pitch, 0.0) {}
    double* stiff(int component) { return numbers.data() + component * pitch; }
    double* damp(int component) { return numbers.data() + (6 + component) * pitch; }

    std::int64_t pitch;
    Array<double> numbers;
};

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

/// Bounds of quadratic hinges, which do not depend on positions: for each particle the stiffness of one hinge after the
/// other, in padded rows. Equal rows share one.
class CurvatureBounds {
public:
    CurvatureBounds() = default;
    CurvatureBounds(const Grid& grid, const List& list)
        : time_(list.common[0]), pitch_(row_pitch<double>(grid.columns)), length_(row_length<double>(grid.columns)) {
        std::vector<std::vector<double>> terms(grid.count());
        for (std::int64_t e = 0; e < list.count; ++e) {
            const double* const numbers = list.params.data() + e * list.numbers;
            const Vec3<double> anywhere[3]{};
            laws::Bound<double> bounds[4];
            laws::QuadraticHinge::bounds(law_params<laws::QuadraticHinge, double>(numbers, list.common), anywhere,
                                         bounds);
            for (int c = 0; c < 4; ++c) terms[list.corners[e * list.width + c]].push_back(bounds[c].stiff.xx);
        }
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            const auto* const particles = terms.data() + row * grid.columns;
            std::size_t most = 0;
            for (std::int64_t j = 0; j < grid.columns; ++j) most = std::max(most, particles[j].size());
            std::vector<double> numbers(most * pitch_, 0.0);
            for (std::int64_t j = 0; j < grid.columns; ++j)
                for (std::size_t k = 0; k < particles[j].size(); ++k) numbers[k * pitch_ + j] = particles[j][k];
            const bool is_new = entry_.empty() || numbers_.size() - entry_.back() != numbers.size() ||
                                !std::equal(numbers.begin(), numbers.end(), numbers_.end() - numbers.size());
            if (is_new) numbers_.insert(numbers_.end(), numbers.begin(), numbers.end());
            entry_.push_back(numbers_.size() - numbers.size()), size_.push_back(numbers.size());
        }
    }
    bool empty() const { return entry_.empty(); }
    void add_row(std::int64_t row, BlockRow& to) const {
        using V = vec<double>;
        const double *const first = numbers_.data() + entry_[row], *const last = first + size_[row];
        const V time = splat<V>(time_);
        for (std::int64_t j = 0; j < length_; j += lanes<double>) {
            V k[3], c[3];
            for (int axis = 0; axis < 3; ++axis) k[axis] = load(to.stiff(axis) + j), c[axis] = load(to.damp(axis) + j);
            for (const double* terms = first; terms < last; terms += pitch_) {
                const V term = load(terms + j), rate = time * term;
                for (int axis = 0; axis < 3; ++axis) k[axis] = k[axis] + term, c[axis] = c[axis] + rate;
            }
            for (int axis = 0; axis < 3; ++axis) store(to.stiff(axis) + j, k[axis]), store(to.damp(axis) + j, c[axis]);
        }
    }

private:
    double time_ = 0.0;
    std::int64_t pitch_ = 0, length_ = 0;
    Array<double> numbers_;
    std::vector<std::size_t> entry_, size_;
};

}  // namespace cloth::grid
