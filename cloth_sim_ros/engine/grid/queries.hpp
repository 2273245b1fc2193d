// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of a sheet's springs: energy, dissipation, derivative product. Sums run row by row, family by family, column
// by column, whatever the vector width.
#pragma once

#include "grid/grid.hpp"
#include "laws/spring.hpp"

namespace cloth::grid {

using laws::Spring;

/// Call evaluate(family, params, row, column) for vectors of springs, and sum the results with the weights of the
/// springs.
template <class F>
inline double grid_sum(const Grid& grid, const GridTables<double>& tables, F&& evaluate) {
    using V = vec<double>;
    const std::int64_t length = row_length<double>(grid.columns);
    Array<double> sums(length);
    double total = 0.0;
    for (int f = 0; f < family_count; ++f) {
        const GridFamily& family = grid.families[f];
        if (!family.present) continue;
        const typename Spring::Params<V> params{
            splat<V>(family.stiffness), splat<V>(family.stiffness / family.rest_length), splat<V>(family.damping)};
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            const double* const weight = tables.of(row) + (weights + f) * tables.pitch;
            for (std::int64_t j = 0; j < length; j += lanes<double>)
                store<double>(sums.data() + j, evaluate(f, params, row, j) * load(weight + j));
            for (std::int64_t j = 0; j < grid.columns; ++j) total += sums[j];
        }
    }
    return total;
}

template <class T>
inline Vec3<vec<T>> padded_point(const PaddedRows<T>& p, std::int64_t row, std::int64_t column, int first) {
    return {load(p.at(row, first) + column), load(p.at(row, first + 1) + column), load(p.at(row, first + 2) + column)};
}

inline double grid_energy(const Grid& grid, const GridTables<double>& tables, const double* x) {
    const PaddedRows<double> p(grid, x, nullptr);
    return grid_sum(grid, tables, [&](int f, const auto& params, std::int64_t row, std::int64_t j) {
        const Ends e = family_ends[f];
        const auto d =
            padded_point(p, row + e.row1, j + e.column1, 0) - padded_point(p, row + e.row0, j + e.column0, 0);
        return Spring::energy(params, &d);
    });
}

inline double grid_dissipation(const Grid& grid, const GridTables<double>& tables, const double* x, const double* v) {
    if (!grid.damped()) return 0.0;
    const PaddedRows<double> p(grid, x, v);
    return grid_sum(grid, tables, [&](int f, const auto& params, std::int64_t row, std::int64_t j) {
        const Ends e = family_ends[f];
        const auto d =
            padded_point(p, row + e.row1, j + e.column1, 0) - padded_point(p, row + e.row0, j + e.column0, 0);
        const auto u =
            padded_point(p, row + e.row1, j + e.column1, 3) - padded_point(p, row + e.row0, j + e.column0, 3);
        return Spring::dissipation(params, &d, &u);
    });
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
                const auto difference = [=](const double* a) {
                    return Vec3<double>{a[k] - a[i], a[n + k] - a[n + i], a[2 * n + k] - a[2 * n + i]};
                };
                const Vec3<Dual> d = with_slope(difference(x), difference(dx)),
                                 u = with_slope(difference(v), difference(dv));
                const typename Spring::Params<Dual> params{{weight * family.stiffness, 0.0},
                                                           {weight * family.stiffness / family.rest_length, 0.0},
                                                           {weight * family.damping, 0.0}};
                Vec3<Dual> g;
                Spring::force(params, &d, &u, &g, true);
                const Vec3<double> s = slope_of(g);
                out[k] += s.x, out[n + k] += s.y, out[2 * n + k] += s.z;
                out[i] -= s.x, out[n + i] -= s.y, out[2 * n + i] -= s.z;
            }
    }
}

}  // namespace cloth::grid
