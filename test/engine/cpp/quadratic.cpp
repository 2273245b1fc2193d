// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of the quadratic hinge.
#include "laws/quadratic.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// A hinge of 2e-3 N m with unequal triangles and a damping time of 0.02 s.
struct QuadraticSetup {
    using Law = QuadraticHinge;
    template <class V>
    static QuadraticHinge::Params<V> params() {
        using T = scalar<V>;
        const double numbers[] = {-9.0, 20.0, 12.0, 2e-3}, common[] = {0.02};
        V values[4];
        for (int k = 0; k < 4; ++k) values[k] = splat<V>(T(numbers[k]));
        return QuadraticHinge::make_params<V>(values, common);
    }
    static void shape(Random& random, Vec3<double>* d) {
        for (int i = 0; i < 3; ++i) d[i] = 0.1 * random.vector();
    }
};

}  // namespace

TEST_CASE("quadratic hinges pass the checks of every law") {
    LawChecks<QuadraticSetup>::check_energy_gradient();
    LawChecks<QuadraticSetup>::check_dissipation();
    LawChecks<QuadraticSetup>::check_derivative_product();
    LawChecks<QuadraticSetup>::check_bounds();
    LawChecks<QuadraticSetup>::template check_lanes<double>();
    LawChecks<QuadraticSetup>::template check_lanes<float>();
}

TEST_CASE("bounds of quadratic hinges are multiples of the identity") {
    const auto p = QuadraticSetup::params<double>();
    const Vec3<double> d[3] = {{0.1, 0.0, 0.0}, {0.0, 0.1, 0.0}, {0.0, 0.0, 0.1}};
    Bound<double> b[4];
    QuadraticHinge::bounds(p, d, b);
    // Absolute weights 23, 9, 20 and 12.
    CHECK(b[0].norm == 23.0);
    CHECK(b[2].stiff.xx == doctest::Approx(2e-3 * 64.0 * 20.0));
    CHECK(b[2].stiff.yy == b[2].stiff.xx);
    CHECK(b[2].stiff.xy == 0.0);
    CHECK(b[2].damp.zz == doctest::Approx(0.02 * b[2].stiff.xx));
    CHECK(b[2].transverse == b[2].stiff.xx);
}

}  // namespace cloth::tests
