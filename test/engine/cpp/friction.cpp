// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of Coulomb friction by an anchor spring.
#include "laws/friction.hpp"

#include "samples.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

constexpr FrictionCoefficients coefficients{0.6, 0.4};
constexpr double frequency = 200.0, stiffness = frequency * frequency, push = 50.0;
constexpr double rate = FrictionLaw<double>::damping_per_frequency * frequency;
const FrictionLaw<double> friction(coefficients, frequency);
const Vec3<double> normal{0.0, 0.6, 0.8};

/// A random contact: offset from the anchor [m], normal, relative velocity [m/s] and push [m/s^2].
struct RandomContact {
    Vec3<double> offset, normal, slip;
    double push;

    explicit RandomContact(Random& random) {
        const Vec3<double> direction = random.vector();
        normal = inverse_root(norm2(direction)) * direction;
        offset = 2e-3 * random.vector();
        slip = std::pow(10.0, random.uniform(-4.0, 0.0)) * random.vector();
        push = random.uniform(0.0, 100.0);
    }
};

}  // namespace

TEST_CASE("a contact within the cone sticks to a damped spring") {
    // Both are tangential.
    const Vec3<double> offset{1e-4, 8e-5, -6e-5}, slip{2e-3, -4e-3, 3e-3};
    const auto force = friction.force(offset, normal, slip, push);
    CHECK_FALSE(force.slides);
    check_close(force.push, -(stiffness * offset + rate * slip), 1e-12);
    check_close(force.stretch, offset, 1e-12);
    check_close(force.energy, 0.5 * stiffness * norm2(offset), 1e-12);
    check_close(force.dissipation, rate * norm2(slip), 1e-12);
}

TEST_CASE("a contact beyond the cone slides with the kinetic coefficient") {
    const Vec3<double> offset{0.01, 0.0, 0.0}, slip{1.0, 0.0, 0.0};
    const auto force = friction.force(offset, normal, slip, push);
    CHECK(force.slides);
    check_close(force.push, {-0.4 * push, 0.0, 0.0}, 1e-12);
    check_close(force.stretch, {0.4 * push / stiffness, 0.0, 0.0}, 1e-12);
    check_close(force.dissipation, 0.4 * push, 1e-12);
    check_close(force.energy, 0.4 * push * (0.01 - 0.5 * 0.4 * push / stiffness), 1e-12);
}

TEST_CASE("a slow contact slides with the static coefficient") {
    const Vec3<double> offset{0.01, 0.0, 0.0};
    for (const double speed : {0.0, 0.5 * FrictionLaw<double>::stribeck_speed}) {
        const auto force = friction.force(offset, normal, {0.0, 0.8 * speed, -0.6 * speed}, push);
        check_close(std::sqrt(norm2(force.push)), 0.6 * push, 1e-9);
    }
}

TEST_CASE("friction is tangential, stays in the static cone and dissipates") {
    Random random;
    for (int round = 0; round < 1000; ++round) {
        const RandomContact c(random);
        const auto force = friction.force(c.offset, c.normal, c.slip, c.push);
        const double strength = std::sqrt(norm2(force.push));
        CHECK(std::abs(dot(force.push, c.normal)) <= 1e-12 * (strength + 1.0));
        CHECK(strength <= 0.6 * c.push * (1.0 + 1e-9));
        // A contact beyond the cone that returns gets energy back from the anchor spring.
        if (!force.slides || dot(force.stretch, c.slip) >= 0.0) CHECK(force.dissipation >= -1e-12 * (1.0 + strength));
        CHECK(force.energy >= 0.0);
        CHECK(stiffness * std::sqrt(norm2(force.stretch)) <= 0.6 * c.push * (1.0 + 1e-9));
    }
}

TEST_CASE("friction at rest is minus the gradient of its energy") {
    Random random;
    int sliding = 0;
    for (int round = 0; round < 200; ++round) {
        const RandomContact c(random);
        const auto force = friction.force(c.offset, c.normal, {}, c.push);
        const Vec3<double> direction = random.vector();
        const auto energy = [&](double t) {
            return friction.force(fma(t, direction, c.offset), c.normal, {}, c.push).energy;
        };
        check_close((energy(-1e-8) - energy(1e-8)) / 2e-8, dot(force.push, direction), 1e-4, 0.1);
        sliding += force.slides ? 1 : 0;
    }
    CHECK(sliding > 20);
    CHECK(sliding < 180);
}

TEST_CASE("friction without push is zero") {
    const auto force = friction.force({1e-4, 0.0, 0.0}, normal, {1.0, 0.0, 0.0}, 0.0);
    CHECK(norm2(force.push) == 0.0);
    CHECK(norm2(force.stretch) == 0.0);
    CHECK(force.energy == 0.0);
}

TEST_CASE("the force of dual numbers has the derivative as its slope") {
    const FrictionLaw<Dual> law(coefficients, frequency);
    Random random;
    constexpr double step = 1e-9;
    for (int round = 0; round < 200; ++round) {
        const RandomContact c(random);
        const Vec3<double> position = random.vector(), velocity = random.vector();
        const auto at = [&](double t) {
            return friction.force(fma(t, position, c.offset), c.normal, fma(t, velocity, c.slip), c.push);
        };
        const auto before = at(-step), after = at(step);
        // The slope jumps at the edge of the cone.
        if (before.slides != after.slides) continue;
        const auto product =
            law.force(dual(c.offset, position), splat3<Dual>(c.normal), dual(c.slip, velocity), splat<Dual>(c.push));
        check_close(slope_of(product.push), (0.5 / step) * (after.push - before.push), 1e-3, 1.0);
    }
}

TEST_CASE("lanes of friction have the bits of numbers") {
    using V = vec<double>;
    const FrictionLaw<V> law(coefficients, frequency);
    Random random;
    for (int round = 0; round < 100; ++round) {
        Vec3<V> offset{}, normals{}, slip{};
        V pushes{};
        for (int k = 0; k < lanes<double>; ++k) {
            const RandomContact c(random);
            offset.x[k] = c.offset.x, offset.y[k] = c.offset.y, offset.z[k] = c.offset.z;
            normals.x[k] = c.normal.x, normals.y[k] = c.normal.y, normals.z[k] = c.normal.z;
            slip.x[k] = c.slip.x, slip.y[k] = c.slip.y, slip.z[k] = c.slip.z;
            pushes[k] = c.push;
        }
        const auto all = law.force(offset, normals, slip, pushes);
        for (int k = 0; k < lanes<double>; ++k) {
            const auto expected = friction.force(lane(offset, k), lane(normals, k), lane(slip, k), pushes[k]);
            CHECK(has_same_bits<double>(all.push.x[k], expected.push.x));
            CHECK(has_same_bits<double>(all.push.y[k], expected.push.y));
            CHECK(has_same_bits<double>(all.push.z[k], expected.push.z));
            CHECK(has_same_bits<double>(all.energy[k], expected.energy));
            CHECK(has_same_bits<double>(all.dissipation[k], expected.dissipation));
            CHECK((all.slides[k] != 0) == expected.slides);
        }
    }
}

}  // namespace cloth::tests
