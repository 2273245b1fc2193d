// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Cholesky factorisation A = U'U of symmetric band matrices of 3x3 blocks, and assembly of pair blocks.
//
// The upper half is stored. Block row I holds its blocks J = I ... I + width in three contiguous rows: entry (3 I + r,
// 3 J + c) is row(I, r)[3 (J - I) + c]. Blocks beyond the last block row are zero, and so are `band_padding` numbers at
// the end of each row, because vectors may read them.
//
// Every entry of the factor is one sum over rows from the top. Each product is rounded once, together with its sum
// (fma). Vectors run across the entries of a row, never along a sum. Therefore neither their width nor the grouping of
// rows changes a bit. The one exception, the products of rows in `backward`, has eight partial sums at any width.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>

#include "core/simd.hpp"

namespace cloth::inline core {

/// Padding at the end of each row: two vectors of eight and two numbers.
inline constexpr std::int64_t band_padding = 18;

/// Numbers in each row of a band with `width` blocks beside the diagonal.
inline constexpr std::int64_t band_stride(std::int64_t width) { return 3 * (width + 1) + band_padding; }

struct Band {
    double* rows;
    std::int64_t count;  ///< block rows
    std::int64_t width;  ///< blocks beside the diagonal

    std::int64_t stride() const { return band_stride(width); }
    double* row(std::int64_t block, int r) const { return rows + (3 * block + r) * stride(); }
};

/// Add a block B (xx, yy, zz, xy, xz, yz) that couples two block rows: B on both diagonals, -B between them. A negative
/// row is fixed. Two rows that are not lie within the band.
inline void add_pair(const Band& a, std::int64_t i, std::int64_t j, const double* block) {
    const double b[3][3] = {
        {block[0], block[3], block[4]}, {block[3], block[1], block[5]}, {block[4], block[5], block[2]}};
    for (const std::int64_t p : {i, j})
        if (p >= 0)
            for (int r = 0; r < 3; ++r)
                for (int c = 0; c < 3; ++c) a.row(p, r)[c] += b[r][c];
    if (i >= 0 && j >= 0)
        for (int r = 0; r < 3; ++r) {
            double* at = a.row(std::min(i, j), r) + 3 * (std::max(i, j) - std::min(i, j));
            for (int c = 0; c < 3; ++c) at[c] -= b[r][c];
        }
}

/// Add a coupling B, by rows: its symmetric part on both diagonals, -B between them. Rows as in `add_pair`. The blocks of
/// all couplings of a particle add up to a symmetric one.
inline void add_coupling(const Band& a, std::int64_t i, std::int64_t j, const double* block) {
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            const double symmetric = 0.5 * (block[3 * r + c] + block[3 * c + r]);
            if (i >= 0) a.row(i, r)[c] += symmetric;
            if (j >= 0) a.row(j, r)[c] += symmetric;
            if (i < 0 || j < 0) continue;
            if (i < j)
                a.row(i, r)[3 * (j - i) + c] -= block[3 * r + c];
            else
                a.row(j, r)[3 * (i - j) + c] -= block[3 * c + r];
        }
}

/// Add a mass and a block (xx, yy, zz, xy, xz, yz; spaced by `component_stride`) to the diagonal of row i.
inline void add_diagonal(const Band& a, std::int64_t i, double mass, const double* block,
                         std::int64_t component_stride) {
    const double xy = block[3 * component_stride], xz = block[4 * component_stride], yz = block[5 * component_stride];
    double *x = a.row(i, 0), *y = a.row(i, 1), *z = a.row(i, 2);
    x[0] += mass + block[0];
    y[1] += mass + block[component_stride];
    z[2] += mass + block[2 * component_stride];
    x[1] += xy;
    y[0] += xy;
    x[2] += xz;
    z[0] += xz;
    y[2] += yz;
    z[1] += yz;
}

/// Set numbers below 1e-120 to zero. If masses dominate the matrix, the entries of the factor decay along a row until
/// they are denormal. Arithmetic on denormal numbers is about a hundred times as slow.
template <class V>
inline V flush_tiny(V a) {
    constexpr double tiny = 1e-120;
    return select(absolute(a) < splat<V>(tiny), V{}, a);
}

/// R rows of the factor at N vectors of columns, held in registers with the sign reversed.
template <int R, int N>
struct Tile {
    using V = vec<double>;
    static constexpr int L = lanes<double>, columns = N * L;
    V sum[R][N];

    /// Add the products with the rows above: three rows of U per block, from `left` for the rows and `right` for the
    /// columns.
    inline void add_products(const double* left, const double* right, std::int64_t blocks, std::int64_t stride) {
        // The columns of a block row begin three numbers later than those of the block row above.
        const std::int64_t next = 3 * stride - 3;
        // Three rows at once would need more registers than exist.
        for (; blocks > 0; --blocks, left += next, right += next)
#pragma GCC unroll 1
            for (int k = 0; k < 3; ++k) {
                V u[N];
#pragma GCC unroll 8
                for (int n = 0; n < N; ++n) u[n] = load(right + k * stride + n * L);
#pragma GCC unroll 8
                for (int r = 0; r < R; ++r) {
                    const V a = splat<V>(left[k * stride + r]);
#pragma GCC unroll 8
                    for (int n = 0; n < N; ++n) sum[r][n] = fma(a, u[n], sum[r][n]);
                }
            }
    }
};

/// Diagonal square of the factor in a tile, its diagonal inverted.
template <int R>
struct Corner {
    double u[R][R];
};

/// Factorise R rows (one or two block rows) from block row `top` on, at the columns of their own blocks. Return false
/// if a row to be eliminated has no positive pivot.
template <int R>
inline bool factor_corner(const Band& a, std::int64_t top, std::int64_t above, bool eliminated, Corner<R>& corner) {
    using V = vec<double>;
    constexpr int L = lanes<double>, N = (R + L - 1) / L, C = N * L;
    const std::int64_t from = std::max<std::int64_t>(0, top - a.width);
    Tile<R, N> tile;
    double b[R][C] = {};
    for (int r = 0; r < R; ++r)
        for (int c = r / 3 * 3; c < C; ++c) b[r][c] = -a.row(top, r)[c - r / 3 * 3];
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < N; ++n) tile.sum[r][n] = load(b[r] + n * L);
    const double* left = a.row(from, 0) + 3 * (top - from);
    tile.add_products(left, left, above - from, a.stride());
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < N; ++n) store(b[r] + n * L, V{} - tile.sum[r][n]);
    if (eliminated)
        for (int q = 0; q < R; ++q) {
            if (!(b[q][q] > 0.0)) return false;
            const double inverse = 1.0 / root(b[q][q]);
            b[q][q] = inverse;
            for (int c = q + 1; c < C; ++c) b[q][c] = flush_tiny(b[q][c] * inverse);
            for (int r = q + 1; r < R; ++r)
                for (int c = r; c < C; ++c) b[r][c] = fma(-b[q][r], b[q][c], b[r][c]);
        }
    for (int r = 0; r < R; ++r)
        for (int c = r / 3 * 3; c < C; ++c) a.row(top, r)[c - r / 3 * 3] = b[r][c];
    for (int r = 0; r < R; ++r)
        for (int c = 0; c < R; ++c) corner.u[r][c] = b[r][c];
    return true;
}

/// Factorise the same rows at the columns from `j` of the matrix on.
template <int R, int N>
inline void factor_columns(const Band& a, std::int64_t top, std::int64_t above, bool eliminated,
                           const Corner<R>& corner, std::int64_t j) {
    using V = vec<double>;
    constexpr int L = lanes<double>;
    const std::int64_t from = std::max<std::int64_t>(0, j / 3 - a.width), stride = a.stride();
    double* rows[2] = {a.row(top, 0) + (j - 3 * top), a.row(top, 0) + 3 * stride - 3 + (j - 3 * top)};
    Tile<R, N> tile;
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) tile.sum[r][n] = -load(rows[r / 3] + r % 3 * stride + n * L);
    const double* first = a.row(from, 0);
    tile.add_products(first + 3 * (top - from), first + (j - 3 * from), above - from, stride);
    // Reverse the sign again: 0 - 0 and 0 + 0 are the same zero, so no sign of a zero depends on the grouping of
    // columns. Multiplied by the inverse diagonal, the results are rows of U, which the next row needs.
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) {
            V x = V{} - tile.sum[r][n];
            if (eliminated) {
                x = flush_tiny(x * splat<V>(corner.u[r][r]));
#pragma GCC unroll 8
                for (int below = r + 1; below < R; ++below)
                    tile.sum[below][n] = fma(splat<V>(corner.u[r][below]), x, tile.sum[below][n]);
            }
            store(rows[r / 3] + r % 3 * stride + n * L, x);
        }
}

/// Factorise R rows from block row `top` on, against the rows above `inner`. Return false if a pivot is not positive.
template <int R>
inline bool factor_rows(const Band& a, std::int64_t top, std::int64_t inner) {
    constexpr int L = lanes<double>, N = 2;
    static_assert(N * L + 2 <= band_padding);
    const std::int64_t above = std::min(top, inner);
    const bool eliminated = top < inner;
    Corner<R> corner;
    if (!factor_corner<R>(a, top, above, eliminated, corner)) return false;
    const std::int64_t end = 3 * std::min(a.count, top + R / 3 + a.width);
    for (std::int64_t j = 3 * top + (R + L - 1) / L * L; j < end; j += N * L)
        factor_columns<R, N>(a, top, above, eliminated, corner, j);
    return true;
}

/// Eliminate the first `inner` block rows of a positive definite matrix. Return false if it is not positive definite.
///
/// The rows are replaced by their rows of U with inverted diagonals, the others by the Schur complement.
inline bool factor(const Band& a, std::int64_t inner) {
    for (const bool eliminated : {true, false}) {
        const std::int64_t end = eliminated ? inner : a.count;
        std::int64_t top = eliminated ? 0 : inner;
        for (; top + 2 <= end; top += 2)
            if (!factor_rows<6>(a, top, inner)) return false;
        if (top < end && !factor_rows<3>(a, top, inner)) return false;
    }
    return true;
}

/// Eliminate the first `inner` unknowns from the right-hand side y (block rows, 3).
inline void forward(const Band& a, std::int64_t inner, double* y) {
    for (std::int64_t i = 0; i < inner; ++i) {
        const double *u0 = a.row(i, 0), *u1 = a.row(i, 1), *u2 = a.row(i, 2);
        double* __restrict y_i = y + 3 * i;
        const double y0 = y_i[0] * u0[0];
        const double y1 = fma(-u0[1], y0, y_i[1]) * u1[1];
        const double y2 = fma(-u1[2], y1, fma(-u0[2], y0, y_i[2])) * u2[2];
        const std::int64_t length = 3 * (1 + std::min(a.width, a.count - 1 - i));
        for (std::int64_t j = 3; j < length; ++j) y_i[j] = fma(-y2, u2[j], fma(-y1, u1[j], fma(-y0, u0[j], y_i[j])));
        y_i[0] = y0;
        y_i[1] = y1;
        y_i[2] = y2;
    }
}

/// Eight partial sums, in one or more vectors. Their order is the same at any width.
struct PartialSums {
    using V = vec<double>;
    static constexpr int L = lanes<double>, vectors = 8 / L;
    static_assert(L * vectors == 8);
    V part[vectors] = {};

    inline void add_product(const double* p, const double* q) {
        for (int n = 0; n < vectors; ++n) part[n] = fma(load(p + n * L), load(q + n * L), part[n]);
    }
    inline void add(const double* p) {
        for (int n = 0; n < vectors; ++n) part[n] += load(p + n * L);
    }
    inline double total() const {
        double s[8];
        for (int n = 0; n < vectors; ++n) store(s + n * L, part[n]);
        return ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]));
    }
};

/// Solve for the first `inner` unknowns of y after `forward`, given the others.
inline void backward(const Band& a, std::int64_t inner, double* y) {
    for (std::int64_t i = inner - 1; i >= 0; --i) {
        const double *u0 = a.row(i, 0), *u1 = a.row(i, 1), *u2 = a.row(i, 2);
        double* y_i = y + 3 * i;
        const std::int64_t length = 3 * (1 + std::min(a.width, a.count - 1 - i));
        PartialSums s0, s1, s2;
        std::int64_t j = 3;
        for (; j + 8 <= length; j += 8) {
            s0.add_product(u0 + j, y_i + j);
            s1.add_product(u1 + j, y_i + j);
            s2.add_product(u2 + j, y_i + j);
        }
        if (j < length) {
            double tail[8] = {};
            std::copy(y_i + j, y_i + length, tail);
            s0.add_product(u0 + j, tail);
            s1.add_product(u1 + j, tail);
            s2.add_product(u2 + j, tail);
        }
        const double x2 = (y_i[2] - s2.total()) * u2[2];
        const double x1 = fma(-u1[2], x2, y_i[1] - s1.total()) * u1[1];
        y_i[0] = fma(-u0[1], x1, fma(-u0[2], x2, y_i[0] - s0.total())) * u0[0];
        y_i[1] = x1;
        y_i[2] = x2;
    }
}

/// Set `middle` to the sum of two Schur complements of the same block rows; those of `lower` are in reverse order.
inline void join(const Band& upper, const Band& lower, std::int64_t inner_upper, std::int64_t inner_lower,
                 const Band& middle) {
    for (std::int64_t i = 0; i < middle.count; ++i)
        for (std::int64_t j = i; j < middle.count; ++j) {
            // In reverse order the pair (i, j) is stored transposed, as (count - 1 - j, count - 1 - i).
            const std::int64_t lower_row = inner_lower + middle.count - 1 - j, at = 3 * (j - i);
            for (int r = 0; r < 3; ++r)
                for (int c = 0; c < 3; ++c)
                    middle.row(i, r)[at + c] = upper.row(inner_upper + i, r)[at + c] + lower.row(lower_row, c)[at + r];
        }
}

/// Sum of numbers in a fixed order.
inline double sum(std::span<const double> values) {
    PartialSums partial;
    for (; values.size() >= 8; values = values.subspan(8)) partial.add(values.data());
    double tail[8] = {};
    std::copy(values.begin(), values.end(), tail);
    partial.add(tail);
    return partial.total();
}

}  // namespace cloth::inline core
