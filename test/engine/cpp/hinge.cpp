// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Laws of hinges: signed length of two triangles with a common edge.
#include "laws/hinge.hpp"

#include "law_checks.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

/// A hinge of rest length 0.01 m, 3 N/m and 0.2 N s/m on two triangles of edges of about 0.1 m.
template <class Hinged>
struct HingeSetup {
    using Law = Hinged;
    template <class V>
    static typename Hinged::template Params<V> params() {
        using T = scalar<V>;
        return {splat<V>(T(0.01)), splat<V>(T(3.0)), splat<V>(T(0.2))};
    }
    /// An edge along y, and wings on both sides of it.
    static void shape(Random& random, Vec3<double>* d) {
        d[0] = Vec3<double>{0.0, 0.1, 0.0} + 0.02 * random.vector();
        d[1] = Vec3<double>{-0.1, 0.05, 0.0} + 0.04 * random.vector();
        d[2] = Vec3<double>{0.1, 0.05, 0.0} + 0.04 * random.vector();
    }
};

using Both = HingeSetup<Crossed>;

/// Signed length of wings at a height [m] beside an edge of 0.1 m.
template <class Hinged>
double signed_length(double height) {
    const Vec3<double> d[3] = {{0.0, 0.1, 0.0}, {-0.1, 0.05, height}, {0.1, 0.05, height}};
    return Hinged::template length<double>(d).h;
}

}  // namespace

TEST_CASE_TEMPLATE("hinges pass the checks of every law", Setup, HingeSetup<Crossed>, HingeSetup<Altitude>,
                   HingeSetup<EdgeEdge>, HingeSetup<PointFace>) {
    LawChecks<Setup>::check_energy_gradient();
    LawChecks<Setup>::check_dissipation();
    LawChecks<Setup>::check_derivative_product();
    LawChecks<Setup>::check_bounds();
    LawChecks<Setup>::template check_lanes<double>();
    LawChecks<Setup>::template check_lanes<float>();
    LawChecks<Setup>::check_torque(false);
    LawChecks<Setup>::check_torque(true);
}

TEST_CASE_TEMPLATE("the signed length of a flat hinge is zero and changes sign with the fold", Law, Crossed, Altitude,
                   EdgeEdge, PointFace) {
    CHECK(signed_length<Law>(0.0) == 0.0);
    CHECK(signed_length<Law>(0.01) * signed_length<Law>(-0.01) < 0.0);
    CHECK(signed_length<Law>(0.01) == -signed_length<Law>(-0.01));
}

TEST_CASE("the signed length of crossed lines is the distance of edge and line") {
    // The shared edge and the line of the wings are orthogonal: M^2 has a second term, (parallel |a|^2)^2.
    const double edge = 0.1, span = 0.2, second = CrossedAreas::parallel * edge * edge;
    const double area = std::sqrt(edge * edge * span * span + second * second);
    check_close(std::abs(signed_length<Crossed>(0.03)), 0.03 * edge * span / area, 1e-12);
}

TEST_CASE("the signed length of altitudes is six volumes over the areas of the faces") {
    const Vec3<double> d[3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    // Three faces of |a x b| = 1, and one of sqrt(3).
    check_close(Altitude::length<double>(d).h, 1.0 / std::sqrt(6.0), 1e-14);
}

TEST_CASE("the candidates of a corner of a cube are distances of its lines and faces") {
    const Vec3<double> d[3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    check_close(EdgeEdge::length<double>(d).h, 1.0 / std::sqrt(2.0), 1e-14);
    check_close(PointFace::length<double>(d).h, 1.0, 1e-14);
}

TEST_CASE_TEMPLATE("the gradient of the signed length is its derivative", Law, Crossed, Altitude, EdgeEdge, PointFace) {
    Random random;
    for (int round = 0; round < 100; ++round) {
        Vec3<double> d[3], direction[3];
        Both::shape(random, d);
        Vec3<Dual> moving[3];
        double product = 0.0;
        const auto length = Law::template length<double>(d);
        for (int i = 0; i < 3; ++i) {
            direction[i] = random.vector();
            moving[i] = dual(d[i], direction[i]);
            product += dot(length.gradient[i], direction[i]);
        }
        check_close(Law::template length<Dual>(moving).h.slope, product, 1e-10, 1e-3);
    }
}

TEST_CASE("a hinge without an edge or folded shut has finite forces") {
    const Vec3<double> u[3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    // The wings meet, the wings are parallel to the edge, the edge has no length, all points coincide.
    const Vec3<double> shapes[][3] = {
        {{0.0, 0.1, 0.0}, {0.1, 0.05, 0.0}, {0.1, 0.05, 0.0}},
        {{0.0, 0.1, 0.0}, {0.1, 0.0, 0.0}, {0.1, 0.1, 0.0}},
        {{0.0, 0.0, 0.0}, {-0.1, 0.0, 0.0}, {0.1, 0.0, 0.0}},
        {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}},
    };
    for (const auto& d : shapes) {
        Vec3<double> crossed[3], altitude[3];
        Crossed::force(Both::params<double>(), d, u, crossed, true);
        Altitude::force(HingeSetup<Altitude>::params<double>(), d, u, altitude, true);
        for (int i = 0; i < 3; ++i) {
            CHECK(std::isfinite(norm2(crossed[i])));
            CHECK(std::isfinite(norm2(altitude[i])));
        }
    }
    const Vec3<double>* const collapsed = shapes[3];
    CHECK(Crossed::energy(Both::params<double>(), collapsed) == 0.0);
    CHECK(Altitude::energy(HingeSetup<Altitude>::params<double>(), collapsed) == 0.0);
}

}  // namespace cloth::tests
