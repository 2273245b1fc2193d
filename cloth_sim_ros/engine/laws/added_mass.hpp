// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Added mass: air that a triangle or a quadrilateral carries along across itself.
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// Kinetic energy T = rho / (2 corners) sum of |A| (n . u_i)^2 of the air at a panel of area |A| and normal n, with the
/// velocities u_i of its corners relative to the air. docs/derivations/added_mass.md derives the equations of motion:
/// each corner has the mass block rho |A| / corners n n', and the velocity-dependent force of `force`.
template <int Corners>
struct AddedMass {
    static constexpr int corners = Corners, params = 0;
    static constexpr bool absolute_velocities = true, carries_mass = true;
    /// Area [m^2] below which a panel has no normal and carries no air.
    static constexpr double min_area = 1e-30;
    /// rho [kg/m^2], an unused number, and the velocity of the air [m/s], common to all panels of a list.
    template <class V>
    struct Params {
        V density, unused;
        Vec3<V> wind;
    };
    /// N = 2 A n as the cross product of two edge vectors or diagonals a and b, its length, and n.
    template <class V>
    struct Normal {
        Vec3<V> a, b, n;
        V length;
    };

    template <class V>
    static CLOTH_INLINE Normal<V> normal(Vec3<V> a, Vec3<V> b) {
        Normal<V> r{a, b, cross(a, b), {}};
        const V square = norm2(r.n);
        const auto has_area = square > splat<V>(scalar<V>(4 * min_area));
        const V length = root(select(has_area, square, splat<V>(1)));
        r.n = select(has_area, splat<V>(1) / length, V{}) * r.n;
        r.length = select(has_area, length, V{});
        return r;
    }
    /// The same of a known N and its length, or 0 without a normal.
    template <class V>
    static CLOTH_INLINE Normal<V> normal(Vec3<V> a, Vec3<V> b, Vec3<V> n, V length) {
        const auto has_area = length > V{};
        const V unit = splat<V>(1) / select(has_area, length, splat<V>(1));
        return {a, b, select(has_area, unit, V{}) * n, length};
    }
    /// rho / (2 corners), so that a corner carries `share` |N|; `corner_share` is 1 / corners, or 0 without a panel.
    template <class V>
    static CLOTH_INLINE V share(const Params<V>& p, V corner_share) {
        return splat<V>(scalar<V>(0.5)) * corner_share * p.density;
    }
    template <class V>
    static CLOTH_INLINE V share(const Params<V>& p) {
        return share(p, splat<V>(scalar<V>(1) / Corners));
    }
    /// Mass block of each corner.
    template <class V>
    static CLOTH_INLINE Sym3<V> block(V share, const Normal<V>& at) {
        return outer(share * at.length, at.n, V{});
    }
    /// Forces on the corners, u their velocities relative to the air: dT/dx minus the change of the momentum at constant
    /// velocities.
    template <class V>
    static CLOTH_INLINE void add(V share, const Normal<V>& at, const Vec3<V>* u, Vec3<V>* f) {
        const Vec3<V> a_rate = Corners == 3 ? u[1] - u[0] : u[2] - u[0],
                      b_rate = Corners == 3 ? u[2] - u[0] : u[3] - u[1];
        const Vec3<V> rate = share * (cross(a_rate, at.b) + cross(at.a, b_rate));
        const V stretch = dot(rate, at.n);
        Vec3<V> gradient{};
        V squares{};
        for (int i = 0; i < Corners; ++i) {
            const V speed = dot(at.n, u[i]);
            gradient = fma(speed, u[i], gradient);
            squares = fma(speed, speed, squares);
            const V turn = fma(-speed, stretch, dot(rate, u[i]));
            f[i] = -fma(speed, rate, turn * at.n);
        }
        gradient = share * fma(splat<V>(scalar<V>(-0.5)) * squares, at.n, gradient);
        const Vec3<V> by_a = cross(at.b, gradient), by_b = cross(gradient, at.a);
        if constexpr (Corners == 3) {
            f[0] = f[0] - (by_a + by_b), f[1] = f[1] + by_a, f[2] = f[2] + by_b;
        } else {
            f[0] = f[0] - by_a, f[2] = f[2] + by_a;
            f[1] = f[1] - by_b, f[3] = f[3] + by_b;
        }
    }
    template <class V>
    static CLOTH_INLINE Normal<V> normal(const Vec3<V>* d) {
        return Corners == 3 ? normal(d[0], d[1]) : normal(d[1], d[Corners - 2] - d[0]);
    }
    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* v, Vec3<V>* f, bool) {
        Vec3<V> u[Corners];
        for (int i = 0; i < Corners; ++i) u[i] = v[i] - p.wind;
        add(share(p), normal(d), u, f);
    }
    /// v'Mv / 2.
    template <class V>
    static CLOTH_INLINE V kinetic_energy(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* v) {
        const Normal<V> at = normal(d);
        V squares{};
        for (int i = 0; i < Corners; ++i) {
            const V speed = dot(at.n, v[i]);
            squares = fma(speed, speed, squares);
        }
        return splat<V>(scalar<V>(0.5)) * share(p) * at.length * squares;
    }
    /// Part -w'Mw / 2 of T - v'p that depends on positions alone. It acts as a potential, and turns a cloth at rest
    /// across the wind w.
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        Vec3<V> wind[Corners];
        for (int i = 0; i < Corners; ++i) wind[i] = p.wind;
        return -kinetic_energy(p, d, wind);
    }
    /// The air dissipates nothing, and a constant wind does no work on it: see the energy.
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>&, const Vec3<V>*, const Vec3<V>*) {
        return V{};
    }
    template <class V>
    static CLOTH_INLINE V external_power(const Params<V>&, const Vec3<V>*, const Vec3<V>*) {
        return V{};
    }
    /// Of a cloth at rest in the wind w: with L the longest distance of two corners, |dN| <= L sum |dx|. The cloth's own
    /// speed is left out, as for `Panel`.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>* d, Bound<V>* b) {
        V longest{};
        for (int i = 0; i < Corners - 1; ++i) {
            longest = larger(longest, norm2(d[i]));
            for (int j = 0; j < i; ++j) longest = larger(longest, norm2(d[i] - d[j]));
        }
        const V square = norm2(p.wind), diameter = root(longest);
        // A panel whose corners coincide has no bound, rather than 0 / 0.
        const V floor = larger(splat<V>(scalar<V>(1e-3)) * longest, splat<V>(scalar<V>(min_area)));
        const V area = larger(normal(d).length, floor);
        const V corner = splat<V>(scalar<V>(1) / Corners) * p.density;
        const V stiff = splat<V>(3) * corner * square * longest / area, damp = corner * root(square) * diameter;
        for (int i = 0; i < Corners; ++i) b[i] = {Sym3<V>{}, Sym3<V>{damp, damp, damp, V{}, V{}, V{}}, V{}, stiff};
    }
};

/// B^-1 a with B = I + K / m of a mass block K: the acceleration of a particle whose other forces give it `a` without
/// air.
template <class V>
CLOTH_INLINE Vec3<V> accelerated(const Sym3<V>& block, V inverse_mass, Vec3<V> a) {
    const V identity = splat<V>(1);
    const V xx = fma(inverse_mass, block.xx, identity), yy = fma(inverse_mass, block.yy, identity),
            zz = fma(inverse_mass, block.zz, identity);
    const V xy = inverse_mass * block.xy, xz = inverse_mass * block.xz, yz = inverse_mass * block.yz;
    // Cofactors of the symmetric matrix.
    const V cxx = fma(yy, zz, -(yz * yz)), cxy = fma(xz, yz, -(xy * zz)), cxz = fma(xy, yz, -(xz * yy));
    const V cyy = fma(xx, zz, -(xz * xz)), cyz = fma(xy, xz, -(xx * yz)), czz = fma(xx, yy, -(xy * xy));
    const V unit = identity / fma(xz, cxz, fma(xy, cxy, xx * cxx));
    return unit *
           Vec3<V>{dot(Vec3<V>{cxx, cxy, cxz}, a), dot(Vec3<V>{cxy, cyy, cyz}, a), dot(Vec3<V>{cxz, cyz, czz}, a)};
}

}  // namespace cloth::laws
