// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Choice of the row loop of a sheet by its families of springs and its dependence on velocities.
#pragma once

#include "grid/row.hpp"
#include "plan/plan.hpp"

namespace cloth::grid {

using plan::Plan;

template <class T>
using StepRow = void (*)(const RowView<T>&, const GridConstants<T>&, const StepFactors<T>&, bool);

template <class T, Mode M, bool Air>
inline StepRow<T> select_row_step(unsigned shape) {
    constexpr unsigned edges = 1u << right | 1u << down, with_diagonal = 1u << diagonal,
                       with_antidiagonal = 1u << antidiagonal;
    constexpr unsigned long_springs = 1u << right2 | 1u << down2;
    switch (shape & ~edges) {
        case 0: return step_row<T, edges, M, Air>;
        case with_diagonal: return step_row<T, edges | with_diagonal, M, Air>;
        case with_antidiagonal: return step_row<T, edges | with_antidiagonal, M, Air>;
        case with_diagonal | with_antidiagonal: return step_row<T, edges | with_diagonal | with_antidiagonal, M, Air>;
        case long_springs: return step_row<T, edges | long_springs, M, Air>;
        case long_springs | with_diagonal: return step_row<T, edges | long_springs | with_diagonal, M, Air>;
        case long_springs | with_antidiagonal: return step_row<T, edges | long_springs | with_antidiagonal, M, Air>;
        default: return step_row<T, edges | long_springs | with_diagonal | with_antidiagonal, M, Air>;
    }
}
/// `air`: whether the sheet carries air along. Its forces depend on velocities.
template <class T>
inline StepRow<T> select_row_step(unsigned shape, Mode mode, bool air) {
    switch (mode) {
        case Mode::position_only: return select_row_step<T, Mode::position_only, false>(shape);
        case Mode::drag:
            return air ? select_row_step<T, Mode::drag, true>(shape) : select_row_step<T, Mode::drag, false>(shape);
        default:
            return air ? select_row_step<T, Mode::damped, true>(shape) : select_row_step<T, Mode::damped, false>(shape);
    }
}

/// Constants of the row loop.
template <class T>
inline GridConstants<T> grid_constants(const Plan& plan) {
    GridConstants<T> c{};
    for (int f = 0; f < family_count; ++f) {
        const GridFamily& family = plan.grid->families[f];
        if (!family.present) continue;
        c.families[f] = {T(family.stiffness), T(family.stiffness / family.rest_length), T(family.damping)};
    }
    c.drag = T(plan.drag);
    for (int k = 0; k < 3; ++k) c.body_acceleration[k] = T(plan.body_acceleration(k));
    return c;
}

}  // namespace cloth::grid
