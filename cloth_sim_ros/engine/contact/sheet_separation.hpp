// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Lower bound of the distance between parts of a regular sheet, without a search for pairs.
#pragma once

#include <cmath>
#include <limits>

#include "contact/surface.hpp"
#include "core/algebra.hpp"

namespace cloth::contact {

/// Bounds the distance of all pairs of a particle and a triangle, and of two edges, that share no particle.
///
/// The sheet is the image x(u) of a rectangle of cells, linear on triangles. For two points u and w of a convex part and
/// any matrix A,
///     |x(u) - x(w)| >= (s_min(A) - max |F - A|) |u - w|,
/// because x(u) - x(w) is the integral of the deformation gradient F along the segment between them (mean value
/// inequality). Parts are windows of two by two blocks of 2^l by 2^l cells: two cells are in adjacent blocks from some
/// level l on, so their distance |u - w| is at least a block of the level below. Where a window bends too much for the
/// bound, bounding boxes of the blocks below are compared.
class SheetSeparation {
public:
    /// Set a sheet of rows by columns, particles row by row, with distances at rest [m] between columns and between
    /// rows. A surface whose triangles are not halves of its cells gets no bounds.
    void set(const Surface& s, std::int64_t rows, std::int64_t columns, double column_spacing, double row_spacing) {
        levels_.clear();
        if (s.count != rows * columns || rows < 2 || columns < 2 || !are_halves_of_cells(s, rows, columns)) return;
        rows_ = rows, columns_ = columns, pitch_ = columns + lanes<double> + 1;
        spacing_[0] = column_spacing, spacing_[1] = row_spacing;
        for (auto& plane : position_) plane.assign(rows * pitch_, 0.0);
        for (std::int64_t r = rows - 1, c = columns - 1;; r = (r + 1) / 2, c = (c + 1) / 2) {
            levels_.emplace_back(r, c);
            if (r <= 2 && c <= 2) break;
        }
    }
    bool applies() const { return !levels_.empty(); }
    /// Lower bound of the distance [m] at finite positions x, quads; the search for it ends below `needed`. Boxes are
    /// compared where the bound is below `wanted`.
    double bound(const double* x, double needed, double wanted) {
        measure(x);
        bool has_boxes = false;
        double least = std::numeric_limits<double>::infinity();
        const double shorter = smaller(spacing_[0], spacing_[1]);
        for (std::size_t l = 0; l < levels_.size(); ++l) {
            if (l) levels_[l].unite(levels_[l - 1], 0, gradient_planes);
            // In adjacent cells, a corner of a cell is next to its diagonal.
            const double distance = l ? std::ldexp(shorter, static_cast<int>(l) - 1)
                                      : spacing_[0] * spacing_[1] / std::hypot(spacing_[0], spacing_[1]);
            const Level& level = levels_[l];
            for (std::int64_t r = 0; r < level.rows; ++r) {
                for (std::int64_t c = 0; c < level.columns; c += lanes<double>) {
                    const vec<double> bounds = distance * window_factor(level, r, c);
                    unsigned bits = l ? bits_of(bounds < splat<vec<double>>(wanted)) : 0u;
                    for (int lane = 0; lane < lanes<double> && c + lane < level.columns; ++lane) {
                        double bound = bounds[lane];
                        if (bits >> lane & 1u) {
                            if (!has_boxes) build_boxes();
                            has_boxes = true;
                            bound = larger(box_distance(levels_[l - 1], 2 * r, 2 * (c + lane)), bound);
                        }
                        least = smaller(bound, least);
                    }
                }
                if (!(least >= needed)) return least;
            }
        }
        return (1.0 - rounding) * least;
    }

private:
    /// Planes of a level: least and largest derivatives along columns, and along rows, by component; least and largest
    /// positions.
    static constexpr int gradient_planes = 12, planes = 18;
    static constexpr double rounding = 1e-6;

    /// Blocks of cells. Each row is padded with copies of its last block.
    struct Level {
        std::int64_t rows, columns, pitch;
        std::vector<double> plane[planes];

        Level(std::int64_t r, std::int64_t c) : rows(r), columns(c), pitch(c + lanes<double> + 1) {
            for (auto& numbers : plane) numbers.assign(r * pitch, 0.0);
        }
        /// Whether a plane has largest numbers.
        static bool is_upper(int k) { return k / 3 % 2; }
        void pad(int first, int last) {
            for (int k = first; k < last; ++k)
                for (std::int64_t r = 0; r < rows; ++r) {
                    double* const row = plane[k].data() + r * pitch;
                    std::fill(row + columns, row + pitch, row[columns - 1]);
                }
        }
        /// Set planes to those of two by two blocks of a finer level.
        void unite(const Level& finer, int first, int last) {
            for (int k = first; k < last; ++k)
                for (std::int64_t r = 0; r < rows; ++r) {
                    const double* const upper = finer.plane[k].data() + 2 * r * finer.pitch;
                    const double* const lower = 2 * r + 1 < finer.rows ? upper + finer.pitch : upper;
                    double* const row = plane[k].data() + r * pitch;
                    // Of an odd number of blocks, the last is united with its copy.
                    for (std::int64_t c = 0; c < columns; ++c) {
                        const double a = upper[2 * c], b = upper[2 * c + 1], d = lower[2 * c], e = lower[2 * c + 1];
                        row[c] = is_upper(k) ? larger(larger(a, b), larger(d, e)) : smaller(smaller(a, b), smaller(d, e));
                    }
                }
            pad(first, last);
        }
    };

    /// Whether each triangle is half of a cell, and no two of a cell overlap.
    static bool are_halves_of_cells(const Surface& s, std::int64_t rows, std::int64_t columns) {
        std::vector<int> missing((rows - 1) * (columns - 1), -1);
        for (const auto& t : s.triangles) {
            std::int64_t row = rows, column = columns;
            for (const Index i : t) row = std::min(row, i / columns), column = std::min(column, i % columns);
            if (row + 1 >= rows || column + 1 >= columns) return false;
            // Corners of the cell, in turn about it.
            const std::int64_t corner = row * columns + column;
            const std::int64_t around[4] = {corner, corner + 1, corner + columns + 1, corner + columns};
            int absent = -1, n_absent = 0;
            for (int k = 0; k < 4; ++k)
                if (std::find(t.begin(), t.end(), around[k]) == t.end()) absent = k, ++n_absent;
            int& other = missing[row * (columns - 1) + column];
            if (n_absent != 1 || (other >= 0 && other != (absent + 2) % 4)) return false;
            other = absent;
        }
        return true;
    }
    /// Set positions and the derivatives of each cell: both of its sides bound them, for either diagonal.
    void measure(const double* x) {
        using V = vec<double>;
        for (std::int64_t r = 0; r < rows_; ++r)
            for (std::int64_t c = 0; c < columns_; ++c)
                for (int k = 0; k < 3; ++k) position_[k][r * pitch_ + c] = x[4 * (r * columns_ + c) + k];
        Level& cells = levels_[0];
        const V along = splat<V>(1.0 / spacing_[0]), across = splat<V>(1.0 / spacing_[1]);
        for (int k = 0; k < 3; ++k)
            for (std::int64_t r = 0; r < cells.rows; ++r)
                for (std::int64_t c = 0; c < cells.columns; c += lanes<double>) {
                    const double* const corner = position_[k].data() + r * pitch_ + c;
                    const V a = load(corner), b = load(corner + 1), d = load(corner + pitch_),
                            e = load(corner + pitch_ + 1);
                    const V top = along * (b - a), bottom = along * (e - d), left = across * (d - a),
                            right = across * (e - b);
                    const std::int64_t at = r * cells.pitch + c;
                    store(cells.plane[k].data() + at, smaller(top, bottom));
                    store(cells.plane[3 + k].data() + at, larger(top, bottom));
                    store(cells.plane[6 + k].data() + at, smaller(left, right));
                    store(cells.plane[9 + k].data() + at, larger(left, right));
                }
        cells.pad(0, gradient_planes);
    }
    void build_boxes() {
        Level& cells = levels_[0];
        for (int k = gradient_planes; k < planes; ++k)
            for (std::int64_t r = 0; r < cells.rows; ++r)
                for (std::int64_t c = 0; c < cells.columns; ++c) {
                    const double* const corner = position_[k % 3].data() + r * pitch_ + c;
                    const double a = corner[0], b = corner[1], d = corner[pitch_], e = corner[pitch_ + 1];
                    cells.plane[k][r * cells.pitch + c] = Level::is_upper(k)
                                                              ? larger(larger(a, b), larger(d, e))
                                                              : smaller(smaller(a, b), smaller(d, e));
                }
        cells.pad(gradient_planes, planes);
        for (std::size_t l = 1; l < levels_.size(); ++l)
            levels_[l].unite(levels_[l - 1], gradient_planes, planes);
    }
    /// s_min(A) - max |F - A| of a vector of windows, A in the middle of the derivatives.
    static CLOTH_INLINE vec<double> window_factor(const Level& level, std::int64_t r, std::int64_t c) {
        using V = vec<double>;
        const std::int64_t at = r * level.pitch + c, below = r + 1 < level.rows ? at + level.pitch : at;
        const auto united = [&](int k, auto&& choose) CLOTH_INLINED {
            const double* const from = level.plane[k].data();
            return choose(choose(load(from + at), load(from + at + 1)),
                          choose(load(from + below), load(from + below + 1)));
        };
        const V half = splat<V>(0.5);
        V center[2][3], spread{};
        for (int side = 0; side < 2; ++side)
            for (int k = 0; k < 3; ++k) {
                const V low = united(6 * side + k, [](V a, V b) CLOTH_INLINED { return smaller(a, b); });
                const V high = united(6 * side + 3 + k, [](V a, V b) CLOTH_INLINED { return larger(a, b); });
                center[side][k] = half * (low + high);
                const V deviation = half * (high - low);
                spread = fma(deviation, deviation, spread);
            }
        const Vec3<V> a{center[0][0], center[0][1], center[0][2]}, b{center[1][0], center[1][1], center[1][2]};
        const V aa = norm2(a), bb = norm2(b), ab = dot(a, b), difference = aa - bb, twice = ab + ab;
        // Smaller eigenvalue of the transpose of A times A.
        const V square = half * (aa + bb - root(fma(difference, difference, twice * twice)));
        return root(larger(square, V{})) - root(spread);
    }
    /// Least distance of the boxes of two blocks that are not adjacent, among four by four from a row and a column on.
    static double box_distance(const Level& level, std::int64_t row, std::int64_t column) {
        const std::int64_t rows = std::min(row + 4, level.rows), columns = std::min(column + 4, level.columns);
        double least = std::numeric_limits<double>::infinity();
        for (std::int64_t r = row; r < rows; ++r)
            for (std::int64_t c = column; c < columns; ++c)
                for (std::int64_t r2 = r; r2 < rows; ++r2)
                    for (std::int64_t c2 = column; c2 < columns; ++c2) {
                        if (r2 - r < 2 && std::abs(c2 - c) < 2) continue;
                        double square = 0.0;
                        for (int k = 0; k < 3; ++k) {
                            const double *const low = level.plane[12 + k].data(),
                                         *const high = level.plane[15 + k].data();
                            const std::int64_t one = r * level.pitch + c, other = r2 * level.pitch + c2;
                            const double gap = larger(larger(low[one] - high[other], low[other] - high[one]), 0.0);
                            square += gap * gap;
                        }
                        least = smaller(square, least);
                    }
        return root(least);
    }

    std::int64_t rows_ = 0, columns_ = 0, pitch_ = 0;
    double spacing_[2] = {};
    std::vector<double> position_[3];
    std::vector<Level> levels_;
};

}  // namespace cloth::contact
