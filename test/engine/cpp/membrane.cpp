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

/// The same with moduli that grow; the shapes of its elements reach both sides of the limits.
struct StiffeningSetup : MembraneSetup {
    using Law = StiffeningMembrane;
    template <class V>
    static StiffeningMembrane::Params<V> params() {
        using T = scalar<V>;
        const double numbers[] = {16.0, 15.0, -12.0, 20.0, 1e-3, 4e-5};
        const double common[] = {300.0, 40.0, 120.0, 30.0, 9.0, 1.0, 5.0, 2.0, 0.4, 5000.0, 0.2, 3000.0, 0.3, 800.0};
        V values[6];
        for (int k = 0; k < 6; ++k) values[k] = splat<V>(T(numbers[k]));
        return StiffeningMembrane::make_params<V>(values, common);
    }
};

template <class Setup>
void check_law() {
    LawChecks<Setup>::check_energy_gradient();
    LawChecks<Setup>::check_dissipation();
    LawChecks<Setup>::check_derivative_product();
    LawChecks<Setup>::check_bounds();
    LawChecks<Setup>::template check_lanes<double>();
    LawChecks<Setup>::template check_lanes<float>();
    LawChecks<Setup>::check_torque(true);
}

}  // namespace

TEST_CASE("membranes pass the checks of every law") {
    check_law<MembraneSetup>();
    check_law<StiffeningSetup>();
}

TEST_CASE("a modulus grows with the square of the strain up to its limit") {
    const auto p = StiffeningSetup::params<double>();
    const auto force = [&](double strain) {
        // Corners so that a = (1, 0, 0) * stretch and b = (0, 1, 0), by the inverse of the gradients.
        const double determinant = 16.0 * 20.0 + 12.0 * 15.0, stretch = root(1.0 + 2.0 * strain);
        const Vec3<double> a{stretch, 0.0, 0.0}, b{0.0, 1.0, 0.0};
        const Vec3<double> d[2] = {(1.0 / determinant) * (20.0 * a - 15.0 * b),
                                   (1.0 / determinant) * (12.0 * a + 16.0 * b)},
                           u[2]{};
        Vec3<double> f[2];
        StiffeningMembrane::force(p, d, u, f, false);
        // f1 = -p1 s1 a - q1 s2 b along x.
        return -f[0].x / (16.0 * stretch * p.area);
    };
    check_close(force(0.1), 300.0 * 0.1 + 5000.0 * 0.1 * 0.1 * 0.1 / 3.0, 1e-12, 0.0);
    check_close(force(0.5), 300.0 * 0.5 + 5000.0 * 0.16 * (0.5 - 0.8 / 3.0), 1e-12, 0.0);
    check_close(force(-0.1), -30.0, 1e-12, 0.0);
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
