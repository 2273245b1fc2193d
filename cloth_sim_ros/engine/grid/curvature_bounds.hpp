// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Stiffness and damping bounds of a row's particles, and those of a sheet's quadratic hinges as a table by rows.
#pragma once

#include "core/algebra.hpp"
#include "grid/grid.hpp"

namespace cloth::grid {

/// Blocks of the particles of a row: stiffness, then damping, each as six rows of numbers.
struct BlockRow {
    explicit BlockRow(const Grid& grid) : pitch(row_pitch<double>(grid.columns)), numbers(12 * pitch, 0.0) {}
    double* stiff(int component) { return numbers.data() + component * pitch; }
    double* damp(int component) { return numbers.data() + (6 + component) * pitch; }

    std::int64_t pitch;
    Array<double> numbers;
};

/// Bounds of quadratic hinges, which do not depend on positions: for each particle the stiffness of one hinge after the
/// other, in padded rows. Equal rows share one.
class CurvatureBounds {
public:
    CurvatureBounds() = default;
    /// `terms`: stiffnesses of each particle; damping is a damping time [s] times them.
    CurvatureBounds(const Grid& grid, double time, const std::vector<std::vector<double>>& terms)
        : time_(time), pitch_(row_pitch<double>(grid.columns)), length_(row_length<double>(grid.columns)) {
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
