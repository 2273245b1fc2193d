// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Coefficients of friction, and the state of a contact with an anchor spring.
#pragma once

namespace cloth::laws {

/// Friction coefficients of a pair of surfaces, at rest and in motion.
struct FrictionCoefficients {
    double at_rest = 0.0, sliding = 0.0;
};
/// State of a contact: none, sticking or sliding.
enum Bond : int { no_bond = 0, sticks = 1, slides = 2 };
/// Numbers of an anchor: its position in the obstacle's frame [m] and its bond.
inline constexpr int anchor_numbers = 4;

}  // namespace cloth::laws
