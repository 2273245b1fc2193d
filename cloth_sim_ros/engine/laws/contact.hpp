// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// The law of contact: how a surface at a gap g pushes cloth away, per mass of cloth, so that nothing depends on the mesh.
// docs/contact.md derives it.
#pragma once

#include "core/algebra.hpp"

namespace cloth {

/// Energy per mass U^2/2 b(s), b = (1 - s)^4 / s, s = gap over thickness d: none from the thickness on, where its force is
/// C^2, and without limit at no gap. Its push is a = U^2/(2 d) |b'|. Damping makes it a Q(u) at a closing speed w,
/// Q = u/2 + sqrt(1 + u^2/4), u = kappa w / (1 + kappa a / gamma), gamma = U/(2 d): smooth, above a while the gap closes,
/// below it while it opens, and never negative, so that nothing sticks. V is a number, a vector or a Dual.
template <class V>
class ContactLaw {
public:
    /// U [m/s]: a cloth of this speed is stopped at s = 0.28, one of 20 m/s at 0.4.
    static constexpr double speed = 35.0;

    /// Thickness d [m] and damping kappa [s/m].
    ContactLaw(double thickness, double damping)
        : inverse_(of(1.0 / thickness)), strength_(of(0.5 * speed * speed / thickness)), half_damping_(of(0.5 * damping)),
          damping_speed_(of(damping * speed)), damping_scale_(of(0.5 * speed / thickness)) {}

    /// Accelerations [m/s^2] away from a surface, damping included and without it, and b.
    struct ContactForce {
        V push, elastic, shape;
    };
    /// At a gap [m] that closes at a speed [m/s]; nothing is finite at no gap.
    CLOTH_INLINE ContactForce force(V gap, V closing) const {
        const Terms t = terms(gap);
        const V inverse = unit() / (t.square * t.denominator), quotient = t.denominator * inverse;
        const V u = half_damping_ * closing * (t.square * t.square * inverse);
        const V elastic = strength_ * (t.n * quotient);
        return {elastic * (u + root(fma(u, u, unit()))), elastic, t.r * t.r * (t.r * t.r) * (t.s * quotient)};
    }
    CLOTH_INLINE V push(V gap, V closing) const { return force(gap, closing).push; }
    /// The same without damping.
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
    /// Slope of the push over the gap, without its sign: a squared frequency [1/s^2]. b'' without cancellation.
    CLOTH_INLINE V stiffness(V gap) const {
        const Terms t = terms(gap);
        const V two = of(2.0);
        return strength_ * inverse_ * (two * (t.r * t.r) * fma(fma(of(3.0), t.s, two), t.s, unit()) / (t.s * t.square));
    }
    /// Largest slope of the push over the closing speed: a damping rate [1/s].
    CLOTH_INLINE V damping(V gap) const {
        const Terms t = terms(gap);
        return damping_scale_ * (damping_speed_ * t.n / t.denominator);
    }

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

/// A contact of a reduced thickness d / scale, which grows at a relative rate `growth` [1/s]. It is the law of thickness d
/// at gaps and speeds `scale` times as large, with the push over `scale` and the energy over its square: so squared
/// frequencies and damping rates are those of thickness d. docs/contact.md derives it.
template <class V>
struct Scaling {
    V scale, growth;

    CLOTH_INLINE V gap(V gap) const { return scale * gap; }
    /// How fast that gap closes, by the motion at a speed [m/s] and by the growth.
    CLOTH_INLINE V closing(V gap, V speed) const { return scale * fma(growth, gap, speed); }
};
template <class V>
inline Scaling<V> full_thickness() {
    return {splat<V>(scalar<V>(1.0)), V{}};
}

/// Gap over thickness at which b is so large: where the law has taken up U^2/2 times that per mass. Never above the true
/// one: Newton's iteration on the convex (1 - s)^4 - b s comes from below.
inline double stopping_gap(double b) {
    double s = 0.0;
    for (int k = 0; k < 64; ++k) {
        const double r = 1.0 - s, cube = r * r * r, residual = cube * r - b * s;
        if (!(residual > 0.0)) break;
        s += residual / (4.0 * cube + b);
    }
    return s;
}

}  // namespace cloth
