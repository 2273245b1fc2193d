// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Every force law of the model, once: force, energy, lost power and the bounds of stiffness and damping. V is a number,
// a vector of numbers, or a number with its derivative along a direction (algebra.hpp), for the derivative product.
//
// A law of `corners` particles sees them from the first one: d[i] = x[i + 1] - x[0] and u[i] = v[i + 1] - v[0], and gives
// the forces on corners 1 and up; the first one takes minus their sum, so that no law makes momentum. Air is the
// exception (`absolute_velocities`): it sees the velocity of each corner and gives the force on each.
//
// Of bounds `stiff` and `damp` of corner i bound a square of a sum over the corners, by Cauchy and Schwarz
// (sum of a_i)^2 <= (sum of w_j |g_j|) (sum of a_i^2 / (w_i |g_i|)), with weights w of 1 here; `norm` has the |g_i|, so
// that others can be put in their place (rates.hpp). `rest` is added, times I, whatever the weights. Where norms are 0
// there is no such square.
// Formulas: S1 to S9 of docs/springs.md and docs/bending.md.
#pragma once

#include "core/algebra.hpp"

namespace cloth {

/// Added to squared lengths: a spring between coincident ends has no direction and no force, and divides by no zero.
inline constexpr double min_length2 = 1e-30;
/// Largest stiffness across a spring relative to that along it that counts: that of a tenth of the rest length.
inline constexpr double max_transverse_ratio = 9.0;

/// What bounds the stiffness and the damping of an element at one of its corners, see above.
template <class V>
struct Bound {
    Sym3<V> stiff, damp;
    V norm, isotropic;
    /// The part of `stiff` across a spring, which nothing damps.
    V transverse{};
};

}  // namespace cloth
