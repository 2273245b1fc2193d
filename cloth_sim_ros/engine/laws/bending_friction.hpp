// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Internal friction of bending: an elasto-plastic spring on the signed length of a hinge.
// docs/derivations/bending_friction.md derives it.
#pragma once

#include "laws/hinge.hpp"

namespace cloth::laws {

/// Spring of S8's signed length h about a plastic length h_p, with at most the tension k reach: the tension is
/// -k e with the deflection e = h - h_p, cut to -reach ... reach. Beyond that the plastic length follows h. It is part
/// of the state; a force evaluation does not change it. The energy for a fixed h_p has the force as its gradient.
/// Damping: none.
struct BendingFriction {
    static constexpr int corners = 4, params = 3;
    static constexpr bool absolute_velocities = false;
    /// The first parameter is a state, which `drag` moves.
    static constexpr bool has_plastic_length = true;
    /// h_p [m], k [N/m], largest deflection [m].
    template <class V>
    struct Params {
        V plastic_length, k, reach;
    };

    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>*, Vec3<V>* f, bool) {
        const auto l = Crossed::length(d);
        const V deflection = smaller(larger(l.h - p.plastic_length, -p.reach), p.reach);
        const V tension = -(p.k * deflection);
        for (int i = 0; i < 3; ++i) f[i] = tension * l.gradient[i];
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        const V size = absolute(Crossed::length(d).h - p.plastic_length), elastic = smaller(size, p.reach);
        return p.k * elastic * (size - splat<V>(0.5) * elastic);
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>&, const Vec3<V>*, const Vec3<V>*) {
        return V{};
    }
    /// Those of a hinge at the largest tension: they hold for every plastic length.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>* d, Bound<V>* b) {
        const V h = Crossed::length(d).h;
        Crossed::bounds(Crossed::Params<V>{h + p.reach, p.k, V{}}, d, b);
    }
    /// Plastic length after the velocities u have acted for a time from d on: h is then within the reach again.
    template <class V>
    static CLOTH_INLINE V drag(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, V time) {
        const auto l = Crossed::length(d);
        const V rate = dot(l.gradient[0], u[0]) + dot(l.gradient[1], u[1]) + dot(l.gradient[2], u[2]);
        return returned(p, fma(time, rate, l.h));
    }
    /// Plastic length with which a signed length is within the reach: the same one if it is already.
    template <class V>
    static CLOTH_INLINE V returned(const Params<V>& p, V h) {
        const V deflection = h - p.plastic_length;
        return select(deflection > p.reach, h - p.reach, select(deflection < -p.reach, h + p.reach, p.plastic_length));
    }
    /// What runs may miss at a kink: a jump of the tension's rate [N/s], and the tension [N] by a plastic length.
    struct Kink {
        double jump = 0.0, tension = 0.0;
    };
    /// Kinks within a step [s] after the start, and before the end, of an interval of a duration [s]. Signed lengths, their
    /// rates and plastic lengths at both ends are known. A hinge that yields from half a step before to half a step after
    /// has no kink. One that turns round while it yields within half a step, at the rate c in a step, moves its plastic
    /// length by up to c step / 8, which no run samples; it counts twice.
    static void kinks(const Params<double>& p, const double (&h)[2], const double (&rate)[2],
                      const double (&plastic)[2], double duration, double step, Kink (&kink)[2]) {
        const double change = absolute(rate[1] - rate[0]) / duration * step;
        const bool yields_long = absolute(plastic[1] - plastic[0]) > absolute(rate[1]) * step;
        for (int end = 0; end < 2; ++end) {
            const double deflection = h[end] - plastic[end], speed = absolute(rate[end]) + change,
                         left = p.reach - absolute(deflection), outward = deflection < 0.0 ? -rate[end] : rate[end];
            const bool yields = left <= 1e-6 * p.reach && outward > change && (end == 0 || yields_long);
            kink[end].jump = left <= speed * step && !yields ? p.k * speed : 0.0;
            const bool turns = left <= 1e-6 * p.reach + change * step && absolute(rate[end]) <= 2.0 * change;
            kink[end].tension = turns ? p.k * (0.25 * change * step) : 0.0;
        }
    }
    /// Energy [J] that a change of the plastic length dissipates.
    template <class V>
    static CLOTH_INLINE V plastic_work(const Params<V>& p, V next) {
        return p.k * p.reach * absolute(next - p.plastic_length);
    }
};

}  // namespace cloth::laws
