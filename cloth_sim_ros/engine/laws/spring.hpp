// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Damped spring (S1).
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// S1, a damped spring of rest length l0 > 0: F = -k (|d| - l0) d^ - c (u . d^) d^ on the far end, k = k_s / l0.
struct Spring {
    static constexpr int corners = 2, params = 3;
    static constexpr bool absolute_velocities = false;
    /// Its force is parallel to d, see `factor`.
    static constexpr bool central = true;
    /// k_s [N], k [N/m], c [N s/m].
    template <class V>
    struct Params {
        V ks, k, c;
    };

    /// q in F = -q d on the far end.
    template <class V>
    static CLOTH_INLINE V factor(const Params<V>& p, Vec3<V> d, Vec3<V> u, bool damped) {
        const V inverse = inverse_root(norm2_plus(d, scalar<V>(min_length2)));
        V slope = -p.ks;
        if (damped) slope = fma(p.c * dot(u, d), inverse, slope);
        return fma(slope, inverse, p.k);
    }
    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, Vec3<V>* f, bool damped) {
        f[0] = -factor(p, d[0], u[0], damped) * d[0];
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        // k (|d| - l0)^2 / 2 with l0 = k_s / k.
        const V stretch = fma(p.k, root(norm2(d[0])), -p.ks);
        return select(p.k > V{}, splat<V>(0.5) * stretch * stretch / p.k, V{});
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u) {
        const V rate = dot(u[0], d[0]);
        return p.c * rate * rate / norm2_plus(d[0], scalar<V>(min_length2));
    }
    /// Twice k dd' + |k - k_s / |d|| (I - dd') at both ends. The transverse part of compression is negative and
    /// destabilises nothing. But a nearly collapsed spring rotates as fast as a stretched one, so its absolute value
    /// counts.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>* d, Bound<V>* b) {
        const Axis<V> at = axis(p, d[0]);
        b[0] = b[1] = {outer(at.axial, at.unit, at.transverse), outer(at.damping, at.unit, V{}), splat<V>(1), V{},
                       at.transverse};
    }
    /// The same as numbers: axial dd' + transverse I, and damping dd'.
    template <class V>
    struct Axis {
        Vec3<V> unit;
        V axial, transverse, damping;
    };
    template <class V>
    static CLOTH_INLINE Axis<V> axis(const Params<V>& p, Vec3<V> d) {
        const V inverse = inverse_root(norm2_plus(d, scalar<V>(min_length2)));
        const V two = splat<V>(2), axial = two * p.k;
        const V transverse =
            smaller(absolute(fma(-two * p.ks, inverse, axial)), splat<V>(max_transverse_ratio) * axial);
        return {inverse * d, axial - transverse, transverse, two * p.c};
    }
    /// Contribution to the matrix of an implicit step: `stiffness` (k dd' + transverse part of tension) + `damping` c
    /// dd'. The transverse stiffness of compression is negative and omitted.
    template <class V>
    static CLOTH_INLINE Sym3<V> matrix(const Params<V>& p, const Vec3<V>* d, V stiffness, V damping) {
        const V inverse = inverse_root(norm2_plus(d[0], scalar<V>(min_length2)));
        // Between coincident ends the direction of the spring is arbitrary.
        const V tension = select(norm2(d[0]) > V{}, larger(fma(-p.ks, inverse, p.k), V{}), p.k);
        const V transverse = stiffness * tension;
        return outer(stiffness * p.k + damping * p.c - transverse, inverse * d[0], transverse);
    }
};

}  // namespace cloth::laws
