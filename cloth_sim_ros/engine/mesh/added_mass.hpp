// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Mass blocks of the air at listed panels, added one panel after the other, so that sums have one order whatever the
// vector width.
#pragma once

#include "laws/added_mass.hpp"
#include "mesh/elements.hpp"

namespace cloth::mesh {

using laws::AddedMass, laws::law_params;

/// Add the blocks of all panels of a list to two quads a particle: xx, yy, zz, 0 and xy, xz, yz, 0.
template <int C, class T>
inline void add_mass_blocks(const Elements<T>& list, const double* common, const T* x, T* blocks) {
    using V = vec<T>;
    constexpr int L = lanes<T>;
    const auto air = law_params<AddedMass<C>, V>(nullptr, common);
    const V share = AddedMass<C>::share(air);
    for (std::int64_t e = 0; e < list.count; e += L) {
        const auto difference = [&](int from, int to) CLOTH_INLINED {
            quad<T> rows[L];
            for (int k = 0; k < L; ++k)
                rows[k] =
                    load4(x + std::size_t{list.corner[to][e + k]}) - load4(x + std::size_t{list.corner[from][e + k]});
            Vec3<V> r;
            deinterleave(rows, r.x, r.y, r.z);
            return r;
        };
        const Sym3<V> b =
            AddedMass<C>::block(share, AddedMass<C>::normal(difference(0, C == 3 ? 1 : 2), difference(C - 3, C - 1)));
        quad<T> diagonal[L], off_diagonal[L];
        interleave(b.xx, b.yy, b.zz, diagonal);
        interleave(b.xy, b.xz, b.yz, off_diagonal);
        for (int k = 0; k < L; ++k)
            for (int c = 0; c < C; ++c) {
                T* const to = blocks + 2 * std::size_t{list.corner[c][e + k]};
                store4(to, quad<T>(load4(to) + diagonal[k]));
                store4(to + 4, quad<T>(load4(to + 4) + off_diagonal[k]));
            }
    }
}

/// Mass block of a particle in two quads.
template <class T>
CLOTH_INLINE Sym3<T> mass_block(const T* from) {
    return {from[0], from[1], from[2], from[4], from[5], from[6]};
}

}  // namespace cloth::mesh
