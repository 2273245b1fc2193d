// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of the coupling.
#include "laws/coupling.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// A coupling of 3 N/m and a damping time of 0.02 s.
struct CouplingSetup {
    using Law = Coupling;
    template <class V>
    static Coupling::Params<V> params() {
        using T = scalar<V>;
        const double common[] = {0.02};
        const V k = splat<V>(T(3.0));
        return Coupling::make_params<V>(&k, common);
    }
    static void shape(Random& random, Vec3<double>* d) { d[0] = 0.1 * random.vector(); }
};

}  // namespace

TEST_CASE("couplings pass the checks of every law") {
    LawChecks<CouplingSetup>::check_energy_gradient();
    LawChecks<CouplingSetup>::check_dissipation();
    LawChecks<CouplingSetup>::check_derivative_product();
    LawChecks<CouplingSetup>::check_bounds();
    LawChecks<CouplingSetup>::template check_lanes<double>();
    LawChecks<CouplingSetup>::template check_lanes<float>();
}

TEST_CASE("a negative coupling repels and has no bound") {
    const double k = -3.0, common[] = {0.02};
    const auto p = Coupling::make_params<double>(&k, common);
    const Vec3<double> d[1] = {{0.1, 0.0, 0.0}}, u[1] = {{0.0, 1.0, 0.0}};
    Vec3<double> f[1];
    Coupling::force(p, d, u, f, true);
    CHECK(f[0].x == doctest::Approx(0.3));
    CHECK(f[0].y == doctest::Approx(0.06));
    Bound<double> b[2];
    Coupling::bounds(p, d, b);
    CHECK(b[0].stiff.xx == 0.0);
    CHECK(b[1].damp.zz == 0.0);
}

}  // namespace cloth::tests
