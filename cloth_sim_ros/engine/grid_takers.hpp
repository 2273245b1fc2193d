// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// The loop over a row that a sheet takes: which families of springs it has, and whether anything depends on velocities.
#pragma once

#include "plan.hpp"

namespace cloth {

template <class T>
using TakeRow = void (*)(const RowPlace<T>&, const GridConstants<T>&, const Motion<T>&, bool);

template <class T, Mode M>
inline TakeRow<T> row_taker(unsigned shape) {
    constexpr unsigned edges = 1u << right | 1u << down, left = 1u << diagonal, other = 1u << antidiagonal;
    constexpr unsigned bends = 1u << right2 | 1u << down2;
    switch (shape & ~edges) {
        case 0: return take_row<T, edges, M>;
        case left: return take_row<T, edges | left, M>;
        case other: return take_row<T, edges | other, M>;
        case left | other: return take_row<T, edges | left | other, M>;
        case bends: return take_row<T, edges | bends, M>;
        case bends | left: return take_row<T, edges | bends | left, M>;
        case bends | other: return take_row<T, edges | bends | other, M>;
        default: return take_row<T, edges | bends | left | other, M>;
    }
}
template <class T>
inline TakeRow<T> row_taker(unsigned shape, Mode mode) {
    switch (mode) {
        case Mode::still: return row_taker<T, Mode::still>(shape);
        case Mode::drag: return row_taker<T, Mode::drag>(shape);
        default: return row_taker<T, Mode::damped>(shape);
    }
}

/// What the loop needs of a plan.
template <class T>
inline GridConstants<T> grid_constants(const Plan& plan) {
    GridConstants<T> c{};
    for (int f = 0; f < family_count; ++f) {
        const GridFamily& family = plan.grid->families[f];
        if (!family.present) continue;
        c.families[f] = {T(family.stiffness), T(family.stiffness / family.rest), T(family.damping)};
    }
    c.drag = T(plan.drag);
    for (int k = 0; k < 3; ++k) c.push[k] = T(plan.push(k));
    return c;
}

}  // namespace cloth
