// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Checks that every law of springs, hinges and panels passes, against difference quotients and its own energy.
#pragma once

#include "laws/bound.hpp"
#include "samples.hpp"

namespace cloth::tests {

using laws::Bound;

/// A law with parameters. Setup::params<V>() returns them as numbers V; Setup::shape(random) an element.
template <class Setup>
struct LawChecks {
    using Law = typename Setup::Law;
    static constexpr int corners = Law::corners, differences = corners - 1;
    static constexpr bool absolute = Law::absolute_velocities;
    /// Velocities that a law reads, and forces that it returns.
    static constexpr int velocities = absolute ? corners : differences;
    static constexpr double quotient_step = 1e-6;
    static constexpr int rounds = 100;

    /// Differences of positions to the first corner [m], and velocities of all corners [m/s].
    template <class V>
    struct Element {
        Vec3<V> d[differences], u[velocities];
    };

    template <class V>
    static void add_force(const Element<V>& e, bool damped, Vec3<V>* f) {
        Law::force(Setup::template params<V>(), e.d, e.u, f, damped);
    }

    /// A random element, and a direction in which it moves.
    static Element<double> element(Random& random) {
        Element<double> e;
        Setup::shape(random, e.d);
        for (Vec3<double>& u : e.u) u = random.vector();
        return e;
    }
    /// An element `by` times a direction further.
    static Element<double> moved(const Element<double>& e, double by, const Element<double>& direction) {
        Element<double> m = e;
        for (int i = 0; i < differences; ++i) m.d[i] = fma(by, direction.d[i], e.d[i]);
        for (int i = 0; i < velocities; ++i) m.u[i] = fma(by, direction.u[i], e.u[i]);
        return m;
    }
    static Element<double> random_direction(Random& random) {
        Element<double> e;
        for (Vec3<double>& d : e.d) d = random.vector();
        for (Vec3<double>& u : e.u) u = random.vector();
        return e;
    }
    static Element<Dual> dual_element(const Element<double>& e, const Element<double>& direction) {
        Element<Dual> r;
        for (int i = 0; i < differences; ++i) r.d[i] = dual(e.d[i], direction.d[i]);
        for (int i = 0; i < velocities; ++i) r.u[i] = dual(e.u[i], direction.u[i]);
        return r;
    }
    static double energy(const Element<double>& e) { return Law::energy(Setup::template params<double>(), e.d); }

    /// Force = -gradient of the energy.
    static void check_energy_gradient() {
        Random random;
        for (int round = 0; round < rounds; ++round) {
            const Element<double> e = element(random), direction = random_direction(random);
            Vec3<double> f[velocities];
            add_force(e, false, f);
            double power = 0.0;
            for (int i = 0; i < differences; ++i) power += dot(f[i], direction.d[i]);
            const double slope = Law::energy(Setup::template params<Dual>(), dual_element(e, direction).d).slope;
            check_close(slope, -power, 1e-9, 1.0);
            const double difference =
                energy(moved(e, quotient_step, direction)) - energy(moved(e, -quotient_step, direction));
            check_close(difference / (2.0 * quotient_step), -power, 1e-5, 1.0);
        }
    }
    /// Power of the damping force = -dissipation, which is never negative.
    static void check_dissipation() {
        Random random;
        for (int round = 0; round < rounds; ++round) {
            const Element<double> e = element(random);
            Vec3<double> elastic[velocities], all[velocities];
            add_force(e, false, elastic);
            add_force(e, true, all);
            double power = 0.0;
            for (int i = 0; i < velocities; ++i) power += dot(all[i] - elastic[i], e.u[i]);
            const double dissipation = Law::dissipation(Setup::template params<double>(), e.d, e.u);
            CHECK(dissipation >= 0.0);
            check_close(dissipation, -power, 1e-9, 1e-3);
        }
    }
    /// The force of dual numbers has the derivative as its slope.
    static void check_derivative_product() {
        Random random;
        for (int round = 0; round < rounds; ++round) {
            const Element<double> e = element(random), direction = random_direction(random);
            Vec3<Dual> product[velocities];
            add_force(dual_element(e, direction), true, product);
            Vec3<double> before[velocities], after[velocities];
            add_force(moved(e, -quotient_step, direction), true, before);
            add_force(moved(e, quotient_step, direction), true, after);
            for (int i = 0; i < velocities; ++i)
                check_close(slope_of(product[i]), (0.5 / quotient_step) * (after[i] - before[i]), 1e-5, 1e-3);
        }
    }
    /// The quadratic forms of stiffness and damping are below those of the bounds.
    static void check_bounds() {
        const auto params = Setup::template params<double>();
        Random random;
        for (int round = 0; round < rounds; ++round) {
            const Element<double> e = element(random);
            Bound<double> bounds[corners];
            Law::bounds(params, e.d, bounds);
            for (int attempt = 0; attempt < 20; ++attempt) {
                // Motion of each corner.
                Vec3<double> a[corners];
                for (Vec3<double>& corner : a) corner = random.vector();
                const Forms forms = quadratic_forms(e, a);
                double stiffness = 0.0, damping = 0.0;
                for (int i = 0; i < corners; ++i) {
                    stiffness += product(bounds[i].stiff, a[i]) + bounds[i].isotropic * norm2(a[i]);
                    damping += product(bounds[i].damp, a[i]);
                }
                CHECK(forms.stiffness <= stiffness * (1.0 + 1e-12) + 1e-12);
                CHECK(forms.damping <= damping * (1.0 + 1e-12) + 1e-12);
            }
        }
    }
    /// Each lane has the bits of numbers.
    template <class T>
    static void check_lanes() {
        using V = vec<T>;
        Random random;
        for (int round = 0; round < 20; ++round) {
            Element<V> all;
            Element<T> single[lanes<T>];
            for (int k = 0; k < lanes<T>; ++k) {
                const Element<double> e = element(random);
                for (int i = 0; i < differences; ++i) set_lane(all.d[i], k, single[k].d[i] = splat3<T>(e.d[i]));
                for (int i = 0; i < velocities; ++i) set_lane(all.u[i], k, single[k].u[i] = splat3<T>(e.u[i]));
            }
            for (const bool damped : {false, true}) {
                Vec3<V> f[velocities];
                add_force(all, damped, f);
                for (int k = 0; k < lanes<T>; ++k) {
                    Vec3<T> expected[velocities];
                    add_force(single[k], damped, expected);
                    for (int i = 0; i < velocities; ++i) {
                        CHECK(has_same_bits<T>(f[i].x[k], expected[i].x));
                        CHECK(has_same_bits<T>(f[i].y[k], expected[i].y));
                        CHECK(has_same_bits<T>(f[i].z[k], expected[i].z));
                    }
                }
            }
            const auto params = Setup::template params<V>();
            const auto params1 = Setup::template params<T>();
            const V energies = Law::energy(params, all.d), dissipations = Law::dissipation(params, all.d, all.u);
            for (int k = 0; k < lanes<T>; ++k) {
                CHECK(has_same_bits<T>(energies[k], Law::energy(params1, single[k].d)));
                CHECK(has_same_bits<T>(dissipations[k], Law::dissipation(params1, single[k].d, single[k].u)));
            }
        }
    }
    /// The elastic forces of an element have no torque.
    static void check_torque(bool damped) {
        Random random;
        for (int round = 0; round < rounds; ++round) {
            const Element<double> e = element(random);
            Vec3<double> f[velocities], torque{};
            add_force(e, damped, f);
            for (int i = 0; i < differences; ++i) torque = torque + cross(e.d[i], f[i]);
            check_close(torque, {}, 1e-9, 1.0);
        }
    }

private:
    struct Forms {
        double stiffness, damping;
    };
    /// -a' dF for a motion a of the corners, by positions and by velocities.
    static Forms quadratic_forms(const Element<double>& e, const Vec3<double>* a) {
        Element<double> positions{}, speeds{};
        for (int i = 0; i < differences; ++i) positions.d[i] = a[i + 1] - a[0];
        for (int i = 0; i < velocities; ++i) speeds.u[i] = absolute ? a[i] : a[i + 1] - a[0];
        Element<double> resting = e;
        for (Vec3<double>& u : resting.u) u = {};
        Vec3<Dual> by_position[velocities], by_speed[velocities];
        add_force(dual_element(resting, positions), true, by_position);
        add_force(dual_element(resting, speeds), true, by_speed);
        Forms r{};
        for (int i = 0; i < velocities; ++i) {
            r.stiffness -= dot(slope_of(by_position[i]), speeds.u[i]);
            r.damping -= dot(slope_of(by_speed[i]), speeds.u[i]);
        }
        return r;
    }
    static double product(const Sym3<double>& m, Vec3<double> a) {
        return m.xx * a.x * a.x + m.yy * a.y * a.y + m.zz * a.z * a.z +
               2.0 * (m.xy * a.x * a.y + m.xz * a.x * a.z + m.yz * a.y * a.z);
    }
    template <class T>
    static void set_lane(Vec3<vec<T>>& all, int k, Vec3<T> a) {
        all.x[k] = a.x, all.y[k] = a.y, all.z[k] = a.z;
    }
};

}  // namespace cloth::tests
