// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Vectors in space, symmetric matrices of numbers V, and numbers that carry a derivative.
#pragma once

#include <type_traits>
#include <utility>

#include "core/simd.hpp"

namespace cloth::inline core {

template <class V>
struct Vec3 {
    V x, y, z;
};
/// Conversions between numbers of single and double precision.
template <class T>
CLOTH_INLINE Vec3<double> to_double(Vec3<T> a) {
    return {static_cast<double>(a.x), static_cast<double>(a.y), static_cast<double>(a.z)};
}
template <class T>
CLOTH_INLINE Vec3<T> narrowed(Vec3<double> a) {
    return {static_cast<T>(a.x), static_cast<T>(a.y), static_cast<T>(a.z)};
}
template <class V>
CLOTH_INLINE Vec3<V> operator+(Vec3<V> a, Vec3<V> b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class V>
CLOTH_INLINE Vec3<V> operator-(Vec3<V> a, Vec3<V> b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class V>
CLOTH_INLINE Vec3<V> operator-(Vec3<V> a) {
    return {-a.x, -a.y, -a.z};
}
template <class V>
CLOTH_INLINE Vec3<V> operator*(V s, Vec3<V> a) {
    return {s * a.x, s * a.y, s * a.z};
}
/// s a + b.
template <class V>
CLOTH_INLINE Vec3<V> fma(V s, Vec3<V> a, Vec3<V> b) {
    return {fma(s, a.x, b.x), fma(s, a.y, b.y), fma(s, a.z, b.z)};
}
template <class V>
CLOTH_INLINE V dot(Vec3<V> a, Vec3<V> b) {
    return fma(a.z, b.z, fma(a.y, b.y, a.x * b.x));
}
template <class V>
CLOTH_INLINE V norm2(Vec3<V> a) {
    return dot(a, a);
}
template <class V>
CLOTH_INLINE V norm2_plus(Vec3<V> a, scalar<V> addend) {
    return fma(a.z, a.z, fma(a.y, a.y, fma(a.x, a.x, splat<V>(addend))));
}
template <class V>
CLOTH_INLINE Vec3<V> cross(Vec3<V> a, Vec3<V> b) {
    return {fma(a.y, b.z, -(a.z * b.y)), fma(a.z, b.x, -(a.x * b.z)), fma(a.x, b.y, -(a.y * b.x))};
}
/// a x b - c x d, with one rounding less per product than two cross products.
template <class V>
CLOTH_INLINE Vec3<V> cross_difference(Vec3<V> a, Vec3<V> b, Vec3<V> c, Vec3<V> d) {
    const auto part = [](V p, V q, V r, V s, V t, V u, V v, V w)
                          CLOTH_INLINED { return fma(p, q, fma(-r, s, fma(-t, u, v * w))); };
    return {part(a.y, b.z, a.z, b.y, c.y, d.z, c.z, d.y), part(a.z, b.x, a.x, b.z, c.z, d.x, c.x, d.z),
            part(a.x, b.y, a.y, b.x, c.x, d.y, c.y, d.x)};
}

/// A symmetric 3x3 matrix.
template <class V>
struct Sym3 {
    V xx, yy, zz, xy, xz, yz;
};
/// s a a' + t I.
template <class V>
CLOTH_INLINE Sym3<V> outer(V s, Vec3<V> a, V t) {
    const Vec3<V> b = s * a;
    return {fma(b.x, a.x, t), fma(b.y, a.y, t), fma(b.z, a.z, t), b.x * a.y, b.x * a.z, b.y * a.z};
}

/// A product of a matrix and a vector.
template <class V>
CLOTH_INLINE Vec3<V> product(const Sym3<V>& m, Vec3<V> a) {
    return {dot(Vec3<V>{m.xx, m.xy, m.xz}, a), dot(Vec3<V>{m.xy, m.yy, m.yz}, a), dot(Vec3<V>{m.xz, m.yz, m.zz}, a)};
}

/// Add a matrix to block i of n blocks (6, n): xx, yy, zz, xy, xz, yz.
inline void add_block(double* blocks, std::int64_t n, std::int64_t i, const Sym3<double>& b) {
    blocks[i] += b.xx;
    blocks[n + i] += b.yy;
    blocks[2 * n + i] += b.zz;
    blocks[3 * n + i] += b.xy;
    blocks[4 * n + i] += b.xz;
    blocks[5 * n + i] += b.yz;
}

/// A number and its derivative along a direction. A law evaluated with these yields its derivative product.
struct Dual {
    double value, slope;
};
CLOTH_INLINE Dual operator+(Dual a, Dual b) { return {a.value + b.value, a.slope + b.slope}; }
CLOTH_INLINE Dual operator-(Dual a, Dual b) { return {a.value - b.value, a.slope - b.slope}; }
CLOTH_INLINE Dual operator-(Dual a) { return {-a.value, -a.slope}; }
CLOTH_INLINE Dual operator*(Dual a, Dual b) { return {a.value * b.value, fma(a.value, b.slope, a.slope * b.value)}; }
CLOTH_INLINE Dual operator/(Dual a, Dual b) {
    const double q = a.value / b.value;
    return {q, (a.slope - q * b.slope) / b.value};
}
CLOTH_INLINE Dual fma(Dual a, Dual b, Dual c) { return a * b + c; }
CLOTH_INLINE Dual root(Dual a) {
    const double r = root(a.value);
    return {r, r > 0.0 ? 0.5 * a.slope / r : 0.0};
}
CLOTH_INLINE bool operator<(Dual a, Dual b) { return a.value < b.value; }
CLOTH_INLINE bool operator>(Dual a, Dual b) { return a.value > b.value; }
CLOTH_INLINE Dual select(bool yes, Dual a, Dual b) { return yes ? a : b; }
template <>
struct Scalar<Dual> {
    using type = double;
};
template <>
CLOTH_INLINE Dual splat<Dual>(double a) {
    return {a, 0.0};
}
template <class V>
inline Vec3<Dual> with_slope(Vec3<V> a, Vec3<V> slope) {
    return {{a.x, slope.x}, {a.y, slope.y}, {a.z, slope.z}};
}
CLOTH_INLINE double value_of(double a) { return a; }
CLOTH_INLINE double value_of(Dual a) { return a.value; }
inline Vec3<double> slope_of(Vec3<Dual> a) { return {a.x.slope, a.y.slope, a.z.slope}; }

}  // namespace cloth::inline core
