// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// SIMD vectors: each operation has the bits of the scalar one in each lane.
#include "core/simd.hpp"

#include <cfenv>
#include <vector>

#include "core/fpu_guard.hpp"
#include "core/storage.hpp"
#include "samples.hpp"

namespace cloth::tests {

namespace {

/// Number of lanes in which an operation of three vectors differs from the operation of their numbers.
template <class V, class F>
int count_differences(F&& operation) {
    using T = scalar<V>;
    Random random;
    int differences = 0;
    for (int round = 0; round < 500; ++round) {
        V a{}, b{}, c{};
        for (int k = 0; k < lane_count<V>; ++k) {
            a[k] = random.special<T>();
            b[k] = random.special<T>();
            c[k] = random.special<T>();
        }
        const V result = operation(a, b, c);
        for (int k = 0; k < lane_count<V>; ++k)
            differences += has_same_bits<T>(result[k], operation(T(a[k]), T(b[k]), T(c[k]))) ? 0 : 1;
    }
    return differences;
}

/// Check an operation for the widest vectors and for quads.
template <class T, class F>
void check_lanes(F&& operation) {
    CHECK(count_differences<vec<T>>(operation) == 0);
    CHECK(count_differences<quad<T>>(operation) == 0);
}

/// Rows x, y, z, 0 of particles with distinct numbers: 10 * particle + component.
template <class T>
std::vector<quad<T>> particle_rows(int count) {
    std::vector<quad<T>> rows(count);
    for (int i = 0; i < count; ++i)
        for (int component = 0; component < 3; ++component) rows[i][component] = T(10 * i + component);
    return rows;
}

}  // namespace

TEST_CASE_TEMPLATE("arithmetic agrees with numbers in each lane", T, double, float) {
    check_lanes<T>([](auto a, auto b, auto) { return a + b; });
    check_lanes<T>([](auto a, auto b, auto) { return a - b; });
    check_lanes<T>([](auto a, auto b, auto) { return a * b; });
    check_lanes<T>([](auto a, auto b, auto) { return a / b; });
    check_lanes<T>([](auto a, auto b, auto c) { return a * b + c; });  // never fused
    check_lanes<T>([](auto a, auto b, auto c) { return fma(a, b, c); });
    check_lanes<T>([](auto a, auto, auto) { return root(a); });
    check_lanes<T>([](auto a, auto, auto) { return inverse_root(a); });
}

TEST_CASE_TEMPLATE("choices agree with numbers in each lane", T, double, float) {
    check_lanes<T>([](auto a, auto b, auto c) { return select(a < b, b, c); });
    check_lanes<T>([](auto a, auto b, auto c) { return select(a >= b, b, c); });
    check_lanes<T>([](auto a, auto b, auto) { return smaller(a, b); });
    check_lanes<T>([](auto a, auto b, auto) { return larger(a, b); });
    check_lanes<T>([](auto a, auto, auto) { return absolute(a); });
}

TEST_CASE_TEMPLATE("fma rounds once", T, double, float) {
    const T step = std::ldexp(T(1), sizeof(T) == 8 ? -30 : -14);
    const T expected = -step * step;
    const vec<T> a = splat<vec<T>>(1 + step), b = splat<vec<T>>(1 - step), r = fma(a, b, splat<vec<T>>(T(-1)));
    for (int k = 0; k < lanes<T>; ++k) CHECK(r[k] == expected);
    CHECK(fma(T(1 + step), T(1 - step), T(-1)) == expected);
    // Rounded to 1 before the sum.
    CHECK(T(T(1 + step) * T(1 - step)) - T(1) == T(0));
}

TEST_CASE("reciprocals of vectors are rounded as quotients") {
    Random random;
    const auto count = [&](auto&& number) {
        int differences = 0;
        for (int round = 0; round < 20000; ++round) {
            vec<double> a{};
            for (int k = 0; k < lanes<double>; ++k) a[k] = number();
            const vec<double> result = reciprocal(a);
            for (int k = 0; k < lanes<double>; ++k) differences += has_same_bits(result[k], 1.0 / a[k]) ? 0 : 1;
        }
        return differences;
    };
    const auto scale = [&] { return std::ldexp(1.0, static_cast<int>(random.below(1000)) - 500); };
    CHECK(count([&] { return scale() * random.uniform(1.0, 2.0); }) == 0);
    // Just below two the first approximations are halfway between two numbers; just above one they are nearly exact.
    CHECK(count([&] { return scale() * (2.0 - 0x1p-52 * static_cast<double>(1 + random.below(64))); }) == 0);
    CHECK(count([&] { return scale() * (1.0 + 0x1p-52 * static_cast<double>(random.below(64))); }) == 0);
    CHECK(count([&] { return random.special<double>(); }) == 0);
}

TEST_CASE_TEMPLATE("root and inverse root have closed values", T, double, float) {
    CHECK(root(T(9)) == T(3));
    CHECK(inverse_root(T(16)) == T(0.25));
    CHECK(root(splat<vec<T>>(T(6.25)))[lanes<T> - 1] == T(2.5));
    CHECK(std::isnan(root(splat<vec<T>>(T(-1)))[0]));
}

TEST_CASE_TEMPLATE("smaller, larger and absolute have closed values, also for NaN", T, double, float) {
    const T nan = std::numeric_limits<T>::quiet_NaN();
    CHECK(smaller(nan, T(2)) == T(2));
    CHECK(larger(nan, T(2)) == T(2));
    CHECK(smaller(T(1), T(2)) == T(1));
    CHECK(larger(T(1), T(2)) == T(2));
    CHECK(absolute(T(-2)) == T(2));
    CHECK(absolute(T(2)) == T(2));
}

TEST_CASE_TEMPLATE("splat keeps signed zeros and every number", T, double, float) {
    Random random;
    for (int round = 0; round < 200; ++round) {
        const T a = random.special<T>();
        const vec<T> all = splat<vec<T>>(a);
        for (int k = 0; k < lanes<T>; ++k) CHECK(has_same_bits<T>(all[k], a));
        CHECK(has_same_bits(splat<T>(a), a));
    }
}

TEST_CASE_TEMPLATE("load and store need no alignment and keep their limits", T, double, float) {
    T from[3 * lanes<T> + 8], to[3 * lanes<T> + 8] = {};
    for (int k = 0; k < static_cast<int>(std::size(from)); ++k) from[k] = T(k + 1);
    store(to + 1, load(from + 3));
    for (int k = 0; k < static_cast<int>(std::size(to)); ++k)
        CHECK(to[k] == (k >= 1 && k < 1 + lanes<T> ? T(k + 3) : T(0)));
    T quads[6] = {};
    store4(quads + 1, load4(from + 2));
    for (int k = 0; k < 6; ++k) CHECK(quads[k] == (k >= 1 && k < 5 ? T(k + 2) : T(0)));
}

TEST_CASE_TEMPLATE("bits of a mask follow the lanes", T, double, float) {
    const vec<T> none{};
    for (unsigned pattern = 0; pattern < (1u << lanes<T>); pattern += lanes<T> > 8 ? 37 : 1) {
        vec<T> a{};
        for (int k = 0; k < lanes<T>; ++k) a[k] = pattern >> k & 1u ? T(-1) : T(1);
        CHECK(bits_of(a < none) == pattern);
        CHECK(any(a < none) == (pattern != 0));
    }
    quad<T> four{T(-1), T(1), T(1), T(-1)};
    CHECK(bits_of(four < quad<T>{}) == 0b1001u);
    CHECK(any(true));
    CHECK_FALSE(any(false));
}

TEST_CASE("each_below visits the indices below a limit in ascending order") {
    Random random;
    for (std::size_t size = 0; size < 40; ++size) {
        // The padding holds numbers below the limit, which do not count.
        std::vector<double> numbers(size + lanes<double>, -1.0);
        std::vector<std::size_t> expected, visited;
        for (std::size_t k = 0; k < size; ++k) {
            numbers[k] = random.uniform(0.0, 2.0);
            if (random.below(8) == 0) numbers[k] = std::numeric_limits<double>::quiet_NaN();
            if (numbers[k] < 1.0) expected.push_back(k);
        }
        each_below(numbers.data(), size, 1.0, [&](std::size_t k) { visited.push_back(k); });
        CHECK(visited == expected);
    }
}

TEST_CASE("compress moves lanes to the front in their order") {
    vec<double> a{};
    for (int k = 0; k < lanes<double>; ++k) a[k] = 10.0 + k;
    for (unsigned pattern = 0; pattern < (1u << lanes<double>); ++pattern) {
        const vec<double> front = compress(a, pattern);
        int n = 0;
        for (int k = 0; k < lanes<double>; ++k)
            if (pattern >> k & 1u) CHECK(front[n++] == a[k]);
    }
}

TEST_CASE_TEMPLATE("shift joins the end of a vector with the begin of the next", T, double, float) {
    vec<T> previous{}, next{};
    for (int k = 0; k < lanes<T>; ++k) {
        previous[k] = T(k);
        next[k] = T(lanes<T> + k);
    }
    const vec<T> first = shift<1>(previous, next), second = shift<2>(previous, next);
    for (int k = 0; k < lanes<T>; ++k) {
        CHECK(first[k] == T(lanes<T> - 1 + k));
        CHECK(second[k] == T(lanes<T> - 2 + k));
    }
}

TEST_CASE_TEMPLATE("deinterleave separates components and interleave joins them", T, double, float) {
    constexpr int count = lanes<T>;
    std::vector<quad<T>> rows = particle_rows<T>(count);
    for (int k = 0; k < count; ++k) rows[k][3] = T(-1 - k);
    vec<T> x{}, y{}, z{}, w{};
    deinterleave(rows.data(), x, y, z);
    for (int k = 0; k < count; ++k) {
        CHECK(x[k] == T(10 * k));
        CHECK(y[k] == T(10 * k + 1));
        CHECK(z[k] == T(10 * k + 2));
    }
    std::vector<quad<T>> joined(count, quad<T>{T(-1), T(-1), T(-1), T(-1)});
    interleave(x, y, z, joined.data());
    for (int k = 0; k < count; ++k) {
        for (int component = 0; component < 3; ++component) CHECK(joined[k][component] == rows[k][component]);
        CHECK(joined[k][3] == T(0));
    }
    deinterleave(rows.data(), x, y, z, w);
    interleave(x, y, z, joined.data(), w);
    for (int k = 0; k < count; ++k)
        for (int component = 0; component < 4; ++component) CHECK(joined[k][component] == rows[k][component]);
}

TEST_CASE("transpose exchanges rows and columns of each group of four lanes") {
    constexpr int count = lanes<float>;
    vec<float> rows[4] = {};
    for (int r = 0; r < 4; ++r)
        for (int k = 0; k < count; ++k) rows[r][k] = static_cast<float>(100 * (k / 4) + 10 * r + k % 4);
    transpose(rows[0], rows[1], rows[2], rows[3]);
    for (int r = 0; r < 4; ++r)
        for (int k = 0; k < count; ++k) CHECK(rows[r][k] == static_cast<float>(100 * (k / 4) + 10 * (k % 4) + r));
}

TEST_CASE("arrays begin on a cache line") {
    for (const std::size_t size : {1, 3, 17, 1000}) {
        const Array<double> numbers(size);
        CHECK(reinterpret_cast<std::uintptr_t>(numbers.data()) % 64 == 0);
    }
}

TEST_CASE("the guard rounds to nearest and restores the mode of its caller") {
    volatile double unit = 1.0, three = 3.0;
    const double nearest = unit / three;
    REQUIRE(std::fesetround(FE_UPWARD) == 0);
    const double upward = unit / three;
    double guarded = 0.0;
    {
        const FpuGuard guard;
        guarded = unit / three;
    }
    const double restored = unit / three;
    std::fesetround(FE_TONEAREST);
    CHECK(upward > nearest);
    CHECK(guarded == nearest);
    CHECK(restored == upward);
}

TEST_CASE_TEMPLATE("pairs of two vectors are split into even and odd numbers", T, double, float) {
    constexpr int L = lanes<T>;
    vec<T> first, second, even, odd;
    for (int k = 0; k < L; ++k) first[k] = static_cast<T>(k), second[k] = static_cast<T>(L + k);
    split_pairs(first, second, even, odd);
    for (int k = 0; k < L; ++k) {
        CHECK(even[k] == static_cast<T>(2 * k));
        CHECK(odd[k] == static_cast<T>(2 * k + 1));
    }
}

}  // namespace cloth::tests
