// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of panels: drag of the air.
#include "laws/panel.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// c_n = 1.5 N s/m^3, c_t = 0.2 N s/m^3, in still air or in a wind.
template <int Corners, bool Windy = false>
struct PanelSetup {
    using Law = Panel<Corners>;
    template <class V>
    static typename Law::template Params<V> params() {
        using T = scalar<V>;
        const Vec3<double> wind = Windy ? Vec3<double>{2.0, -1.0, 3.0} : Vec3<double>{};
        return {splat<V>(T(1.5)), splat<V>(T(0.2)), splat3<V>(wind)};
    }
    /// Corners in order around a square of about 0.1 m.
    static void shape(Random& random, Vec3<double>* d) {
        const Vec3<double> square[3] = {{0.1, 0.0, 0.0}, {0.1, 0.1, 0.0}, {0.0, 0.1, 0.0}};
        for (int i = 0; i < Corners - 1; ++i) d[i] = square[i] + 0.03 * random.vector();
    }
};

/// Total force on a square of 0.1 m normal to z, in still air, with all corners at one velocity.
template <int Corners>
Vec3<double> drag(Vec3<double> velocity) {
    using Law = Panel<Corners>;
    const Vec3<double> d[3] = {{0.1, 0.0, 0.0}, {0.1, 0.1, 0.0}, {0.0, 0.1, 0.0}};
    Vec3<double> u[Corners], f[Corners], total{};
    for (Vec3<double>& corner : u) corner = velocity;
    Law::force(PanelSetup<Corners>::template params<double>(), d, u, f, true);
    for (const Vec3<double>& corner : f) total = total + corner;
    return total;
}

}  // namespace

TEST_CASE_TEMPLATE("panels in still air pass the checks of every law", Setup, PanelSetup<3>, PanelSetup<4>) {
    using Checks = LawChecks<Setup>;
    Random random;
    for (int round = 0; round < Checks::rounds; ++round) {
        const auto e = Checks::element(random);
        Vec3<double> f[Checks::corners];
        Checks::add_force(e, true, f);
        double power = 0.0;
        for (int i = 0; i < Checks::corners; ++i) power += dot(f[i], e.u[i]);
        const double dissipation = Setup::Law::dissipation(Setup::template params<double>(), e.d, e.u);
        CHECK(dissipation >= 0.0);
        check_close(dissipation, -power, 1e-12, 1e-6);
        CHECK(Setup::Law::energy(Setup::template params<double>(), e.d) == 0.0);
    }
    Checks::check_derivative_product();
    Checks::check_bounds();
    Checks::template check_lanes<double>();
    Checks::template check_lanes<float>();
}

TEST_CASE_TEMPLATE("the bounds of panels in a wind are bounds", Setup, PanelSetup<3, true>, PanelSetup<4, true>) {
    LawChecks<Setup>::check_derivative_product();
    LawChecks<Setup>::check_bounds();
}

TEST_CASE("the drag of a panel is c A u along its normal and its surface") {
    check_close(drag<4>({0.0, 0.0, 2.0}), {0.0, 0.0, -1.5 * 0.01 * 2.0}, 1e-12);
    check_close(drag<4>({2.0, 0.0, 0.0}), {-0.2 * 0.01 * 2.0, 0.0, 0.0}, 1e-12);
    check_close(drag<3>({0.0, 3.0, -2.0}), {0.0, -0.2 * 0.005 * 3.0, 1.5 * 0.005 * 2.0}, 1e-12);
}

TEST_CASE_TEMPLATE("dissipation less the wind's power is the power of the force", Setup, PanelSetup<3, true>,
                   PanelSetup<4, true>) {
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
        check_close(Law::external_power(params, e.d, e.u) - Law::dissipation(params, e.d, e.u), power, 1e-12, 1e-3);
    }
}

TEST_CASE("a panel that moves with the wind or has no area has no force") {
    using Law = Panel<3>;
    const auto params = PanelSetup<3, true>::params<double>();
    const Vec3<double> d[2] = {{0.1, 0.0, 0.0}, {0.0, 0.1, 0.05}}, collinear[2] = {{0.1, 0.0, 0.0}, {0.3, 0.0, 0.0}};
    const Vec3<double> with_wind[3] = {params.wind, params.wind, params.wind}, resting[3] = {};
    Vec3<double> f[3];
    Law::force(params, d, with_wind, f, true);
    for (const Vec3<double>& corner : f) CHECK(norm2(corner) == 0.0);
    Law::force(params, collinear, resting, f, true);
    for (const Vec3<double>& corner : f) CHECK(norm2(corner) == 0.0);
}

}  // namespace cloth::tests
