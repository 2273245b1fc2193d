// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Coupling: one pair of particles of an energy that is quadratic in positions.
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// A joint whose k may be negative: F = -k (s + time ds/dt) on the far end, s its position relative to the near end.
/// Only the sum over all couplings of a list is an energy of at least 0. docs/derivations/shape_operator.md derives k.
struct Coupling {
    static constexpr int corners = 2, params = 1;
    static constexpr bool absolute_velocities = false;
    /// Numbers that all couplings of a list have in common.
    static constexpr int common = 1;
    /// k [N/m] and the damping time [s].
    template <class V>
    struct Params {
        V k, time;
    };
    template <class V>
    static CLOTH_INLINE Params<V> make_params(const V* n, const double* c) {
        return {n[0], splat<V>(scalar<V>(c[0]))};
    }
    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, Vec3<V>* f, bool damped) {
        f[0] = -(p.k * (damped ? fma(p.time, u[0], d[0]) : d[0]));
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        return splat<V>(0.5) * p.k * norm2(d[0]);
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>*, const Vec3<V>* u) {
        return p.k * p.time * norm2(u[0]);
    }
    /// A negative k adds nothing: k |a - b|^2 <= 0.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>*, Bound<V>* b) {
        const V stiff = splat<V>(2) * select(p.k > V{}, p.k, V{}), damp = p.time * stiff;
        b[0] = b[1] = {outer(V{}, Vec3<V>{}, stiff), outer(V{}, Vec3<V>{}, damp), splat<V>(1), V{}, stiff};
    }
};

}  // namespace cloth::laws
