// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Stiffness and damping bounds of a sheet's springs and of the drag on its cells, summed for each particle. Each spring
// is evaluated once, by its own row; particles gather from the last three rows.
#pragma once

#include "grid/cells.hpp"
#include "grid/queries.hpp"
#include "laws/panel.hpp"

namespace cloth::grid {

using laws::law_params, laws::Panel;

template <class T>
class GridBounds {
public:
    /// In single precision blocks are in units of the largest k_s / l0 and c, so that no square overflows. `air`:
    /// common coefficients of the panels of `cells`, or null.
    GridBounds(const Grid& grid, const GridTables<T>& tables, const double* x, const CellTable<T>* cells = nullptr,
               const double* air = nullptr)
        : damped(air || grid.damped()), grid_(grid), tables_(tables), table_(cells), air_(air),
          positions_(grid, x, nullptr), length_(row_length<T>(grid.columns)), table_pitch_(tables.pitch),
          pitch_(length_ + row_reach <= tables.pitch ? tables.pitch : tables.pitch + margin) {
        for (const GridFamily& family : grid.families) {
            if (sizeof(T) == 8 || !family.present) continue;
            unit_stiffness = std::max(unit_stiffness, family.stiffness / family.rest_length);
            unit_damping = std::max(unit_damping, family.damping);
        }
        if (sizeof(T) == 8 || unit_stiffness == 0.0) unit_stiffness = 1.0;
        if (sizeof(T) == 8 || unit_damping == 0.0) unit_damping = 1.0;
        numbers_.assign((3 * family_count + (air ? 2 : 0)) * parts * pitch_ + 2 * margin, T(0));
    }

    /// Process a row. Rows have to be processed in order from the first.
    void process_row(std::int64_t row) {
        using V = vec<T>;
        for (int f = 0; f < family_count; ++f) {
            const GridFamily& family = grid_.families[f];
            if (!family.present) continue;
            const typename Spring::Params<V> params{splat<V>(T(family.stiffness / unit_stiffness)),
                                                    splat<V>(T(family.stiffness / family.rest_length / unit_stiffness)),
                                                    splat<V>(T(family.damping / unit_damping))};
            const Ends e = family_ends[f];
            const T* const weight = tables_.of(row) + (weights + f) * table_pitch_;
            T* const to = numbers(row, f);
            for (std::int64_t j = 0; j < length_; j += lanes<T>) {
                const auto d = padded_point(positions_, row + e.row1, j + e.column1, 0) -
                               padded_point(positions_, row + e.row0, j + e.column0, 0);
                const auto at = Spring::axis(params, d);
                const V w = load(weight + j);
                store<T>(to + j, at.unit.x);
                store<T>(to + pitch_ + j, at.unit.y);
                store<T>(to + 2 * pitch_ + j, at.unit.z);
                store<T>(to + 3 * pitch_ + j, w * at.axial);
                store<T>(to + 4 * pitch_ + j, w * at.transverse);
                store<T>(to + 5 * pitch_ + j, w * at.damping);
            }
        }
        if (air_) process_cells(row);
    }
    /// Blocks of a vector of particles of the last processed row.
    void of(std::int64_t row, std::int64_t j, Sym3<vec<T>>& stiff, Sym3<vec<T>>& damp) const {
        stiff = damp = Sym3<vec<T>>{};
        for (int f = 0; f < family_count; ++f) {
            if (!grid_.families[f].present) continue;
            const Ends e = family_ends[f];
            add(row - e.row0, f, j - e.column0, stiff, damp);
            add(row - e.row1, f, j - e.column1, stiff, damp);
        }
        for (std::int64_t up = std::max<std::int64_t>(row - 1, 0); air_ && up <= row; ++up)
            for (const std::int64_t left : {j - 1, j}) add_cell(cells(up) + left, stiff, damp);
    }

    /// Transverse part of their stiffness.
    vec<T> transverse(std::int64_t row, std::int64_t j) const {
        vec<T> sum{};
        for (int f = 0; f < family_count; ++f) {
            if (!grid_.families[f].present) continue;
            const Ends e = family_ends[f];
            for (const auto& [up, left] : {std::pair{e.row0, e.column0}, std::pair{e.row1, e.column1}})
                if (row >= up) sum = sum + load(numbers(row - up, f) + 4 * pitch_ + j - left);
        }
        return sum;
    }

    const PaddedRows<T>& positions() const { return positions_; }

    const bool damped;
    double unit_stiffness = 0.0, unit_damping = 0.0;

private:
    /// Unit vector, axial, transverse and damping part of each spring. The margin covers columns left of the first, and
    /// separates the parts by zeros, whatever springs of zero weight lie beyond the last column.
    static constexpr std::int64_t parts = 6, margin = 16;

    T* numbers(std::int64_t row, int f) {
        return numbers_.data() + margin + (row % 3 * family_count + f) * parts * pitch_;
    }
    const T* numbers(std::int64_t row, int f) const { return const_cast<GridBounds*>(this)->numbers(row, f); }

    /// Area vectors, normal and tangential coefficients, and turning stiffness of the cells below a row.
    T* cells(std::int64_t row) { return numbers(0, 0) + (3 * family_count + row % 2) * parts * pitch_; }
    const T* cells(std::int64_t row) const { return const_cast<GridBounds*>(this)->cells(row); }
    void process_cells(std::int64_t row) {
        using V = vec<T>;
        double damped_by[5], turned_by[5];
        for (int k = 0; k < 5; ++k) {
            damped_by[k] = air_[k] / (k < 2 ? unit_damping : 1.0);
            turned_by[k] = air_[k] / (k < 2 ? unit_stiffness : 1.0);
        }
        const auto damping = law_params<Panel<4>, V>(nullptr, damped_by);
        const auto turning = law_params<Panel<4>, V>(nullptr, turned_by);
        for (std::int64_t j = 0; j < length_; j += lanes<T>) {
            const auto point = [&](int down, int right) { return padded_point(positions_, row + down, j + right, 0); };
            const Vec3<V> first = point(0, 0), d[3] = {point(0, 1) - first, point(1, 1) - first, point(1, 0) - first};
            const V share = load(table_->of(row) + j);
            const auto s = Panel<4>::shares(damping, share, d[1], d[2] - d[0]);
            T* const to = cells(row) + j;
            store<T>(to, s.n.x), store<T>(to + pitch_, s.n.y), store<T>(to + 2 * pitch_, s.n.z);
            store<T>(to + 3 * pitch_, s.across), store<T>(to + 4 * pitch_, s.along);
            store<T>(to + 5 * pitch_, select(share > V{}, Panel<4>::turning(turning, d), V{}));
        }
    }
    void add_cell(const T* from, Sym3<vec<T>>& stiff, Sym3<vec<T>>& damp) const {
        const Vec3<vec<T>> n{load(from), load(from + pitch_), load(from + 2 * pitch_)};
        const Sym3<vec<T>> block = outer(load(from + 3 * pitch_), n, load(from + 4 * pitch_));
        const vec<T> turning = load(from + 5 * pitch_);
        damp.xx = damp.xx + block.xx, damp.yy = damp.yy + block.yy, damp.zz = damp.zz + block.zz;
        damp.xy = damp.xy + block.xy, damp.xz = damp.xz + block.xz, damp.yz = damp.yz + block.yz;
        stiff.xx = stiff.xx + turning, stiff.yy = stiff.yy + turning, stiff.zz = stiff.zz + turning;
    }

    void add(std::int64_t row, int f, std::int64_t j, Sym3<vec<T>>& stiff, Sym3<vec<T>>& damp) const {
        using V = vec<T>;
        if (row < 0) return;
        const T* const from = numbers(row, f) + j;
        const V x = load(from), y = load(from + pitch_), z = load(from + 2 * pitch_);
        const V along = load(from + 3 * pitch_), across = load(from + 4 * pitch_);
        const V xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
        stiff.xx = fma(along, xx, stiff.xx) + across;
        stiff.yy = fma(along, yy, stiff.yy) + across;
        stiff.zz = fma(along, zz, stiff.zz) + across;
        stiff.xy = fma(along, xy, stiff.xy);
        stiff.xz = fma(along, xz, stiff.xz);
        stiff.yz = fma(along, yz, stiff.yz);
        if (!damped) return;
        const V damping = load(from + 5 * pitch_);
        damp.xx = fma(damping, xx, damp.xx);
        damp.yy = fma(damping, yy, damp.yy);
        damp.zz = fma(damping, zz, damp.zz);
        damp.xy = fma(damping, xy, damp.xy);
        damp.xz = fma(damping, xz, damp.xz);
        damp.yz = fma(damping, yz, damp.yz);
    }

    const Grid& grid_;
    const GridTables<T>& tables_;
    const CellTable<T>* const table_;
    const double* const air_;
    const PaddedRows<T> positions_;
    std::int64_t length_, table_pitch_, pitch_;
    Array<T> numbers_;
};

/// Add a vector of numbers to those from `to` on, of which `left` remain.
CLOTH_INLINE void add_numbers(double* to, vec<double> numbers, std::int64_t left) {
    if (left >= lanes<double>)
        store(to, load(to) + numbers);
    else
        for (std::int64_t k = 0; k < left; ++k) to[k] += numbers[k];
}

/// Add the blocks of all particles to stiff and damp, each (6, n), and the transverse part to `transverse` (n) or null.
inline void add_grid_bounds(const Grid& grid, const GridTables<double>& tables, const double* x, double* stiff,
                            double* damp, double* transverse = nullptr) {
    GridBounds<double> bounds(grid, tables, x);
    const std::int64_t n = grid.count();
    for (std::int64_t row = 0; row < grid.rows; ++row) {
        bounds.process_row(row);
        for (std::int64_t j = 0; j < grid.columns; j += lanes<double>) {
            Sym3<vec<double>> k, c;
            bounds.of(row, j, k, c);
            const std::int64_t i = row * grid.columns + j, left = grid.columns - j;
            const auto add = [&](double* to, const Sym3<vec<double>>& b) {
                add_numbers(to + i, b.xx, left), add_numbers(to + n + i, b.yy, left);
                add_numbers(to + 2 * n + i, b.zz, left), add_numbers(to + 3 * n + i, b.xy, left);
                add_numbers(to + 4 * n + i, b.xz, left), add_numbers(to + 5 * n + i, b.yz, left);
            };
            if (stiff) add(stiff, k);
            if (damp && bounds.damped) add(damp, c);
            if (transverse) add_numbers(transverse + i, bounds.transverse(row, j), left);
        }
    }
}

/// Largest eigenvalue of a symmetric 3x3 matrix. With mean m and B - m I = p C, C of Frobenius norm sqrt(6), it is m +
/// 2 p cos(acos(h) / 3), h = det(C) / 2 (Smith, Comm. ACM 4(4), 1961). With t = sqrt((1 + h) / 2) that cosine is cos(2
/// acos(t) / 3), smooth in t: approximated by a polynomial of degree 13, never below, at most 1e-12 above.
template <class V>
inline V largest_eigenvalue(const Sym3<V>& block) {
    using T = scalar<V>;
    constexpr double series[14] = {9.1371974490662e-05, -0.00074459295848305, 0.0028628194514527, -0.0070378744145726,
                                   0.012798556604318,   -0.01914712152288,    0.025832998977777,  -0.033906752945952,
                                   0.045694566199183,   -0.065838662822131,   0.10691636217626,   -0.22222220890035,
                                   1.1547005381807,     1.000000000001};
    const V third = splat<V>(T(1.0 / 3.0)), sixth = splat<V>(T(1.0 / 6.0)), half = splat<V>(T(0.5));
    const V mean = (block.xx + block.yy + block.zz) * third;
    V a = block.xx - mean, b = block.yy - mean, c = block.zz - mean;
    V d = block.xy, e = block.xz, f = block.yz;
    const V off = fma(f, f, fma(e, e, d * d));
    const V p = root((fma(c, c, fma(b, b, a * a)) + off + off) * sixth);
    const V scale = splat<V>(1) / (p + fma(splat<V>(sizeof(T) == 8 ? T(1e-15) : T(1e-6)), mean,
                                           splat<V>(sizeof(T) == 8 ? T(1e-300) : T(1e-30))));  // p = 0: a multiple of I
    a = a * scale, b = b * scale, c = c * scale, d = d * scale, e = e * scale, f = f * scale;
    const V h = half * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e));
    const V clamped_h = select(h < splat<V>(-1), splat<V>(-1), select(h > splat<V>(1), splat<V>(1), h));
    const V t = root(fma(half, clamped_h, half));
    V cosine = splat<V>(T(series[0]));
    for (int k = 1; k < 14; ++k) cosine = fma(cosine, t, splat<V>(T(series[k])));
    return fma(p, cosine, mean);
}

}  // namespace cloth::grid
