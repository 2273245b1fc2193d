// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Anchors of friction between layers of the cloth.
#pragma once

#include "contact/surface.hpp"
#include "laws/anchor.hpp"

namespace cloth::contact {

using laws::anchor_numbers, laws::Bond, laws::no_bond, laws::slides, laws::sticks;

/// Faces of a particle: a layer may be in contact with either.
inline constexpr int layer_sides = 2;
/// Numbers of an anchor: its triangle, its weights of the second and third corner, and its bond; anchor_numbers for
/// each face and particle.
struct LayerAnchor {
    Index triangle = -1;
    double second = 0.0, third = 0.0;
    Bond bond = no_bond;
};

/// Anchors of a plan: (layer_sides, anchor_numbers, particles), by the caller's particle numbers.
struct LayerAnchors {
    const double* from;
    const std::int64_t* particle_of_rank;  ///< particle number by rank
    std::int64_t count;

    LayerAnchor operator()(int face, Index i) const {
        const double* const a = from + face * anchor_numbers * count + particle_of_rank[i];
        const Bond bond = a[3 * count] == double(slides) ? slides : a[3 * count] == double(sticks) ? sticks : no_bond;
        return {bond == no_bond ? Index(-1) : static_cast<Index>(a[0]), a[count], a[2 * count], bond};
    }
};
inline void write_anchor(double* to, std::int64_t count, int face, std::int64_t particle, const LayerAnchor& anchor) {
    double* const a = to + face * anchor_numbers * count + particle;
    const bool has_anchor = anchor.bond != no_bond;
    a[0] = has_anchor ? double(anchor.triangle) : 0.0;
    a[count] = has_anchor ? anchor.second : 0.0;
    a[2 * count] = has_anchor ? anchor.third : 0.0;
    a[3 * count] = double(anchor.bond);
}

}  // namespace cloth::contact
