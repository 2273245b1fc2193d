// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Hinge: a spring on the signed length of two triangles with a common edge (S8, S9).
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// S8 and S9: a spring on the signed length h = 6V / M of the tetrahedron of two triangles with a common edge. Corners
/// 0 and 1 are the edge, 2 and 3 the wings; 6V = d0 . (d1 x d2), positive if the wings rise to the side of the normal.
/// M^2 is a sum of squared areas, G = grad(M^2) / 2, and grad h = grad(6V) / M - h G / M^2. Energy k (h - h0)^2 / 2,
/// damping force -c (grad h . v) grad h.
template <class Areas>
struct Hinge {
    static constexpr int corners = 4, params = 3;
    static constexpr bool absolute_velocities = false;
    /// h0 [m], k [N/m], c [N s/m].
    template <class V>
    struct Params {
        V rest_length, k, c;
    };
    template <class V>
    struct Length {
        V h, square;
        /// Gradients of h (zero if h is undefined), and G, with respect to corners 1, 2, 3.
        Vec3<V> gradient[3], area[3];
    };

    template <class V>
    static CLOTH_INLINE void areas(const Vec3<V>* d, V& square, V& limit, Vec3<V>* area) {
        Areas::of(d, square, limit, area);
    }
    template <class V>
    static CLOTH_INLINE Length<V> length(const Vec3<V>* d) {
        Length<V> r;
        V limit;
        Areas::of(d, r.square, limit, r.area);
        const auto defined = r.square > limit;
        r.square = select(defined, r.square, splat<V>(1));
        const V inverse = select(defined, inverse_root(r.square), V{});
        const Vec3<V> volume[3] = {cross(d[1], d[2]), cross(d[2], d[0]), cross(d[0], d[1])};
        r.h = dot(d[0], volume[0]) * inverse;
        const V turn = -(r.h * inverse) * inverse;
        for (int i = 0; i < 3; ++i) r.gradient[i] = fma(turn, r.area[i], inverse * volume[i]);
        return r;
    }
    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, Vec3<V>* f, bool damped) {
        const Length<V> l = length(d);
        V tension = p.k * (p.rest_length - l.h);
        if (damped) {
            const V rate = dot(l.gradient[0], u[0]) + dot(l.gradient[1], u[1]) + dot(l.gradient[2], u[2]);
            tension = fma(-p.c, rate, tension);
        }
        for (int i = 0; i < 3; ++i) f[i] = tension * l.gradient[i];
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        V square, limit;
        Vec3<V> area[3];
        Areas::of(d, square, limit, area);
        const auto defined = square > limit;
        const V h = dot(d[0], cross(d[1], d[2])) * inverse_root(select(defined, square, splat<V>(1)));
        const V deviation = h - p.rest_length;
        return select(defined, splat<V>(0.5) * p.k * deviation * deviation, V{});
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u) {
        const Length<V> l = length(d);
        const V rate = dot(l.gradient[0], u[0]) + dot(l.gradient[1], u[1]) + dot(l.gradient[2], u[2]);
        return p.c * rate * rate;
    }
    /// Bound of (grad h . u)^2 by Cauchy and Schwarz; of the curvature k (h - h0) h'' by the bound of h'' in Areas.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>* d, Bound<V>* b) {
        const Length<V> l = length(d);
        const Vec3<V> g[4] = {-(l.gradient[0] + l.gradient[1] + l.gradient[2]), l.gradient[0], l.gradient[1],
                              l.gradient[2]};
        V total{}, curvature[4];
        for (int i = 0; i < 4; ++i) {
            b[i].norm = root(norm2(g[i]));
            total = total + b[i].norm;
        }
        Areas::curvature(d, l, g, curvature);
        const V strain = p.k * absolute(l.h - p.rest_length);
        for (int i = 0; i < 4; ++i) {
            const auto has_norm = b[i].norm > V{};
            const V share = select(has_norm, total / select(has_norm, b[i].norm, splat<V>(1)), V{});
            b[i].stiff = outer(p.k * share, g[i], V{});
            b[i].damp = outer(p.c * share, g[i], V{});
            b[i].isotropic = strain * curvature[i];
        }
    }
};

/// Curvature of h = 6V/M along u, bounded by the sum of bound[i] |u_i|^2: h'' = (6V)''/M - 2 M'h'/M - h M''/M, with
/// |(6V)''| <= sum of |opposite edge| |u_i||u_j|, |M'h'| <= |G||g|/M |u|^2 and |M M''| <= sum of max_area_curvature[i]
/// |u_i|^2.
template <class V, class L>
CLOTH_INLINE void length_curvature(const Vec3<V>* p, const L& l, const Vec3<V>* g, const V* max_area_curvature,
                                   V* bound) {
    const Vec3<V> zero{}, x[4] = {zero, p[0], p[1], p[2]};
    const Vec3<V> area0 = -(l.area[0] + l.area[1] + l.area[2]);
    const V areas = norm2(area0) + norm2(l.area[0]) + norm2(l.area[1]) + norm2(l.area[2]);
    const V weights = norm2(g[0]) + norm2(g[1]) + norm2(g[2]) + norm2(g[3]);
    const V mixed = splat<V>(2) * root(areas * weights) / l.square;
    const V inverse = inverse_root(l.square), turn = absolute(l.h) / l.square;
    for (int i = 0; i < 4; ++i) {
        const Vec3<V> o = x[(i + 1) & 3], q = x[(i + 2) & 3] - o, r = x[(i + 3) & 3] - o;
        const V sides = root(norm2(q)) + root(norm2(r)) + root(norm2(r - q));
        bound[i] = mixed + sides * inverse + turn * max_area_curvature[i];
    }
}

/// S8: M^2 = |a x w|^2 + (parallel |a|^2)^2 of the shared edge a and the line of the wings w. The second term keeps h
/// defined if they are parallel, as in a pair folded shut. Undefined if the edge has no length.
struct CrossedAreas {
    static constexpr double parallel = 0.1;
    /// Squared M [m^4] below which the edge has no length.
    static constexpr double min_square = 1e-30;

    template <class V>
    static CLOTH_INLINE void of(const Vec3<V>* d, V& square, V& limit, Vec3<V>* area) {
        const Vec3<V> a = d[0], w = d[2] - d[1], n = cross(a, w);
        const V length2 = norm2(a), share = splat<V>(parallel * parallel) * length2;
        square = fma(share, length2, norm2(n));
        limit = splat<V>(min_square);
        area[0] = fma(splat<V>(2) * share, a, cross(w, n));
        area[2] = cross(n, a);
        area[1] = -area[2];
    }
    /// With |a'|, |w'| <= sqrt(2) |u|: |n'|^2 <= 2 (|a|^2 + |w|^2) |u|^2, n.n'' <= 2 |n| |u|^2, and the second term
    /// contributes at most 12 parallel^2 |a|^2 |u|^2.
    template <class V, class L>
    static CLOTH_INLINE void curvature(const Vec3<V>* d, const L& l, const Vec3<V>* g, V* bound) {
        const Vec3<V> a = d[0], w = d[2] - d[1];
        const V length2 = norm2(a);
        V max_area_curvature[4];
        max_area_curvature[0] = splat<V>(2) * (length2 + norm2(w) + root(norm2(cross(a, w)))) +
                                splat<V>(12 * parallel * parallel) * length2;
        max_area_curvature[1] = max_area_curvature[2] = max_area_curvature[3] = max_area_curvature[0];
        length_curvature(d, l, g, max_area_curvature, bound);
    }
};

/// S9, the blend of all seven candidates: M^2 is the sum of the squared |a x b| of the four faces. Undefined if all
/// four points are collinear.
struct AltitudeAreas {
    /// Ratio of the largest |a x b| to the squared size below which the points are collinear.
    static constexpr double sine = 1e-12;

    template <class V>
    static CLOTH_INLINE void of(const Vec3<V>* p, V& square, V& limit, Vec3<V>* area) {
        // Area vectors n1, n2, n3 of the faces at corner 0 and n0 of the opposite one, which close the tetrahedron. The
        // gradients of |p x q|^2 / 2 are q x n and n x p; their sums over the faces are cross products with n - n0.
        const Vec3<V> a = p[0], b = p[1], c = p[2];
        const Vec3<V> n1 = cross(b, c), n2 = cross(c, a), n3 = cross(a, b), n0 = -(n1 + n2 + n3);
        const Vec3<V> m1 = n1 - n0, m2 = n2 - n0, m3 = n3 - n0;
        area[0] = cross_difference(b, m3, c, m2);
        area[1] = cross_difference(c, m1, a, m3);
        area[2] = cross_difference(a, m2, b, m1);
        square = norm2(n0) + norm2(n1) + norm2(n2) + norm2(n3);
        const V size = splat<V>(sine) * (norm2(a) + norm2(b) + norm2(c));
        limit = size * size;
    }
    /// M M'' <= sum over faces of (squared sides + 2 |n|) |u|^2.
    template <class V, class L>
    static CLOTH_INLINE void curvature(const Vec3<V>* p, const L& l, const Vec3<V>* g, V* bound) {
        const Vec3<V> zero{}, x[4] = {zero, p[0], p[1], p[2]};
        V squares[4], max_area_curvature[4], all{};
        for (int i = 0; i < 4; ++i) {
            const Vec3<V> o = x[(i + 1) & 3], q = x[(i + 2) & 3] - o, r = x[(i + 3) & 3] - o;
            squares[i] = norm2(q) + norm2(r) + norm2(r - q) + splat<V>(2) * root(norm2(cross(q, r)));
            all = all + squares[i];
        }
        for (int i = 0; i < 4; ++i) max_area_curvature[i] = all - squares[i];
        length_curvature(p, l, g, max_area_curvature, bound);
    }
};

/// Candidate of S9 between two opposite edges, of corners 0, 1 and 2, 3: M is |a x w|. Undefined if they are parallel,
/// and near that its gradient grows without limit.
struct EdgeEdgeAreas {
    template <class V>
    static CLOTH_INLINE void of(const Vec3<V>* d, V& square, V& limit, Vec3<V>* area) {
        const Vec3<V> a = d[0], w = d[2] - d[1], n = cross(a, w);
        square = norm2(n);
        const V size = splat<V>(AltitudeAreas::sine) * (norm2(a) + norm2(w));
        limit = size * size;
        area[0] = cross(w, n);
        area[2] = cross(n, a);
        area[1] = -area[2];
    }
    /// As that of CrossedAreas without its second term.
    template <class V, class L>
    static CLOTH_INLINE void curvature(const Vec3<V>* d, const L& l, const Vec3<V>* g, V* bound) {
        const Vec3<V> a = d[0], w = d[2] - d[1];
        const V largest = splat<V>(2) * (norm2(a) + norm2(w) + root(norm2(cross(a, w))));
        const V max_area_curvature[4] = {largest, largest, largest, largest};
        length_curvature(d, l, g, max_area_curvature, bound);
    }
};

/// Candidate of S9 between corner 3 and the face of corners 0, 1, 2, an altitude spring: M is |p x q| of the face.
/// Undefined if the face has no area, and near that its gradient grows without limit.
struct PointFaceAreas {
    template <class V>
    static CLOTH_INLINE void of(const Vec3<V>* d, V& square, V& limit, Vec3<V>* area) {
        const Vec3<V> n = cross(d[0], d[1]);
        square = norm2(n);
        const V size = splat<V>(AltitudeAreas::sine) * (norm2(d[0]) + norm2(d[1]));
        limit = size * size;
        area[0] = cross(d[1], n);
        area[1] = cross(n, d[0]);
        area[2] = Vec3<V>{};
    }
    /// As that of AltitudeAreas for one face.
    template <class V, class L>
    static CLOTH_INLINE void curvature(const Vec3<V>* d, const L& l, const Vec3<V>* g, V* bound) {
        const V largest = norm2(d[0]) + norm2(d[1]) + norm2(d[1] - d[0]) + splat<V>(2) * root(norm2(cross(d[0], d[1])));
        const V max_area_curvature[4] = {largest, largest, largest, V{}};
        length_curvature(d, l, g, max_area_curvature, bound);
    }
};

using Crossed = Hinge<CrossedAreas>;
using Altitude = Hinge<AltitudeAreas>;
using EdgeEdge = Hinge<EdgeEdgeAreas>;
using PointFace = Hinge<PointFaceAreas>;

}  // namespace cloth::laws
