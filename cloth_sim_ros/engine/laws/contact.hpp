// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact barrier: acceleration of cloth away from a surface at a gap, per mass, so that it does not depend on the
// mesh. docs/derivations/contact_law.md derives it.
#pragma once

#include "laws/scaling.hpp"

namespace cloth::laws {

/// Energy per mass U^2/2 b(s), b = (1 - s)^4 / s, s = gap / thickness d. It vanishes from the thickness on, where its
/// force is C^2, and diverges at gap zero. Acceleration a = U^2/(2 d) |b'|. Damping multiplies it by Q(u) at closing
/// speed w: Q = u/2 + sqrt(1 + u^2/4), u = kappa w / (1 + kappa a / gamma), gamma = U/(2 d). Q is smooth, above 1 while
/// the gap closes, below 1 while it opens, and never negative, so that nothing sticks. V is a number, a vector or a
/// Dual.
template <class V>
class ContactLaw {
public:
    /// U [m/s]: stops a cloth of this speed at s = 0.28, one of 20 m/s at 0.4.
    static constexpr double speed = 35.0;

    /// Thickness d [m] and damping kappa [s/m].
    ContactLaw(double thickness, double damping)
        : inverse_(of(1.0 / thickness)), strength_(of(0.5 * speed * speed / thickness)),
          half_damping_(of(0.5 * damping)), damping_speed_(of(damping * speed)),
          damping_scale_(of(0.5 * speed / thickness)) {}

    /// Accelerations [m/s^2] away from a surface, with and without damping, and b.
    struct ContactForce {
        V push, elastic, shape;
    };
    /// Evaluate at a gap [m] and a closing speed [m/s]. The result is not finite at gap zero.
    CLOTH_INLINE ContactForce force(V gap, V closing) const {
        const Terms t = terms(gap);
        const V inverse = unit() / (t.square * t.denominator), quotient = t.denominator * inverse;
        const V u = half_damping_ * closing * (t.square * t.square * inverse);
        const V elastic = strength_ * (t.n * quotient);
        return {elastic * (u + root(fma(u, u, unit()))), elastic, t.r * t.r * (t.r * t.r) * (t.s * quotient)};
    }
    CLOTH_INLINE V push(V gap, V closing) const { return force(gap, closing).push; }
    /// Acceleration without damping.
    CLOTH_INLINE V elastic(V gap) const {
        const Terms t = terms(gap);
        return strength_ * (t.n / t.square);
    }
    /// b: energy per mass in units of U^2/2.
    CLOTH_INLINE V shape(V gap) const {
        const Terms t = terms(gap);
        return t.r * t.r * (t.r * t.r) / t.s;
    }
    /// Energy per mass [m^2/s^2].
    CLOTH_INLINE V energy(V gap) const { return of(0.5 * speed * speed) * shape(gap); }
    /// Slope of the acceleration with respect to the gap, without sign: a squared frequency [1/s^2]. Evaluates b''
    /// without cancellation.
    CLOTH_INLINE V stiffness(V gap) const {
        const Terms t = terms(gap);
        const V two = of(2.0);
        return strength_ * inverse_ * (two * (t.r * t.r) * fma(fma(of(3.0), t.s, two), t.s, unit()) / (t.s * t.square));
    }
    /// Largest slope of the acceleration with respect to the closing speed: a damping rate [1/s].
    CLOTH_INLINE V damping(V gap) const {
        const Terms t = terms(gap);
        return damping_scale_ * (damping_speed_ * t.n / t.denominator);
    }
    /// Bound of this slope at all gaps that take at most the energy b, where `closing(b')` is the largest closing speed
    /// [m/s] at the energy b'. It must not decrease with the gap. The slope is damping(gap) (1 + v / sqrt(1 + v^2)) / 2,
    /// v = u / 2: its first factor decreases with the gap, its second one increases.
    template <class F>
    double damping_up_to(double b, F&& closing) const;

private:
    /// n = (1 - s)^3 (1 + 3 s) = s^2 |b'|, and s^2 + kappa U n.
    struct Terms {
        V s, r, n, square, denominator;
    };
    static CLOTH_INLINE V of(double a) { return splat<V>(scalar<V>(a)); }
    static CLOTH_INLINE V unit() { return of(1.0); }
    CLOTH_INLINE Terms terms(V gap) const {
        Terms t;
        t.s = larger(smaller(gap * inverse_, unit()), V{});
        t.r = unit() - t.s;
        t.n = t.r * t.r * t.r * fma(of(3.0), t.s, unit());
        t.square = t.s * t.s;
        t.denominator = fma(damping_speed_, t.n, t.square);
        return t;
    }

    V inverse_, strength_, half_damping_, damping_speed_, damping_scale_;
};

/// Gap over thickness at which the barrier is b, that is where it has absorbed b U^2/2 per mass. Never above the exact
/// value: Newton's iteration on the convex (1 - s)^4 - b s converges from below.
inline double stopping_gap(double b) {
    double s = 0.0;
    for (int k = 0; k < 64; ++k) {
        const double r = 1.0 - s, cube = r * r * r, residual = cube * r - b * s;
        if (!(residual > 0.0)) break;
        s += residual / (4.0 * cube + b);
    }
    return s;
}

template <class V>
template <class F>
double ContactLaw<V>::damping_up_to(double b, F&& closing) const {
    if (!(damping_speed_ > 0.0)) return 0.0;
    constexpr int intervals = 32;
    const double start = stopping_gap(b), width = (1.0 - start) / intervals, thickness = 1.0 / inverse_;
    double largest = 0.0;
    Terms from = terms(start * thickness);
    for (int k = 1; k <= intervals; ++k) {
        const Terms to = terms((start + k * width) * thickness);
        const double shape = to.r * to.r * (to.r * to.r) / to.s,
                     v = half_damping_ * closing(shape) * (to.square / to.denominator);
        largest = larger(damping_speed_ * from.n / from.denominator * (0.5 + 0.5 * v / root(fma(v, v, 1.0))), largest);
        from = to;
    }
    return damping_scale_ * largest;
}

/// The same for contacts that have the energy b in all: what the barrier does not have is motion.
inline double damping_at_energy(const ContactLaw<double>& law, double b) {
    return law.damping_up_to(b, [&](double shape) { return ContactLaw<double>::speed * root(larger(b - shape, 0.0)); });
}

}  // namespace cloth::laws
