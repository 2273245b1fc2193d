// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of the internal friction of bending.
#include "laws/bending_friction.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// Friction of 3 N/m about a plastic length of 0.01 m, with a reach [m].
template <int ReachMicrometres>
struct FrictionSetup {
    using Law = BendingFriction;
    template <class V>
    static BendingFriction::Params<V> params() {
        using T = scalar<V>;
        return {splat<V>(T(0.01)), splat<V>(T(3.0)), splat<V>(T(1e-6 * ReachMicrometres))};
    }
    static void shape(Random& random, Vec3<double>* d) {
        d[0] = Vec3<double>{0.0, 0.1, 0.0} + 0.02 * random.vector();
        d[1] = Vec3<double>{-0.1, 0.05, 0.0} + 0.04 * random.vector();
        d[2] = Vec3<double>{0.1, 0.05, 0.0} + 0.04 * random.vector();
    }
};

using Elastic = FrictionSetup<1000000>;
using Yielding = FrictionSetup<1000>;

}  // namespace

TEST_CASE_TEMPLATE("friction of bending passes the checks of every law", Setup, Elastic, Yielding) {
    LawChecks<Setup>::check_energy_gradient();
    LawChecks<Setup>::check_dissipation();
    LawChecks<Setup>::check_derivative_product();
    LawChecks<Setup>::check_bounds();
    LawChecks<Setup>::template check_lanes<double>();
    LawChecks<Setup>::template check_lanes<float>();
    LawChecks<Setup>::check_torque(false);
    LawChecks<Setup>::check_torque(true);
}

TEST_CASE("a plastic length within the reach keeps its bits") {
    const BendingFriction::Params<double> p{0.1, 3.0, 0.05};
    CHECK(BendingFriction::returned(p, 0.1499999) == 0.1);
    CHECK(BendingFriction::returned(p, 0.0500001) == 0.1);
}

TEST_CASE("a plastic length follows the signed length beyond the reach") {
    const BendingFriction::Params<double> p{0.1, 3.0, 0.05};
    CHECK(BendingFriction::returned(p, 0.25) == 0.2);
    CHECK(BendingFriction::returned(p, -0.25) == -0.2);
    CHECK(BendingFriction::plastic_work(p, 0.2) == doctest::Approx(3.0 * 0.05 * 0.1));
}

TEST_CASE("the return of a plastic length dissipates what the energy loses") {
    Random random;
    for (int round = 0; round < 100; ++round) {
        Vec3<double> d[3];
        Yielding::shape(random, d);
        auto p = Yielding::params<double>();
        const double before = BendingFriction::energy(p, d);
        const double next = BendingFriction::returned(p, Crossed::length(d).h);
        const double work = BendingFriction::plastic_work(p, next);
        p.plastic_length = next;
        check_close(before - BendingFriction::energy(p, d), work, 1e-12, 1e-6);
    }
}

}  // namespace cloth::tests
