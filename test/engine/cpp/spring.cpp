// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Laws of springs and joints.
#include "laws/spring.hpp"

#include "law_checks.hpp"
#include "laws/joint.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// A spring of rest length 0.05 m, 20 N/m and 0.3 N s/m, from a tenth to three times its rest length.
struct SpringSetup {
    using Law = Spring;
    template <class V>
    static Spring::Params<V> params() {
        using T = scalar<V>;
        return {splat<V>(T(1.0)), splat<V>(T(20.0)), splat<V>(T(0.3))};
    }
    static void shape(Random& random, Vec3<double>* d) {
        const Vec3<double> direction = random.vector();
        d[0] = (random.uniform(0.005, 0.15) * inverse_root(norm2(direction))) * direction;
    }
};

/// A joint of 20 N/m and 0.3 N s/m.
struct JointSetup {
    using Law = Joint;
    template <class V>
    static Joint::Params<V> params() {
        using T = scalar<V>;
        return {splat<V>(T(20.0)), splat<V>(T(0.3))};
    }
    static void shape(Random& random, Vec3<double>* d) { d[0] = random.vector(); }
};

const Spring::Params<double> spring = SpringSetup::params<double>();

/// Force on the far end of the spring along x, with a velocity along x.
double axial_force(double length, double speed) {
    const Vec3<double> d{length, 0.0, 0.0}, u{speed, 0.0, 0.0};
    Vec3<double> f;
    Spring::force(spring, &d, &u, &f, true);
    CHECK(f.y == 0.0);
    CHECK(f.z == 0.0);
    return f.x;
}

}  // namespace

TEST_CASE_TEMPLATE("springs and joints pass the checks of every law", Setup, SpringSetup, JointSetup) {
    LawChecks<Setup>::check_energy_gradient();
    LawChecks<Setup>::check_dissipation();
    LawChecks<Setup>::check_derivative_product();
    LawChecks<Setup>::check_bounds();
    LawChecks<Setup>::template check_lanes<double>();
    LawChecks<Setup>::template check_lanes<float>();
    LawChecks<Setup>::check_torque(false);
}

TEST_CASE("the force of a spring is k (l - l0) + c l'") {
    check_close(axial_force(0.05, 0.0), 0.0, 1e-12, 1.0);
    check_close(axial_force(0.06, 0.0), -0.2, 1e-12);
    check_close(axial_force(0.03, 0.0), 0.4, 1e-12);
    check_close(axial_force(0.05, 2.0), -0.6, 1e-12);
    check_close(axial_force(0.06, -2.0), 0.4, 1e-12);
}

TEST_CASE("the energy of a spring is k (l - l0)^2 / 2") {
    const Vec3<double> d{0.0, 0.08, 0.0};
    check_close(Spring::energy(spring, &d), 0.5 * 20.0 * 0.03 * 0.03, 1e-12);
    const Spring::Params<double> absent{0.0, 0.0, 0.0};
    CHECK(Spring::energy(absent, &d) == 0.0);
}

TEST_CASE("damping of a spring ignores the transverse velocity") {
    CHECK(LawChecks<SpringSetup>::corners == 2);
    const Vec3<double> d{0.06, 0.0, 0.0}, u{0.0, 3.0, -4.0};
    CHECK(Spring::dissipation(spring, &d, &u) == 0.0);
    LawChecks<SpringSetup>::check_torque(true);
}

TEST_CASE("a spring between coincident ends has no force") {
    const Vec3<double> zero{}, u{1.0, 2.0, 3.0};
    Vec3<double> f;
    Spring::force(spring, &zero, &u, &f, true);
    CHECK(norm2(f) == 0.0);
    CHECK(Spring::dissipation(spring, &zero, &u) == 0.0);
}

TEST_CASE("the transverse stiffness of a collapsed spring is limited") {
    const Spring::Axis<double> axis = Spring::axis(spring, {1e-9, 0.0, 0.0});
    CHECK(axis.transverse == 2.0 * 20.0 * max_transverse_ratio);
    check_close(Spring::axis(spring, {0.05, 0.0, 0.0}).transverse, 0.0, 1e-12, 1.0);
}

TEST_CASE("the implicit matrix of a spring is its stiffness without compression") {
    const Vec3<double> d{0.1, 0.0, 0.0}, compressed{0.02, 0.0, 0.0}, zero{};
    const Sym3<double> stretched = Spring::matrix(spring, &d, 2.0, 3.0);
    check_close(stretched.xx, 2.0 * 20.0 + 3.0 * 0.3, 1e-12);
    check_close(stretched.yy, 2.0 * (20.0 - 1.0 / 0.1), 1e-12);
    CHECK(stretched.xy == 0.0);
    const Sym3<double> short_spring = Spring::matrix(spring, &compressed, 2.0, 3.0);
    check_close(short_spring.xx, 40.9, 1e-12);
    CHECK(short_spring.zz == 0.0);
    const Sym3<double> coincident = Spring::matrix(spring, &zero, 2.0, 3.0);
    for (const double diagonal : {coincident.xx, coincident.yy, coincident.zz}) check_close(diagonal, 40.0, 1e-12);
}

TEST_CASE("the force of a joint is -k s - c s'") {
    const Vec3<double> d{0.1, -0.2, 0.3}, u{1.0, 2.0, -1.0};
    Vec3<double> f;
    Joint::force(JointSetup::params<double>(), &d, &u, &f, true);
    check_close(f, {-2.3, 3.4, -5.7}, 1e-12);
}

}  // namespace cloth::tests
