// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What is asked of a sheet's springs beside forces: energy, power, bounds, derivative product. Sums run row by row,
// family by family, column by column, whatever the vectors' width.
#pragma once

#include "grid.hpp"
#include "list_measures.hpp"

namespace cloth {

/// Call `what(family, params, row, numbers)` with a vector of numbers for each column's spring, and add those up with
/// the springs' weights.
template <class F>
inline double grid_sum(const Grid& grid, const Tables<double>& tables, F&& what) {
    using V = vec<double>;
    const std::int64_t length = row_length<double>(grid.columns);
    Array<double> sums(length);
    double total = 0.0;
    for (int f = 0; f < family_count; ++f) {
        const GridFamily& family = grid.families[f];
        if (!family.present) continue;
        const typename Spring::Params<V> params{splat<V>(family.stiffness), splat<V>(family.stiffness / family.rest),
                                                splat<V>(family.damping)};
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            const double* const weight = tables.of(row) + (weights + f) * tables.pitch;
            for (std::int64_t j = 0; j < length; j += lanes<double>)
                store<double>(sums.data() + j, what(f, params, row, j) * load(weight + j));
            for (std::int64_t j = 0; j < grid.columns; ++j) total += sums[j];
        }
    }
    return total;
}

inline Vec3<vec<double>> padded_point(const Padded& p, std::int64_t row, std::int64_t column, int first) {
    return {load(p.at(row, first) + column), load(p.at(row, first + 1) + column), load(p.at(row, first + 2) + column)};
}

inline double grid_energy(const Grid& grid, const Tables<double>& tables, const double* x) {
    const Padded p(grid, x, nullptr);
    return grid_sum(grid, tables, [&](int f, const auto& params, std::int64_t row, std::int64_t j) {
        const Ends e = family_ends[f];
        const auto d = padded_point(p, row + e.row1, j + e.column1, 0) - padded_point(p, row + e.row0, j + e.column0, 0);
        return Spring::energy(params, &d);
    });
}

inline double grid_lost(const Grid& grid, const Tables<double>& tables, const double* x, const double* v) {
    if (!grid.damped()) return 0.0;
    const Padded p(grid, x, v);
    return grid_sum(grid, tables, [&](int f, const auto& params, std::int64_t row, std::int64_t j) {
        const Ends e = family_ends[f];
        const auto d = padded_point(p, row + e.row1, j + e.column1, 0) - padded_point(p, row + e.row0, j + e.column0, 0);
        const auto u = padded_point(p, row + e.row1, j + e.column1, 3) - padded_point(p, row + e.row0, j + e.column0, 3);
        return Spring::lost(params, &d, &u);
    });
}

template <class V>
inline Sym3<V> operator+(const Sym3<V>& a, const Sym3<V>& b) {
    return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
}
template <class V>
inline Sym3<V> scaled(V s, const Sym3<V>& a) {
    return {s * a.xx, s * a.yy, s * a.zz, s * a.xy, s * a.xz, s * a.yz};
}

/// Blocks that bound stiffness and damping of a vector of a row's particles: the sum over the springs at each.
struct GridBounds {
    const Grid& grid;
    const Tables<double>& tables;
    Padded places;
    bool damped;

    GridBounds(const Grid& grid, const Tables<double>& tables, const double* x)
        : grid(grid), tables(tables), places(grid, x, nullptr), damped(grid.damped()) {}

    void of(std::int64_t row, std::int64_t j, Sym3<vec<double>>& stiff, Sym3<vec<double>>& damp) const {
        using V = vec<double>;
        const auto here = padded_point(places, row, j, 0);
        stiff = damp = {};
        for (int f = 0; f < family_count; ++f) {
            const GridFamily& family = grid.families[f];
            if (!family.present) continue;
            const typename Spring::Params<V> params{splat<V>(family.stiffness),
                                                    splat<V>(family.stiffness / family.rest),
                                                    splat<V>(family.damping)};
            const Ends e = family_ends[f];
            const int ends[2][4] = {{e.row0, e.column0, e.row1, e.column1}, {e.row1, e.column1, e.row0, e.column0}};
            for (const auto& [row0, column0, row1, column1] : ends) {
                // The spring is owned by (row - row0, j - column0); its other end lies as far from there as the family's.
                if (row - row0 < 0) continue;
                const V weight = load(tables.of(row - row0) + (weights + f) * tables.pitch + j - column0);
                const auto d = padded_point(places, row + row1 - row0, j + column1 - column0, 0) - here;
                Sym3<V> k[2], c[2];
                Spring::bounds(params, &d, k, c);
                stiff = stiff + scaled(weight, k[0]);
                if (damped) damp = damp + scaled(weight, c[0]);
            }
        }
    }
};

/// Add the blocks of all particles to stiff and damp, each (6, n).
inline void add_grid_bounds(const Grid& grid, const Tables<double>& tables, const double* x, double* stiff,
                            double* damp) {
    const GridBounds bounds(grid, tables, x);
    const std::int64_t n = grid.count();
    for (std::int64_t row = 0; row < grid.rows; ++row)
        for (std::int64_t j = 0; j < grid.columns; j += lanes<double>) {
            Sym3<vec<double>> k, c;
            bounds.of(row, j, k, c);
            for (int lane = 0; lane < lanes<double> && j + lane < grid.columns; ++lane) {
                const std::int64_t i = row * grid.columns + j + lane;
                const auto one = [lane](const Sym3<vec<double>>& b) {
                    return Sym3<double>{b.xx[lane], b.yy[lane], b.zz[lane], b.xy[lane], b.xz[lane], b.yz[lane]};
                };
                if (stiff) add_block(stiff, n, i, one(k));
                if (damp && bounds.damped) add_block(damp, n, i, one(c));
            }
        }
}

/// The largest eigenvalue of a symmetric 3x3 matrix. With mean m and B - m I = p C, C of Frobenius norm sqrt(6), it is
/// m + 2 p cos(acos(h) / 3), h = det(C) / 2 (Smith, Comm. ACM 4(4), 1961). With t = sqrt((1 + h) / 2) that cosine is
/// cos(2 acos(t) / 3), smooth in t: a polynomial of degree 13, never below it, at most 1e-12 above.
template <class V>
inline V largest_eigenvalue(const Sym3<V>& block) {
    constexpr double series[14] = {9.1371974490662e-05, -0.00074459295848305, 0.0028628194514527,  -0.0070378744145726,
                                   0.012798556604318,   -0.01914712152288,    0.025832998977777,   -0.033906752945952,
                                   0.045694566199183,   -0.065838662822131,   0.10691636217626,    -0.22222220890035,
                                   1.1547005381807,     1.000000000001};
    const V third = splat<V>(1.0 / 3.0), sixth = splat<V>(1.0 / 6.0), half = splat<V>(0.5);
    const V mean = (block.xx + block.yy + block.zz) * third;
    V a = block.xx - mean, b = block.yy - mean, c = block.zz - mean;
    V d = block.xy, e = block.xz, f = block.yz;
    const V off = fma(f, f, fma(e, e, d * d));
    const V p = root((fma(c, c, fma(b, b, a * a)) + off + off) * sixth);
    const V scale = splat<V>(1) / (p + fma(splat<V>(1e-15), mean, splat<V>(1e-300)));  // p = 0: a multiple of I
    a = a * scale, b = b * scale, c = c * scale, d = d * scale, e = e * scale, f = f * scale;
    const V h = half * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e));
    const V inside = select(h < splat<V>(-1), splat<V>(-1), select(h > splat<V>(1), splat<V>(1), h));
    const V t = root(fma(half, inside, half));
    V twice = splat<V>(series[0]);
    for (int k = 1; k < 14; ++k) twice = fma(twice, t, splat<V>(series[k]));
    return fma(p, twice, mean);
}

/// Add (df/dx) dx + (df/dv) dv of a sheet's springs to out, all (3, n).
inline void add_grid_product(const Grid& grid, const double* x, const double* v, const double* dx, const double* dv,
                             double* out) {
    const std::int64_t n = grid.count();
    for (int f = 0; f < family_count; ++f) {
        const GridFamily& family = grid.families[f];
        if (!family.present) continue;
        const Ends e = family_ends[f];
        for (std::int64_t row = 0; row < grid.rows; ++row)
            for (std::int64_t column = 0; column < grid.columns; ++column) {
                const double weight = grid.weight(f, row, column);
                if (weight == 0.0) continue;
                const std::int64_t i = (row + e.row0) * grid.columns + column + e.column0;
                const std::int64_t k = (row + e.row1) * grid.columns + column + e.column1;
                const auto way = [=](const double* a) {
                    return Vec3<double>{a[k] - a[i], a[n + k] - a[n + i], a[2 * n + k] - a[2 * n + i]};
                };
                const Vec3<Dual> d = with_slope(way(x), way(dx)), u = with_slope(way(v), way(dv));
                const typename Spring::Params<Dual> params{
                    {weight * family.stiffness, 0.0}, {weight * family.stiffness / family.rest, 0.0},
                    {weight * family.damping, 0.0}};
                Vec3<Dual> g;
                Spring::force(params, &d, &u, &g, true);
                const Vec3<double> s = slope_of(g);
                out[k] += s.x, out[n + k] += s.y, out[2 * n + k] += s.z;
                out[i] -= s.x, out[n + i] -= s.y, out[2 * n + i] -= s.z;
            }
    }
}

}  // namespace cloth
