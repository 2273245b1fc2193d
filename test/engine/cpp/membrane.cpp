// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of the membrane triangle.
#include "laws/membrane.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// A right triangle of sides 0.05 m and 0.04 m, its threads turned by 3/5, stiffer along the warp.
struct MembraneSetup {
    using Law = Membrane;
    template <class V>
    static Membrane::Params<V> params() {
        using T = scalar<V>;
        const double numbers[] = {16.0, 15.0, -12.0, 20.0, 1e-3, 4e-5};
        const double common[] = {300.0, 40.0, 120.0, 30.0, 9.0, 1.0, 5.0, 2.0};
        V values[6];
        for (int k = 0; k < 6; ++k) values[k] = splat<V>(T(numbers[k]));
        return Membrane::make_params<V>(values, common);
    }
    static void shape(Random& random, Vec3<double>* d) {
        d[0] = 0.05 * random.vector();
        d[1] = 0.04 * random.vector();
    }
};

}  // namespace

TEST_CASE("membranes pass the checks of every law") {
    LawChecks<MembraneSetup>::check_energy_gradient();
    LawChecks<MembraneSetup>::check_dissipation();
    LawChecks<MembraneSetup>::check_derivative_product();
    LawChecks<MembraneSetup>::check_bounds();
    LawChecks<MembraneSetup>::template check_lanes<double>();
    LawChecks<MembraneSetup>::template check_lanes<float>();
    LawChecks<MembraneSetup>::check_torque(true);
}

TEST_CASE("bounds of a membrane are the sum of its squares and the stress") {
    const auto p = MembraneSetup::params<double>();
    const Vec3<double> d[2] = {{0.05, 0.01, 0.0}, {0.0, 0.05, 0.02}};
    Bound<double> all[3], square[3];
    Membrane::bounds(p, d, all);
    double stiff[3] = {};
    for (int k = 0; k < Membrane::squares; ++k) {
        Membrane::square(p, d, k, square);
        for (int i = 0; i < 3; ++i) stiff[i] += square[i].stiff.xx;
    }
    for (int i = 0; i < 3; ++i) {
        CHECK(all[i].stiff.xx == stiff[i]);
        CHECK(all[i].isotropic > 0.0);
        CHECK(all[i].norm == 0.0);
    }
}

TEST_CASE("an element of zero numbers has neither force nor bounds") {
    const double zeros[6] = {};
    const double common[] = {300.0, 40.0, 120.0, 30.0, 9.0, 1.0, 5.0, 2.0};
    const auto p = Membrane::make_params<double>(zeros, common);
    const Vec3<double> d[2]{}, u[2]{};
    Vec3<double> f[2];
    Membrane::force(p, d, u, f, true);
    Bound<double> bound[3];
    Membrane::bounds(p, d, bound);
    for (const Vec3<double>& g : f) CHECK(norm2(g) == 0.0);
    for (const Bound<double>& b : bound) CHECK(b.stiff.xx + b.damp.xx + b.isotropic == 0.0);
}

}  // namespace cloth::tests
