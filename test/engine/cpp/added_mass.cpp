// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of added mass: air that panels carry along.
#include "laws/added_mass.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// rho = 0.7 kg/m^2, in still air or in a wind.
template <int Corners, bool Windy = false>
struct MassSetup {
    using Law = AddedMass<Corners>;
    template <class V>
    static typename Law::template Params<V> params() {
        using T = scalar<V>;
        const Vec3<double> wind = Windy ? Vec3<double>{2.0, -1.0, 3.0} : Vec3<double>{};
        return {splat<V>(T(0.7)), V{}, splat3<V>(wind)};
    }
    /// Corners in order around a square of about 0.1 m.
    static void shape(Random& random, Vec3<double>* d) {
        const Vec3<double> square[3] = {{0.1, 0.0, 0.0}, {0.1, 0.1, 0.0}, {0.0, 0.1, 0.0}};
        for (int i = 0; i < Corners - 1; ++i) d[i] = square[i] + 0.03 * random.vector();
    }
};

}  // namespace

TEST_CASE_TEMPLATE("added mass has an exact derivative product and equal lanes", Setup, MassSetup<3>, MassSetup<4>,
                   MassSetup<3, true>, MassSetup<4, true>) {
    using Checks = LawChecks<Setup>;
    Checks::check_derivative_product();
    Checks::template check_lanes<double>();
    Checks::template check_lanes<float>();
}

TEST_CASE_TEMPLATE("forces of carried air take the power that its growing mass gains", Setup, MassSetup<3>,
                   MassSetup<4>) {
    using Checks = LawChecks<Setup>;
    using Law = typename Setup::Law;
    const auto params = Setup::template params<double>();
    Random random;
    for (int round = 0; round < Checks::rounds; ++round) {
        const auto e = Checks::element(random);
        Vec3<double> f[Checks::corners];
        Checks::add_force(e, true, f);
        double power = 0.0;
        for (int i = 0; i < Checks::corners; ++i) power += dot(f[i], e.u[i]);
        // Positions move with the velocities, which stay.
        const auto energy = [&](double h) {
            auto at = e;
            for (int i = 0; i < Checks::differences; ++i) at.d[i] = fma(h, e.u[i + 1] - e.u[0], e.d[i]);
            return Law::kinetic_energy(params, at.d, e.u);
        };
        const double h = 1e-6;
        check_close(power, -(energy(h) - energy(-h)) / (2.0 * h), 1e-6, 1e-3);
    }
}

TEST_CASE("a block with the identity is inverted") {
    const Vec3<double> n{0.48, 0.6, 0.64}, a{1.0, -2.0, 3.0};
    const Vec3<double> b = accelerated(outer(6.0, n, 0.0), 0.5, a);
    // Sherman and Morrison: across n the inertia is 1 + 6 / 2.
    const Vec3<double> expected = a - (0.75 * dot(a, n)) * n;
    check_close(b, expected, 1e-14);
}

}  // namespace cloth::tests
