// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Separation of a regular sheet from itself, without a list of pairs.
#pragma once

#include <bit>
#include <cmath>
#include <cstring>
#include <initializer_list>
#include <limits>
#include <span>

#include "contact/sheet_pairs.hpp"

namespace cloth::contact {

/// Bounds the distance of all pairs of a particle and a triangle, and of two edges, that share no particle.
///
/// The sheet is the image x(u) of a rectangle of cells, linear on triangles. For two points u and w of a convex part
/// and any matrix A,
///     |x(u) - x(w)| >= (s_min(A) - max |F - A|) |u - w|,
/// because x(u) - x(w) is the integral of the deformation gradient F along the segment between them (mean value
/// inequality). Their relative speed is at most max |dv/du| |u - w|. Parts are windows of two by two blocks of 2^l by
/// 2^l cells: two cells are in adjacent blocks from some level l on, so |u - w| is at least a block of the level below.
/// Where a window bends too much for the bound, boxes of its blocks are compared, then finer ones, and pairs at last.
/// Distances do not tell if an edge has pierced a triangle. Bounds are calculated in the type S, those of pairs in double
/// precision.
template <class S>
class SheetSeparation {
public:
    /// Set a sheet of rows by columns, particles row by row, with distances at rest [m] between columns and between
    /// rows. A surface whose triangles are not halves of its cells gets no bounds.
    void set(const Surface& surface, std::int64_t rows, std::int64_t columns, double column_spacing,
             double row_spacing) {
        levels_.clear();
        if (surface.count != rows * columns || rows < 2 || columns < 2 || !pairs_.set(surface, rows, columns)) return;
        rows_ = rows, columns_ = columns, pitch_ = columns + lanes<S> + 1;
        spacing_[0] = column_spacing, spacing_[1] = row_spacing;
        for (auto& plane : component_) plane.assign(rows * pitch_, S(0));
        for (std::int64_t r = rows - 1, c = columns - 1;; r = (r + 1) / 2, c = (c + 1) / 2) {
            levels_.emplace_back(r, c);
            if (r <= 2 && c <= 2) break;
        }
    }
    bool applies() const { return !levels_.empty(); }
    /// The motions, among one or two from positions x, (3, n), that keep all pairs at least `needed` [m] apart: bit k
    /// stands for the k-th. A motion is left out where that takes too much work, and for numbers beyond `largest`.
    unsigned separated_motions(const double* x, std::initializer_list<SheetMotion> motions, double needed) {
        if (!applies() || !measure(x, motions)) return 0;
        x_ = x, motions_ = {motions.begin(), motions.size()}, needed_ = with_rounding(needed);
        has_boxes_ = false;
        work_left_ = work_per_cell * pairs_.cell_count() + min_work;
        separated_ = (1u << motions.size()) - 1;
        for_each_bent_window([&](std::size_t l, std::int64_t r, std::int64_t c, unsigned bent) {
            checked_ = separated_ & bent;
            if (checked_) l ? check_window(l - 1, 2 * r, 2 * c) : check_cells(r, c);
            return separated_ != 0;
        });
        return separated_;
    }
    /// Whether windows alone keep all pairs at positions x, and on up to two motions from there, at least `needed` [m]
    /// apart. Then nothing has pierced anything.
    bool is_clear(const double* x, double needed, std::initializer_list<SheetMotion> motions = {}) {
        if (!applies() || !measure(x, motions)) return false;
        needed_ = with_rounding(needed);
        return for_each_bent_window([](auto...) { return false; });
    }

private:
    /// Planes of a level: squared largest derivatives of two motions' displacements; least and largest derivatives of
    /// the position along columns, and along rows, by component; least and largest positions; least and largest
    /// velocities of two motions.
    static constexpr int first_derivative = 2, first_position = 14, first_speed = 20, planes = 32;
    static constexpr double largest = 1e30;
    /// Rounding of bounds, relative to them and to the largest coordinate or displacement.
    static constexpr double rounding = sizeof(S) == 8 ? 1e-6 : 1e-5, rounding_of_size = sizeof(S) == 8 ? 0.0 : 4e-6;
    /// Work limit, in pairs of blocks: beyond it a search for pairs is cheaper. Work of the pairs of some cells.
    static constexpr std::int64_t work_per_cell = 16, min_work = 4096, cells_work = 100;
    /// Blocks in a row of a window, and, as bits, those after each block that are not adjacent to it.
    static constexpr std::int64_t window_size = 4;
    static constexpr auto distant_blocks = [] {
        std::array<unsigned, window_size * window_size> bits{};
        for (std::int64_t i = 0; i < window_size * window_size; ++i)
            for (std::int64_t j = i + 1; j < window_size * window_size; ++j) {
                const std::int64_t columns = j % window_size - i % window_size;
                if (j / window_size - i / window_size >= 2 || columns >= 2 || columns <= -2) bits[i] |= 1u << j;
            }
        return bits;
    }();

    /// Blocks of cells. Each row is padded with copies of its last block.
    struct Level {
        std::int64_t rows, columns, pitch;
        std::vector<S> plane[planes];

        Level(std::int64_t r, std::int64_t c) : rows(r), columns(c), pitch(c + lanes<S> + 1) {
            for (auto& numbers : plane) numbers.assign(r * pitch, S(0));
        }
        /// Whether a plane has largest numbers.
        static bool is_upper(int k) { return k < first_derivative || (k - first_derivative) / 3 % 2; }
        void pad(int first, int last) {
            for (int k = first; k < last; ++k)
                for (std::int64_t r = 0; r < rows; ++r) {
                    S* const row = plane[k].data() + r * pitch;
                    std::fill(row + columns, row + pitch, row[columns - 1]);
                }
        }
        /// Set planes to those of two by two blocks of a finer level.
        void unite(const Level& finer, int first, int last) {
            const auto smallest = [](vec<S> a, vec<S> b) CLOTH_INLINED { return smaller(a, b); };
            const auto largest = [](vec<S> a, vec<S> b) CLOTH_INLINED { return larger(a, b); };
            for (int k = first; k < last; ++k) is_upper(k) ? unite(finer, k, largest) : unite(finer, k, smallest);
            pad(first, last);
        }
        template <class F>
        void unite(const Level& finer, int k, F&& choose) {
            using V = vec<S>;
            // Of an odd number of blocks, the last is united with its copy.
            const std::int64_t end = 2 * columns;
            united_.resize(end + 3 * lanes<S>);
            S* const both = united_.data();
            for (std::int64_t r = 0; r < rows; ++r) {
                const S* const upper = finer.plane[k].data() + 2 * r * finer.pitch;
                const S* const lower = 2 * r + 1 < finer.rows ? upper + finer.pitch : upper;
                for (std::int64_t c = 0; c < end; c += lanes<S>)
                    store(both + c, choose(load(upper + c), load(lower + c)));
                for (std::int64_t c = 0; c < columns; c += lanes<S>) {
                    V even, odd;
                    split_pairs(load(both + 2 * c), load(both + 2 * c + lanes<S>), even, odd);
                    store(plane[k].data() + r * pitch + c, choose(even, odd));
                }
            }
        }

    private:
        std::vector<S> united_;  ///< blocks of two rows
    };

    /// Call visit(level, row, column, motions) with each window that bends too much for the bound, and the motions, by
    /// plane, for which it does, until that returns false. Return whether it never did.
    template <class F>
    bool for_each_bent_window(F&& visit) {
        const auto is_bent = [&](vec<S> bounds) {
            return bits_of(!(bounds >= splat<vec<S>>(static_cast<S>(needed_))));
        };
        for (std::size_t l = 0; l < levels_.size(); ++l) {
            if (l) levels_[l].unite(levels_[l - 1], 0, first_position);
            // In adjacent cells, a corner of a cell is next to its diagonal.
            const double distance_of_blocks =
                l ? std::ldexp(smaller(spacing_[0], spacing_[1]), static_cast<int>(l) - 1)
                  : spacing_[0] * spacing_[1] / root(cloth::fma(spacing_[0], spacing_[0], spacing_[1] * spacing_[1]));
            const vec<S> distance = splat<vec<S>>(static_cast<S>(distance_of_blocks));
            const Level& level = levels_[l];
            for (std::int64_t r = 0; r < level.rows; ++r)
                for (std::int64_t c = 0; c < level.columns; c += lanes<S>) {
                    const WindowFactor factor = window_factor(level, r, c);
                    const unsigned bent[2] = {is_bent(distance * (factor.at_rest - factor.derivative[0])),
                                              is_bent(distance * (factor.at_rest - factor.derivative[1]))};
                    if (!(bent[0] | bent[1])) continue;
                    // Padding repeats the last window.
                    for (int lane = 0; lane < lanes<S> && c + lane < level.columns; ++lane) {
                        const unsigned motions = (bent[0] >> lane & 1u) | (bent[1] >> lane & 1u) << 1;
                        if (motions && !visit(l, r, c + lane, motions)) return false;
                    }
                }
        }
        return true;
    }
    double with_rounding(double needed) const { return (1.0 + rounding) * needed + rounding_of_size * size_; }
    /// Copy an array (3, n) into padded rows. Return whether all numbers are finite and below `largest`. Single
    /// precision has differences from the first particle.
    bool copy(const double* a) {
        using V = vec<S>;
        V most{};
        V excess{};
        for (int k = 0; k < 3; ++k) {
            const double origin = sizeof(S) == 8 ? 0.0 : a[k * rows_ * columns_];
            for (std::int64_t r = 0; r < rows_; ++r) {
                S* const row = component_[k].data() + r * pitch_;
                const double* const from = a + (k * rows_ + r) * columns_;
                for (std::int64_t c = 0; c < columns_; ++c) row[c] = static_cast<S>(from[c] - origin);
                for (std::int64_t c = 0; c < columns_; c += lanes<S>) {
                    const V size = absolute(load(row + c));
                    most = larger(size, most);
                    excess += select(size < splat<V>(static_cast<S>(largest)), V{}, splat<V>(S(1)));
                }
            }
        }
        double sum = 0.0;
        for (int lane = 0; lane < lanes<S>; ++lane) {
            sum += static_cast<double>(excess[lane]);
            size_ = larger(static_cast<double>(most[lane]), size_);
        }
        return sum == 0.0;
    }
    /// Set the derivatives of each cell: its sides bound them, for either diagonal. Return false beyond `largest`.
    bool measure(const double* x, std::initializer_list<SheetMotion> motions) {
        using V = vec<S>;
        size_ = 0.0;
        struct Sides {
            V top, bottom, left, right;
        };
        Level& cells = levels_[0];
        const V along = splat<V>(static_cast<S>(1.0 / spacing_[0])),
                across = splat<V>(static_cast<S>(1.0 / spacing_[1]));
        const auto sides_of = [&](const S* corner) CLOTH_INLINED {
            const V a = load(corner), b = load(corner + 1), d = load(corner + pitch_), e = load(corner + pitch_ + 1);
            return Sides{along * (b - a), along * (e - d), across * (d - a), across * (e - b)};
        };
        const auto for_each_vector = [&](auto&& visit) CLOTH_INLINED {
            for (std::int64_t r = 0; r < cells.rows; ++r)
                for (std::int64_t c = 0; c < cells.columns; c += lanes<S>) visit(r * pitch_ + c, r * cells.pitch + c);
        };
        for (std::size_t k = motions.size(); k < SheetPairs::max_motions; ++k)
            std::fill(cells.plane[k].begin(), cells.plane[k].end(), S(0));
        for (std::size_t k = 0; k < motions.size(); ++k) {
            const SheetMotion& motion = motions.begin()[k];
            const double square = motion.duration * motion.duration;
            if (!(square < largest && copy(motion.v))) return false;
            for_each_vector([&](std::int64_t from, std::int64_t to) CLOTH_INLINED {
                Sides sums{};
                for (const auto& component : component_) {
                    const Sides sides = sides_of(component.data() + from);
                    sums = {fma(sides.top, sides.top, sums.top), fma(sides.bottom, sides.bottom, sums.bottom),
                            fma(sides.left, sides.left, sums.left), fma(sides.right, sides.right, sums.right)};
                }
                const V derivative = larger(sums.top, sums.bottom) + larger(sums.left, sums.right);
                store(cells.plane[k].data() + to, splat<V>(static_cast<S>(square)) * derivative);
            });
            if (!motion.deviations) continue;
            // Deviations of the ends of a side change its derivative by up to their sum over its length.
            if (!copy_deviations(motion.deviations)) return false;
            const V factor = splat<V>(static_cast<S>(
                2.0 * root(cloth::fma(1.0 / spacing_[0], 1.0 / spacing_[0], 1.0 / (spacing_[1] * spacing_[1])))));
            for_each_vector([&](std::int64_t from, std::int64_t to) CLOTH_INLINED {
                S* const plane = cells.plane[k].data() + to;
                const V derivative = fma(factor, largest_deviation(from), root(load(plane)));
                store(plane, derivative * derivative);
            });
        }
        if (!copy(x)) return false;
        for (int k = 0; k < 3; ++k)
            for_each_vector([&](std::int64_t from, std::int64_t to) CLOTH_INLINED {
                const Sides sides = sides_of(component_[k].data() + from);
                store(cells.plane[first_derivative + k].data() + to, smaller(sides.top, sides.bottom));
                store(cells.plane[first_derivative + 3 + k].data() + to, larger(sides.top, sides.bottom));
                store(cells.plane[first_derivative + 6 + k].data() + to, smaller(sides.left, sides.right));
                store(cells.plane[first_derivative + 9 + k].data() + to, larger(sides.left, sides.right));
            });
        cells.pad(0, first_position);
        return true;
    }
    /// Copy deviations into padded rows. Return whether all are finite and below `largest`.
    bool copy_deviations(const double* from) {
        deviation_.resize(component_[0].size());
        double most = 0.0;
        for (std::int64_t r = 0; r < rows_; ++r)
            for (std::int64_t c = 0; c < columns_; ++c) {
                const double deviation = from[r * columns_ + c];
                deviation_[r * pitch_ + c] = static_cast<S>(deviation);
                most = deviation <= most ? most : deviation;  // a deviation that is NaN is kept
            }
        return most < largest;
    }
    /// Largest deviations of the corners of a vector of cells.
    CLOTH_INLINE vec<S> largest_deviation(std::int64_t corner) const {
        const S *const at = deviation_.data() + corner, *const below = at + pitch_;
        return larger(larger(load(at), load(at + 1)), larger(load(below), load(below + 1)));
    }
    /// Set least and largest numbers of each cell from `component_`.
    void bound_cells(int first) {
        using V = vec<S>;
        Level& cells = levels_[0];
        for (int k = 0; k < 3; ++k)
            for (std::int64_t r = 0; r < cells.rows; ++r)
                for (std::int64_t c = 0; c < cells.columns; c += lanes<S>) {
                    const S* const corner = component_[k].data() + r * pitch_ + c;
                    const S* const below = corner + pitch_;
                    const V a = load(corner), b = load(corner + 1), d = load(below), e = load(below + 1);
                    S* const low = cells.plane[first + k].data() + r * cells.pitch + c;
                    store(low, smaller(smaller(a, b), smaller(d, e)));
                    S* const high = cells.plane[first + 3 + k].data() + r * cells.pitch + c;
                    store(high, larger(larger(a, b), larger(d, e)));
                }
    }
    /// Expand the boxes of the velocities of cells by what particles deviate.
    void expand_cells(int first, const SheetMotion& motion) {
        using V = vec<S>;
        Level& cells = levels_[0];
        copy_deviations(motion.deviations);
        const V per_time = splat<V>(static_cast<S>(1.0 / std::fabs(motion.duration)));
        for (std::int64_t r = 0; r < cells.rows; ++r)
            for (std::int64_t c = 0; c < cells.columns; c += lanes<S>) {
                const V width = per_time * largest_deviation(r * pitch_ + c);
                for (int k = first; k < first + 6; ++k) {
                    S* const at = cells.plane[k].data() + r * cells.pitch + c;
                    store(at, k < first + 3 ? load(at) - width : load(at) + width);
                }
            }
    }
    int n_motions() const { return static_cast<int>(motions_.size()); }
    void build_boxes() {
        copy(x_);
        bound_cells(first_position);
        for (int k = 0; k < n_motions(); ++k) {
            copy(motions_[k].v);
            bound_cells(first_speed + 6 * k);
            if (motions_[k].deviations) expand_cells(first_speed + 6 * k, motions_[k]);
        }
        const int end = first_speed + 6 * n_motions();
        levels_[0].pad(first_position, end);
        for (std::size_t l = 1; l < levels_.size(); ++l) levels_[l].unite(levels_[l - 1], first_position, end);
        double approach = 0.0;
        for (int k = 0; k < n_motions(); ++k) {
            double square = 0.0;
            for (int plane = first_speed + 6 * k; plane < first_speed + 6 * k + 3; ++plane) {
                const auto &least = levels_.back().plane[plane], &most = levels_.back().plane[plane + 3];
                const double range = static_cast<double>(*std::max_element(most.begin(), most.end()) -
                                                         *std::min_element(least.begin(), least.end()));
                square = cloth::fma(range, range, square);
            }
            approach = larger(std::fabs(motions_[k].duration) * root(square), approach);
        }
        far_square_ = (needed_ + approach) * (needed_ + approach);
        has_boxes_ = true;
    }
    /// Of a vector of windows: s_min(A) - max |F - A|, A in the middle of the derivatives; largest derivatives of the
    /// displacements of two motions.
    struct WindowFactor {
        vec<S> at_rest, derivative[2];
    };
    CLOTH_INLINE WindowFactor window_factor(const Level& level, std::int64_t r, std::int64_t c) const {
        using V = vec<S>;
        const std::int64_t at = r * level.pitch + c, below = r + 1 < level.rows ? at + level.pitch : at;
        const auto united = [&](int k, auto&& choose) CLOTH_INLINED {
            const S* const from = level.plane[k].data();
            return choose(choose(load(from + at), load(from + at + 1)),
                          choose(load(from + below), load(from + below + 1)));
        };
        const auto least = [](V a, V b) CLOTH_INLINED { return smaller(a, b); };
        const auto largest = [](V a, V b) CLOTH_INLINED { return larger(a, b); };
        const V half = splat<V>(S(0.5));
        V center[2][3], spread{};
        for (int axis = 0; axis < 2; ++axis)
            for (int k = 0; k < 3; ++k) {
                const V low = united(first_derivative + 6 * axis + k, least);
                const V high = united(first_derivative + 6 * axis + 3 + k, largest);
                center[axis][k] = half * (low + high);
                const V deviation = half * (high - low);
                spread = fma(deviation, deviation, spread);
            }
        const Vec3<V> a{center[0][0], center[0][1], center[0][2]}, b{center[1][0], center[1][1], center[1][2]};
        const V aa = norm2(a), bb = norm2(b), ab = dot(a, b), difference = aa - bb, twice = ab + ab;
        // Smaller eigenvalue of the transpose of A times A.
        const V square = half * (aa + bb - root(fma(difference, difference, twice * twice)));
        return {root(larger(square, V{})) - root(spread), {root(united(0, largest)), root(united(1, largest))}};
    }
    /// Check the motions `checked_` for the pairs of those blocks that are not adjacent, among four by four from a row
    /// and a column on. As all checks, return whether one of them is left that separates all pairs so far.
    bool check_window(std::size_t l, std::int64_t row, std::int64_t column) {
        if (!has_boxes_) build_boxes();
        using V = vec<S>;
        const Level& level = levels_[l];
        constexpr std::int64_t size = window_size, count = size * size;
        const std::int64_t rows = std::min(size, level.rows - row), columns = std::min(size, level.columns - column);
        // Boxes of the blocks, by component; `present`: those within the level.
        S low[3][count]{}, high[3][count]{};
        unsigned present = 0;
        for (std::int64_t r = 0; r < rows; ++r) {
            const std::int64_t from = (row + r) * level.pitch + column;
            for (int k = 0; k < 3; ++k) {
                std::copy_n(level.plane[first_position + k].data() + from, columns, low[k] + size * r);
                std::copy_n(level.plane[first_position + 3 + k].data() + from, columns, high[k] + size * r);
            }
            present |= ((1u << columns) - 1u) << (size * r);
        }
        const V far_square = splat<V>(static_cast<S>(far_square_));
        for (std::int64_t i = 0; i < count; ++i) {
            const unsigned partners = present >> i & 1u ? distant_blocks[i] & present : 0u;
            if (!partners) continue;
            // Usually blocks are further apart than any parts can come nearer.
            unsigned near = 0;
            for (std::int64_t k = 0; k < count; k += lanes<S>) {
                V square{};
                for (int c = 0; c < 3; ++c) {
                    const V gap = larger(
                        larger(splat<V>(low[c][i]) - load(high[c] + k), load(low[c] + k) - splat<V>(high[c][i])), V{});
                    square = fma(gap, gap, square);
                }
                near |= bits_of(!(square >= far_square)) << k;
            }
            near &= partners;
            work_left_ -= std::popcount(partners & ~near);
            if (work_left_ < 0) return leave_out(checked_);
            for (; near; near &= near - 1u) {
                const std::int64_t partner = std::countr_zero(near);
                if (!check_blocks(l, row + i / size, column + i % size, row + partner / size, column + partner % size))
                    return false;
            }
        }
        return true;
    }
    bool leave_out(unsigned motions) {
        separated_ &= ~motions;
        checked_ &= ~motions;
        return checked_ != 0;
    }
    bool check_blocks(std::size_t l, std::int64_t r, std::int64_t c, std::int64_t r2, std::int64_t c2) {
        if (--work_left_ < 0) return leave_out(checked_);
        const Level& level = levels_[l];
        const std::int64_t first = r * level.pitch + c, second = r2 * level.pitch + c2;
        const auto square_of = [&](int low, auto&& component) CLOTH_INLINED {
            double square = 0.0;
            for (int k = low; k < low + 3; ++k) {
                const S* const least = level.plane[k].data();
                const S* const most = level.plane[k + 3].data();
                const double difference = component(static_cast<double>(least[first] - most[second]),
                                                    static_cast<double>(least[second] - most[first]));
                square = cloth::fma(difference, difference, square);
            }
            return square;
        };
        const double gap_square =
            square_of(first_position, [](double a, double b) CLOTH_INLINED { return larger(larger(a, b), 0.0); });
        // Usually the blocks are further apart than any parts can come nearer.
        if (gap_square >= far_square_) return true;
        double approach = 0.0;
        for (int k = 0; k < n_motions(); ++k) {
            const double speed =
                root(square_of(first_speed + 6 * k, [](double a, double b) CLOTH_INLINED { return smaller(a, b); }));
            approach = larger(std::fabs(motions_[k].duration) * speed, approach);
        }
        if (root(gap_square) - approach >= needed_) return true;
        if (!l) {
            compared_cells_ = {pairs_.cell(r, c), pairs_.cell(r2, c2)};
            return check_pairs();
        }
        const Level& finer = levels_[l - 1];
        for (std::int64_t i = 2 * r; i < std::min(2 * r + 2, finer.rows); ++i)
            for (std::int64_t j = 2 * c; j < std::min(2 * c + 2, finer.columns); ++j)
                for (std::int64_t i2 = 2 * r2; i2 < std::min(2 * r2 + 2, finer.rows); ++i2)
                    for (std::int64_t j2 = 2 * c2; j2 < std::min(2 * c2 + 2, finer.columns); ++j2)
                        if (!check_blocks(l - 1, i, j, i2, j2)) return false;
        return true;
    }
    /// Check the pairs of two by two cells.
    bool check_cells(std::int64_t r, std::int64_t c) {
        compared_cells_.clear();
        for (std::int64_t i = r; i < std::min(r + 2, rows_ - 1); ++i)
            for (std::int64_t j = c; j < std::min(c + 2, columns_ - 1); ++j)
                compared_cells_.push_back(pairs_.cell(i, j));
        return check_pairs();
    }
    /// Check the pairs of the compared cells.
    bool check_pairs() {
        work_left_ -= cells_work;
        if (work_left_ < 0) return leave_out(checked_);
        return leave_out(pairs_.approaching(compared_cells_, x_, motions_, needed_, checked_));
    }
    std::int64_t rows_ = 0, columns_ = 0, pitch_ = 0;
    double spacing_[2] = {};
    SheetPairs pairs_;
    std::vector<Level> levels_;
    /// Positions or velocities by component, rows padded.
    std::vector<S> component_[3];
    double size_ = 0.0;  ///< largest copied number
    /// Arguments of `separated_motions`, its result so far, the motions that are checked for a window, and whether the
    /// levels have their boxes.
    const double* x_ = nullptr;
    std::span<const SheetMotion> motions_;
    std::vector<S> deviation_;  ///< of a motion, in padded rows
    double needed_ = 0.0;
    unsigned separated_ = 0, checked_ = 0;
    /// Squared distance of blocks [m^2] from which on no motion brings them nearer than needed.
    double far_square_ = 0.0;
    bool has_boxes_ = false;
    std::int64_t work_left_ = 0;
    std::vector<std::int64_t> compared_cells_;
};

}  // namespace cloth::contact
