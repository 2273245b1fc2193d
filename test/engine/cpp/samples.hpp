// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Random samples, and comparison of bits and of vector lanes.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <limits>

#include "core/algebra.hpp"
#include "doctest/doctest.h"

namespace cloth::tests {

/// Random numbers, the same in every run and on every machine: SplitMix64 (Steele, Lea, Flood 2014). The header <random>
/// takes half a second to compile.
class Random {
public:
    double uniform(double low = -1.0, double high = 1.0) {
        return low + (high - low) * (static_cast<double>(next() >> 11) * 0x1p-53);
    }
    std::int64_t below(std::int64_t limit) {
        return static_cast<std::int64_t>(next() % static_cast<std::uint64_t>(limit));
    }
    /// A vector in the cube from -1 to 1.
    Vec3<double> vector() {
        const double x = uniform(), y = uniform(), z = uniform();
        return {x, y, z};
    }
    /// A number of any size or sign; every fourth is zero, infinite, NaN, denormal, or a small integer.
    template <class T>
    T special() {
        using Limits = std::numeric_limits<T>;
        constexpr T specials[] = {T(0),
                                  -T(0),
                                  Limits::infinity(),
                                  -Limits::infinity(),
                                  Limits::max(),
                                  Limits::min(),
                                  Limits::denorm_min(),
                                  Limits::quiet_NaN(),
                                  T(1),
                                  -T(1),
                                  T(2),
                                  -Limits::min() / 8};
        if (below(4) == 0) return specials[below(std::size(specials))];
        return static_cast<T>(std::ldexp(uniform(), static_cast<int>(below(60)) - 30));
    }

private:
    std::uint64_t next() {
        std::uint64_t z = state_ += 0x9e3779b97f4a7c15;
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
        z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
        return z ^ (z >> 31);
    }

    std::uint64_t state_ = 1;
};

/// Return whether two numbers have the same bits, or are both NaN.
template <class T>
bool has_same_bits(T a, T b) {
    using Bits = std::conditional_t<sizeof(T) == 8, std::uint64_t, std::uint32_t>;
    return std::bit_cast<Bits>(a) == std::bit_cast<Bits>(b) || (std::isnan(a) && std::isnan(b));
}

template <class V>
inline constexpr int lane_count = sizeof(V) / sizeof(scalar<V>);

/// One lane of a vector, or of a vector in space.
template <class V>
auto lane(V a, int k) {
    return a[k];
}
template <class V>
Vec3<scalar<V>> lane(Vec3<V> a, int k) {
    return {a.x[k], a.y[k], a.z[k]};
}

/// The same number in every lane; a constant if V is a dual number.
template <class V>
Vec3<V> splat3(Vec3<double> a) {
    using T = scalar<V>;
    return {splat<V>(static_cast<T>(a.x)), splat<V>(static_cast<T>(a.y)), splat<V>(static_cast<T>(a.z))};
}
inline Vec3<Dual> dual(Vec3<double> a, Vec3<double> slope) { return {{a.x, slope.x}, {a.y, slope.y}, {a.z, slope.z}}; }

/// Check that a is b to a tolerance, relative to |b| + scale.
inline void check_close(double a, double b, double tolerance, double scale = 0.0) {
    CAPTURE(a);
    CAPTURE(b);
    CHECK(std::abs(a - b) <= tolerance * (std::abs(b) + scale));
}
inline void check_close(Vec3<double> a, Vec3<double> b, double tolerance, double scale = 0.0) {
    const double difference = std::sqrt(norm2(a - b)), size = std::sqrt(norm2(b));
    CHECK(difference <= tolerance * (size + scale));
}

}  // namespace cloth::tests
