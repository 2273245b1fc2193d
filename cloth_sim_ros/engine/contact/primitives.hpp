// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Nearest points of primitives: triangle to point, and segment to segment. V is a number, a vector of them, or a dual
// number.
#pragma once

#include <initializer_list>

#include "core/algebra.hpp"

namespace cloth::contact {

/// An axis-aligned box.
struct AxisBox {
    Vec3<double> low, high;

    explicit AxisBox(Vec3<double> a) : low(a), high(a) {}
    explicit AxisBox(std::initializer_list<Vec3<double>> points) : AxisBox(*points.begin()) {
        for (const Vec3<double>& p : points) include(p);
    }
    void include(Vec3<double> a) {
        low = {smaller(a.x, low.x), smaller(a.y, low.y), smaller(a.z, low.z)};
        high = {larger(a.x, high.x), larger(a.y, high.y), larger(a.z, high.z)};
    }
    AxisBox expanded(double by) const {
        const Vec3<double> margin{by, by, by};
        AxisBox b(low - margin);
        b.high = high + margin;
        return b;
    }
    bool overlaps(const AxisBox& b) const {
        return b.high.x >= low.x && b.low.x <= high.x && b.high.y >= low.y && b.low.y <= high.y && b.high.z >= low.z &&
               b.low.z <= high.z;
    }
    Vec3<double> center() const { return 0.5 * (low + high); }
};

/// Whether a segment from p to q intersects a triangle, not at its border.
inline bool segment_intersects(Vec3<double> p, Vec3<double> q, Vec3<double> a, Vec3<double> b, Vec3<double> c) {
    // Six times the signed volume of a tetrahedron.
    const auto volume = [](Vec3<double> i, Vec3<double> j, Vec3<double> k, Vec3<double> l) {
        return dot(cross(j - i, k - i), l - i);
    };
    if (!(volume(a, b, c, p) * volume(a, b, c, q) < 0.0)) return false;
    const double u = volume(p, q, a, b), v = volume(p, q, b, c), w = volume(p, q, c, a);
    return (u > 0.0 && v > 0.0 && w > 0.0) || (u < 0.0 && v < 0.0 && w < 0.0);
}

template <class V>
CLOTH_INLINE V within_one(V a) {
    return larger(smaller(a, splat<V>(1.0)), V{});
}

/// Nearest point of a segment from a to b: fraction from a, and squared distance.
template <class V>
struct OnSegment {
    V fraction, square;
    Vec3<V> away;  ///< from there to the point
};
template <class V>
CLOTH_INLINE OnSegment<V> near_segment(Vec3<V> p, Vec3<V> a, Vec3<V> b) {
    const Vec3<V> along = b - a, from = p - a;
    const V fraction = within_one(dot(from, along) / norm2(along));
    const Vec3<V> away = from - fraction * along;
    return {fraction, norm2(away), away};
}

/// Nearest point of a triangle: weights of its corners.
template <class V>
struct OnTriangle {
    V weight[3], square;
    Vec3<V> away;
};
/// Squared distances of a point from the edges of a triangle, from corner 0 to 1, 1 to 2, 2 to 0, and from its corners.
template <class V>
struct PartSquares {
    V edge[3], corner[3];
};
/// Inside, or on the nearest edge. A degenerate triangle has edges only.
template <class V>
CLOTH_INLINE OnTriangle<V> near_triangle(Vec3<V> p, Vec3<V> a, Vec3<V> b, Vec3<V> c, PartSquares<V>* parts = nullptr) {
    const V zero{}, unit = splat<V>(1.0);
    const OnSegment<V> ab = near_segment(p, a, b), bc = near_segment(p, b, c), ca = near_segment(p, c, a);
    if (parts) *parts = {{ab.square, bc.square, ca.square}, {norm2(p - a), norm2(p - b), norm2(p - c)}};
    OnTriangle<V> n{{unit - ab.fraction, ab.fraction, zero}, ab.square, ab.away};
    const auto choose = [&](auto yes, V u, V v, V w, V square, Vec3<V> away) CLOTH_INLINED {
        n.weight[0] = select(yes, u, n.weight[0]);
        n.weight[1] = select(yes, v, n.weight[1]);
        n.weight[2] = select(yes, w, n.weight[2]);
        n.away = {select(yes, away.x, n.away.x), select(yes, away.y, n.away.y), select(yes, away.z, n.away.z)};
        n.square = select(yes, square, n.square);
    };
    choose(bc.square < n.square, zero, unit - bc.fraction, bc.fraction, bc.square, bc.away);
    choose(ca.square < n.square, ca.fraction, zero, unit - ca.fraction, ca.square, ca.away);
    const Vec3<V> e = b - a, g = c - a, r = p - a, normal = cross(e, g);
    const V over = unit / norm2(normal), v = dot(cross(r, g), normal) * over, w = dot(cross(e, r), normal) * over;
    const V u = unit - v - w;
    const Vec3<V> away = r - v * e - w * g;
    const V square = norm2(away);
    choose(select(smaller(smaller(v, w), u) > zero, square, n.square) < n.square, u, v, w, square, away);
    return n;
}

/// Nearest points of two segments, from a to b and from c to e, as fractions.
template <class V>
struct OnSegments {
    V first, second, square;
    Vec3<V> away;  ///< from the second to the first
};
/// Inside both, or at an end of one.
template <class V>
CLOTH_INLINE OnSegments<V> near_segments(Vec3<V> a, Vec3<V> b, Vec3<V> c, Vec3<V> e) {
    const V zero{}, unit = splat<V>(1.0);
    OnSegments<V> n;
    const auto choose = [&](auto yes, V first, V second, V square, Vec3<V> away) CLOTH_INLINED {
        n.first = select(yes, first, n.first);
        n.second = select(yes, second, n.second);
        n.square = select(yes, square, n.square);
        n.away = {select(yes, away.x, n.away.x), select(yes, away.y, n.away.y), select(yes, away.z, n.away.z)};
    };
    const OnSegment<V> at_a = near_segment(a, c, e), at_b = near_segment(b, c, e);
    const OnSegment<V> at_c = near_segment(c, a, b), at_e = near_segment(e, a, b);
    n = {zero, at_a.fraction, at_a.square, at_a.away};
    choose(at_b.square < n.square, unit, at_b.fraction, at_b.square, at_b.away);
    choose(at_c.square < n.square, at_c.fraction, zero, at_c.square, -at_c.away);
    choose(at_e.square < n.square, at_e.fraction, unit, at_e.square, -at_e.away);
    const Vec3<V> u = b - a, v = e - c, r = a - c, normal = cross(u, v);
    const V over = unit / norm2(normal);
    const V first = dot(cross(v, r), normal) * over, second = dot(cross(u, r), normal) * over;
    const V inside = smaller(smaller(first, unit - first), smaller(second, unit - second));
    const Vec3<V> away = r + first * u - second * v;
    const V square = norm2(away);
    choose(select(inside > zero, square, n.square) < n.square, first, second, square, away);
    return n;
}

}  // namespace cloth::contact
