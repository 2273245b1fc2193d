// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Vectors in space, symmetric matrices and dual numbers against closed forms and difference quotients.
#include "core/algebra.hpp"

#include "samples.hpp"

namespace cloth::tests {

namespace {

/// Largest step of a difference quotient whose truncation error is below its tolerance.
constexpr double quotient_step = 1e-6;

/// Compare the slope of a function of a dual number with its central difference quotient.
template <class F>
void check_slope(F&& function, double low, double high) {
    Random random;
    for (int round = 0; round < 50; ++round) {
        const double a = random.uniform(low, high), direction = random.uniform(0.5, 2.0);
        const Dual result = function(Dual{a, direction});
        const auto at = [&](double t) { return function(Dual{a + t * direction, 0.0}).value; };
        CHECK(result.value == at(0.0));
        check_close(result.slope, (at(quotient_step) - at(-quotient_step)) / (2.0 * quotient_step), 1e-7, 1.0);
    }
}

/// A vector in space with other numbers in each lane.
template <class T>
Vec3<vec<T>> random_lanes(Random& random) {
    Vec3<vec<T>> a{};
    for (int k = 0; k < lanes<T>; ++k) {
        const Vec3<double> p = random.vector();
        a.x[k] = static_cast<T>(p.x), a.y[k] = static_cast<T>(p.y), a.z[k] = static_cast<T>(p.z);
    }
    return a;
}

template <class T>
bool has_same_bits3(Vec3<T> a, Vec3<T> b) {
    return has_same_bits(a.x, b.x) && has_same_bits(a.y, b.y) && has_same_bits(a.z, b.z);
}

}  // namespace

TEST_CASE_TEMPLATE("operations of vectors in space agree with numbers in each lane", T, double, float) {
    using V = vec<T>;
    Random random;
    for (int round = 0; round < 20; ++round) {
        const Vec3<V> a = random_lanes<T>(random), b = random_lanes<T>(random), c = random_lanes<T>(random),
                      e = random_lanes<T>(random);
        const V s = a.z;
        const auto check3 = [&](auto operation) {
            const Vec3<V> all = operation(s, a, b, c, e);
            for (int k = 0; k < lanes<T>; ++k)
                CHECK(has_same_bits3(lane(all, k), operation(T(s[k]), lane(a, k), lane(b, k), lane(c, k), lane(e, k))));
        };
        check3([](auto, auto p, auto q, auto, auto) { return p + q; });
        check3([](auto, auto p, auto q, auto, auto) { return p - q; });
        check3([](auto, auto p, auto, auto, auto) { return -p; });
        check3([](auto t, auto p, auto, auto, auto) { return t * p; });
        check3([](auto t, auto p, auto q, auto, auto) { return fma(t, p, q); });
        check3([](auto, auto p, auto q, auto, auto) { return cross(p, q); });
        check3([](auto, auto p, auto q, auto r, auto v) { return cross_difference(p, q, r, v); });
        const V products = dot(a, b), squares = norm2(a), shifted = norm2_plus(a, T(0.5));
        const Sym3<V> matrix = outer(s, a, b.x);
        for (int k = 0; k < lanes<T>; ++k) {
            CHECK(has_same_bits<T>(products[k], dot(lane(a, k), lane(b, k))));
            CHECK(has_same_bits<T>(squares[k], norm2(lane(a, k))));
            CHECK(has_same_bits<T>(shifted[k], norm2_plus(lane(a, k), T(0.5))));
            const Sym3<T> expected = outer(T(s[k]), lane(a, k), T(b.x[k]));
            CHECK(has_same_bits<T>(matrix.xx[k], expected.xx));
            CHECK(has_same_bits<T>(matrix.yz[k], expected.yz));
        }
    }
}

TEST_CASE("vectors in space have closed values") {
    const Vec3<double> a{1.0, 2.0, 3.0}, b{4.0, -5.0, 6.0}, c{2.0, 1.0, -2.0}, e{3.0, 0.0, 1.0};
    CHECK(dot(a, b) == 12.0);
    CHECK(norm2(a) == 14.0);
    CHECK(norm2_plus(a, 2.0) == 16.0);
    const auto check_vector = [](Vec3<double> p, double x, double y, double z) {
        CHECK(p.x == x);
        CHECK(p.y == y);
        CHECK(p.z == z);
    };
    check_vector(a + b, 5.0, -3.0, 9.0);
    check_vector(a - b, -3.0, 7.0, -3.0);
    check_vector(-a, -1.0, -2.0, -3.0);
    check_vector(2.0 * a, 2.0, 4.0, 6.0);
    check_vector(fma(2.0, a, b), 6.0, -1.0, 12.0);
    check_vector(cross(a, b), 27.0, 6.0, -13.0);
    // c x e = (1, -8, -3).
    check_vector(cross_difference(a, b, c, e), 26.0, 14.0, -10.0);
}

TEST_CASE("outer is s a a' + t I") {
    Random random;
    for (int round = 0; round < 50; ++round) {
        const Vec3<double> a = random.vector(), p = random.vector();
        const double s = random.uniform(), t = random.uniform();
        const Sym3<double> m = outer(s, a, t);
        const Vec3<double> product{m.xx * p.x + m.xy * p.y + m.xz * p.z, m.xy * p.x + m.yy * p.y + m.yz * p.z,
                                   m.xz * p.x + m.yz * p.y + m.zz * p.z};
        check_close(product, (s * dot(a, p)) * a + t * p, 1e-14, 1.0);
    }
}

TEST_CASE("slopes of dual numbers are derivatives") {
    const Dual c{0.75, 0.0};
    check_slope([&](Dual a) { return a + c; }, -2.0, 2.0);
    check_slope([&](Dual a) { return c - a; }, -2.0, 2.0);
    check_slope([&](Dual a) { return -a; }, -2.0, 2.0);
    check_slope([&](Dual a) { return a * a; }, -2.0, 2.0);
    check_slope([&](Dual a) { return c / a; }, 0.5, 2.0);
    check_slope([&](Dual a) { return a / (a * a + c); }, -2.0, 2.0);
    check_slope([&](Dual a) { return fma(a, c, a); }, -2.0, 2.0);
    check_slope([&](Dual a) { return root(a); }, 0.5, 2.0);
    check_slope([&](Dual a) { return inverse_root(a); }, 0.5, 2.0);
    check_slope([&](Dual a) { return absolute(a); }, 0.1, 2.0);
    check_slope([&](Dual a) { return absolute(a); }, -2.0, -0.1);
    check_slope([&](Dual a) { return larger(a, c) + smaller(a, c) * a; }, 0.8, 2.0);
}

TEST_CASE("the root of zero has slope zero") {
    const Dual r = root(Dual{0.0, 3.0});
    CHECK(r.value == 0.0);
    CHECK(r.slope == 0.0);
}

TEST_CASE("a constant has slope zero") {
    CHECK(splat<Dual>(2.5).value == 2.5);
    CHECK(splat<Dual>(2.5).slope == 0.0);
}

TEST_CASE("dual numbers compare by their value") {
    CHECK((Dual{1.0, 5.0} < Dual{2.0, -5.0}));
    CHECK((Dual{2.0, -5.0} > Dual{1.0, 5.0}));
    CHECK(select(true, Dual{1.0, 2.0}, Dual{3.0, 4.0}).slope == 2.0);
    CHECK(select(false, Dual{1.0, 2.0}, Dual{3.0, 4.0}).slope == 4.0);
}

}  // namespace cloth::tests
