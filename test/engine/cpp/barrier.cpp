// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of the contact barrier.
#include "laws/contact.hpp"

#include <algorithm>

#include "samples.hpp"

namespace cloth::tests {

using namespace laws;

namespace {

constexpr double thickness = 0.004, damping = 0.05;
const ContactLaw<double> barrier(thickness, damping);
const ContactLaw<Dual> dual_barrier(thickness, damping);

/// A gap from a thousandth of the thickness to all of it.
double random_gap(Random& random) { return thickness * random.uniform(0.001, 1.0); }

}  // namespace

TEST_CASE("the push of the barrier is minus the gradient of its energy") {
    Random random;
    for (int round = 0; round < 200; ++round) {
        const double gap = random_gap(random), step = 1e-6 * gap;
        check_close(-dual_barrier.energy({gap, 1.0}).slope, barrier.elastic(gap), 1e-10);
        check_close((barrier.energy(gap - step) - barrier.energy(gap + step)) / (2.0 * step), barrier.elastic(gap),
                    1e-6, 1.0);
        check_close(barrier.push(gap, 0.0), barrier.elastic(gap), 1e-13);
        const auto both = barrier.force(gap, 1.0);
        check_close(both.elastic, barrier.elastic(gap), 1e-13);
        check_close(both.shape, barrier.shape(gap), 1e-13);
    }
}

TEST_CASE("the stiffness of the barrier is the derivative of its push") {
    Random random;
    for (int round = 0; round < 200; ++round) {
        const double gap = random_gap(random);
        check_close(-dual_barrier.elastic({gap, 1.0}).slope, barrier.stiffness(gap), 1e-9, 1.0);
    }
}

TEST_CASE("the energy of the barrier is U^2 (1 - s)^4 / (2 s)") {
    check_close(barrier.energy(0.5 * thickness), 0.5 * 35.0 * 35.0 * 0.125, 1e-13);
    check_close(barrier.shape(0.25 * thickness), 0.75 * 0.75 * 0.75 * 0.75 / 0.25, 1e-13);
}

TEST_CASE("the barrier has no force from its thickness on, and none that is finite at zero") {
    for (const double gap : {thickness, 1.5 * thickness, 1.0}) {
        CHECK(barrier.push(gap, 1.0) == 0.0);
        CHECK(barrier.energy(gap) == 0.0);
        CHECK(barrier.stiffness(gap) == 0.0);
    }
    CHECK_FALSE(std::isfinite(barrier.energy(0.0)));
    CHECK_FALSE(std::isfinite(barrier.elastic(0.0)));
}

TEST_CASE("damping of the barrier dissipates and never pulls") {
    Random random;
    for (int round = 0; round < 500; ++round) {
        const double gap = random_gap(random), closing = random.uniform(-50.0, 50.0);
        const auto both = barrier.force(gap, closing);
        CHECK(both.push >= 0.0);
        CHECK((both.push - both.elastic) * closing >= 0.0);
    }
}

TEST_CASE("the damping rate up to an energy bounds the slope at all gaps and speeds of that energy") {
    Random random;
    const double speed = ContactLaw<double>::speed;
    for (const double coefficient : {0.05, 1.0, 10.0, 100.0}) {
        const ContactLaw<double> law(thickness, coefficient);
        const ContactLaw<Dual> dual_law(thickness, coefficient);
        const auto slope = [&](double s, double closing) {
            return dual_law.push({s * thickness, 0.0}, {closing, 1.0}).slope;
        };
        for (const double b : {1e-7, 1e-5, 1e-3, 0.1, 3.0}) {
            const double speed_limit = speed * random.uniform(0.0, 0.3), start = stopping_gap(b);
            const double by_energy = damping_at_energy(law, b),
                         by_speed = law.damping_up_to(b, [&](double) { return speed_limit; });
            double largest_by_energy = 0.0, largest_by_speed = 0.0;
            for (int round = 0; round < 2000; ++round) {
                const double s = start + (1.0 - start) * random.uniform(1e-6, 1.0);
                const double available = speed * std::sqrt(std::max(b - law.shape(s * thickness), 0.0));
                largest_by_energy = std::max({largest_by_energy, slope(s, available), slope(s, -available)});
                largest_by_speed = std::max({largest_by_speed, slope(s, speed_limit), slope(s, 0.0)});
            }
            CHECK(largest_by_energy <= by_energy * (1.0 + 1e-9));
            CHECK(largest_by_speed <= by_speed * (1.0 + 1e-9));
            CHECK(largest_by_energy >= 0.85 * by_energy);
            CHECK(largest_by_speed >= 0.85 * by_speed);
            CHECK(by_energy <= law.damping(start * thickness));
        }
    }
    CHECK(damping_at_energy(ContactLaw<double>(thickness, 0.0), 0.1) == 0.0);
}

TEST_CASE("the damping rate of the barrier bounds the slope with respect to speed") {
    Random random;
    for (int round = 0; round < 500; ++round) {
        const double gap = random_gap(random), rate = barrier.damping(gap);
        for (const double closing : {-30.0, -1.0, 0.0, 1.0, 30.0, 1000.0})
            CHECK(dual_barrier.push({gap, 0.0}, {closing, 1.0}).slope <= rate * (1.0 + 1e-12));
        // It is reached in the limit of fast approach.
        CHECK(dual_barrier.push({gap, 0.0}, {1e12, 1.0}).slope >= 0.99 * rate);
    }
}

TEST_CASE_TEMPLATE("lanes of the barrier have the bits of numbers", T, double, float) {
    const ContactLaw<vec<T>> law(thickness, damping);
    const ContactLaw<T> scalar_law(thickness, damping);
    Random random;
    for (int round = 0; round < 50; ++round) {
        vec<T> gap{}, closing{};
        for (int k = 0; k < lanes<T>; ++k) {
            gap[k] = static_cast<T>(1.1 * random_gap(random));
            closing[k] = static_cast<T>(random.uniform(-20.0, 20.0));
        }
        const auto all = law.force(gap, closing);
        const vec<T> stiffness = law.stiffness(gap), rate = law.damping(gap);
        for (int k = 0; k < lanes<T>; ++k) {
            const auto expected = scalar_law.force(gap[k], closing[k]);
            CHECK(has_same_bits<T>(all.push[k], expected.push));
            CHECK(has_same_bits<T>(all.elastic[k], expected.elastic));
            CHECK(has_same_bits<T>(all.shape[k], expected.shape));
            CHECK(has_same_bits<T>(stiffness[k], scalar_law.stiffness(gap[k])));
            CHECK(has_same_bits<T>(rate[k], scalar_law.damping(gap[k])));
        }
    }
}

TEST_CASE("a scaled contact has the rates of the full thickness") {
    const double scale = 2.0, growth = 3.0, gap = 0.0007;
    const Scaling<double> reduced{scale, growth};
    CHECK(reduced.gap(gap) == scale * gap);
    check_close(reduced.closing(gap, -0.4), scale * (growth * gap - 0.4), 1e-14);
    const auto full = full_thickness<double>();
    CHECK(full.gap(gap) == gap);
    CHECK(full.closing(gap, -0.4) == -0.4);
    // The acceleration divided by the scale is the law of thickness d / scale with the barrier speed U / scale.
    const Dual product = dual_barrier.elastic(Scaling<Dual>{{scale, 0.0}, {0.0, 0.0}}.gap({gap, 1.0}));
    check_close(-product.slope / scale, barrier.stiffness(scale * gap), 1e-12);
}

TEST_CASE("the stopping gap approaches the gap of its energy from below") {
    for (const double b : {1e-6, 1e-3, 0.1, 1.0, 4.0, 100.0}) {
        const double s = stopping_gap(b);
        CHECK(s > 0.0);
        CHECK(s < 1.0);
        check_close(barrier.shape(s * thickness), b, 1e-9);
        CHECK(std::pow(1.0 - s, 4) - b * s >= -1e-15);
    }
    CHECK(stopping_gap(1e9) < 1e-8);
}

}  // namespace cloth::tests
