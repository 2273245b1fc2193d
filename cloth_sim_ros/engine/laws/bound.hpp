// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Conventions of the force laws: each law has force, energy, dissipation and bounds of stiffness and damping, once. V
// is a number, a vector of numbers, or a dual number (core/algebra.hpp) for the derivative product.
//
// A law of `corners` particles gets differences to the first one: d[i] = x[i + 1] - x[0] and u[i] = v[i + 1] - v[0]. It
// returns the forces on corners 1 and up. The force on the first corner is minus their sum, so that every law conserves
// momentum. Air is the exception (`absolute_velocities`): it gets the velocity of each corner and returns the force on
// each.
//
// The bounds `stiff` and `damp` of corner i bound a square of a sum over the corners, by Cauchy and Schwarz (sum of
// a_i)^2 <= (sum of w_j |g_j|) (sum of a_i^2 / (w_i |g_i|)), with weights w of 1 here. `norm` holds the |g_i|, so that
// other weights can be used (plan/spectral_bounds.hpp). `isotropic` is added, times I, whatever the weights. Zero norms
// mean that there is no such square. A law with several squares (`squares`) gives each by `square`.
// Formulas: S1 to S9 of docs/springs.md and docs/bending.md.
#pragma once

#include "core/algebra.hpp"

namespace cloth::laws {

/// Added to squared lengths: a spring between coincident ends has no direction and no force, and no division by zero.
inline constexpr double min_length2 = 1e-30;
/// Limit of the transverse stiffness of a spring relative to its axial stiffness: its value at a tenth of the rest
/// length.
inline constexpr double max_transverse_ratio = 9.0;

/// Bounds of the stiffness and the damping of an element at one of its corners, see above.
template <class V>
struct Bound {
    Sym3<V> stiff, damp;
    V norm, isotropic;
    /// Transverse part of `stiff` of a spring, which is undamped.
    V transverse{};
};

/// Parameters of a law from `numbers` of an element, and from the `common` ones of a list of panels or membranes.
template <class Law, class V>
inline typename Law::template Params<V> law_params(const V* numbers, const double* common) {
    using T = scalar<V>;
    if constexpr (requires { Law::common; })
        return Law::template make_params<V>(numbers, common);
    else if constexpr (Law::params == 3)
        return {numbers[0], numbers[1], numbers[2]};
    else if constexpr (Law::params == 2)
        return {numbers[0], numbers[1]};
    else
        return {splat<V>(T(common[0])), splat<V>(T(common[1])),
                Vec3<V>{splat<V>(T(common[2])), splat<V>(T(common[3])), splat<V>(T(common[4]))}};
}

}  // namespace cloth::laws
