// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Quadratic hinge: bending energy of a hinge that is flat at rest, quadratic in positions.
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// Energy k |L|^2 / 2 with L = sum of w_i x_i, weights w_i with which L vanishes at rest and |L| is the fold angle near
/// it (Bergou, Wardetzky, Harmon, Zorin and Grinspun, Symp. Geometry Processing 2006). Damping has the energy's matrix
/// times a time. Corners 0 and 1 are the edge, 2 and 3 the wings. docs/derivations/quadratic_bending.md derives it.
struct QuadraticHinge {
    static constexpr int corners = 4, params = 4;
    static constexpr bool absolute_velocities = false;
    /// Numbers that all hinges of a list have in common.
    static constexpr int common = 1;
    /// Weights of corners 1 to 3 [1/m], k [N m], and the damping time [s].
    template <class V>
    struct Params {
        V weight[3], k, time;
    };
    template <class V>
    static CLOTH_INLINE Params<V> make_params(const V* n, const double* c) {
        return {{n[0], n[1], n[2]}, n[3], splat<V>(scalar<V>(c[0]))};
    }
    template <class V>
    static CLOTH_INLINE Vec3<V> sum(const Params<V>& p, const Vec3<V>* d) {
        return fma(p.weight[0], d[0], fma(p.weight[1], d[1], p.weight[2] * d[2]));
    }
    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, Vec3<V>* f, bool damped) {
        Vec3<V> fold = sum(p, d);
        if (damped) fold = fma(p.time, sum(p, u), fold);
        for (int i = 0; i < 3; ++i) f[i] = -(p.k * p.weight[i]) * fold;
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        return splat<V>(0.5) * p.k * norm2(sum(p, d));
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>*, const Vec3<V>* u) {
        return p.k * p.time * norm2(sum(p, u));
    }
    /// |sum of w_i u_i|^2 <= (sum of |w_i|) (sum of |w_i| |u_i|^2), at all positions.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>*, Bound<V>* b) {
        b[0].norm = absolute(p.weight[0] + p.weight[1] + p.weight[2]);
        V total = b[0].norm;
        for (int i = 1; i < 4; ++i) {
            b[i].norm = absolute(p.weight[i - 1]);
            total = total + b[i].norm;
        }
        for (int i = 0; i < 4; ++i) {
            const V stiff = p.k * total * b[i].norm, damp = p.time * stiff;
            b[i].stiff = {stiff, stiff, stiff, V{}, V{}, V{}};
            b[i].damp = {damp, damp, damp, V{}, V{}, V{}};
            b[i].isotropic = V{};
            b[i].transverse = stiff;
        }
    }
};

}  // namespace cloth::laws
