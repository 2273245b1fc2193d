// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Panel: drag of the air on a triangle or a quadrilateral.
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// Drag of air on a panel of three or four corners in order around it. Area vector N = A n: half the cross product of
/// two edges, or of the diagonals. F = -((c_n - c_t) (u . N) N / A + c_t A u) / corners on each corner, u its velocity
/// relative to the air.
template <int Corners>
struct Panel {
    static constexpr int corners = Corners, params = 0;
    static constexpr bool absolute_velocities = true;
    /// Area [m^2] below which a panel has no normal and no force.
    static constexpr double min_area = 1e-30;
    /// c_n and c_t [N s/m^3], and the velocity of the air [m/s], common to all panels of a list.
    template <class V>
    struct Params {
        V normal, tangential;
        Vec3<V> wind;
    };
    /// 2 N, the normal and tangential drag coefficients of a corner, and |2 N|, or 0 without a normal.
    template <class V>
    struct DragShares {
        Vec3<V> n;
        V across, along, length;
    };

    /// Coefficients of a panel with 2 N = a x b; `corner_share` of a corner: 1 / corners, or 0 without a panel.
    template <class V>
    static CLOTH_INLINE DragShares<V> shares(const Params<V>& p, V corner_share, Vec3<V> a, Vec3<V> b) {
        DragShares<V> r;
        r.n = cross(a, b);
        const V square = norm2(r.n);
        const auto has_area = square > splat<V>(scalar<V>(4 * min_area));
        const V twice = root(select(has_area, square, splat<V>(1)));
        const V half = select(has_area, splat<V>(0.5) * corner_share, V{});
        r.across = half * (p.normal - p.tangential) / twice;
        r.along = half * p.tangential * twice;
        r.length = select(has_area, twice, V{});
        return r;
    }
    template <class V>
    static CLOTH_INLINE DragShares<V> shares(const Params<V>& p, const Vec3<V>* d) {
        const V corner_share = splat<V>(scalar<V>(1) / Corners);
        return Corners == 3 ? shares(p, corner_share, d[0], d[1])
                            : shares(p, corner_share, d[1], d[Corners - 2] - d[0]);
    }
    /// Add the drag on a corner to its force, u its velocity relative to the air. Tangential: whether there is drag
    /// along the surface.
    template <bool Tangential = true, class V>
    static CLOTH_INLINE Vec3<V> add(const DragShares<V>& s, Vec3<V> u, Vec3<V> f) {
        const Vec3<V> across = fma(-(s.across * dot(u, s.n)), s.n, f);
        return Tangential ? fma(-s.along, u, across) : across;
    }
    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* v, Vec3<V>* f, bool) {
        const DragShares<V> s = shares(p, d);
        for (int i = 0; i < Corners; ++i) f[i] = add(s, v[i] - p.wind, Vec3<V>{});
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>&, const Vec3<V>*) {
        return V{};
    }
    /// v'Bv: dissipation in still air.
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* v) {
        const DragShares<V> s = shares(p, d);
        V sum{};
        for (int i = 0; i < Corners; ++i) {
            const V through = dot(v[i], s.n);
            sum = sum + (s.across * through * through + s.along * norm2(v[i]));
        }
        return sum;
    }
    /// w'Bv: power of the wind.
    template <class V>
    static CLOTH_INLINE V external_power(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* v) {
        const DragShares<V> s = shares(p, d);
        const V normal_part = s.across * dot(p.wind, s.n);
        V sum{};
        for (int i = 0; i < Corners; ++i) sum = sum + (normal_part * dot(v[i], s.n) + s.along * dot(p.wind, v[i]));
        return sum;
    }
    /// With L the longest distance of two corners |dN| <= L/2 sum |dx|: a cloth at rest in a wind w has at most the
    /// force (2 |c_n - c_t| + c_t) |w| L / (2 corners) sum |dx|.
    template <class V>
    static CLOTH_INLINE V turning(const Params<V>& p, const Vec3<V>* d) {
        V longest{};
        for (int i = 0; i < Corners - 1; ++i) {
            longest = larger(longest, norm2(d[i]));
            for (int j = 0; j < i; ++j) longest = larger(longest, norm2(d[i] - d[j]));
        }
        const V speed = root(norm2(p.wind));
        return splat<V>(0.5) * (splat<V>(2) * absolute(p.normal - p.tangential) + p.tangential) * speed * root(longest);
    }
    /// The damping bound is exact.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>* d, Bound<V>* b) {
        const DragShares<V> s = shares(p, d);
        const V strength = turning(p, d);
        for (int i = 0; i < Corners; ++i) b[i] = {Sym3<V>{}, outer(s.across, s.n, s.along), V{}, strength};
    }
};

}  // namespace cloth::laws
