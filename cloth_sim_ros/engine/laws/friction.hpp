// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Coulomb friction by an anchor spring: a spring from the contact to an anchor on the obstacle, limited to the friction
// cone. docs/derivations/friction.md derives it.
#pragma once

#include "core/algebra.hpp"
#include "laws/anchor.hpp"

namespace cloth::laws {

/// Friction at one time: acceleration, stretch of the anchor spring after the return to the cone, whether it slides,
/// and per mass the dissipated power and the energy whose gradient is the acceleration for a fixed anchor.
template <class V, class M>
struct FrictionForce {
    Vec3<V> push, stretch;
    M slides;
    V dissipation, energy;
};

/// Anchor spring of squared frequency `stiffness` [1/s^2] and damping rate `damping` [1/s] along the surface. The
/// coefficient depends on the sliding speed alone (Stribeck): static up to half of `stribeck_speed`, kinetic from there
/// on, smooth between. A jump at break-away would cost the order of accuracy.
template <class V>
class FrictionLaw {
public:
    FrictionLaw(const FrictionCoefficients& coefficients, double frequency)
        : sliding_(of(coefficients.sliding)), static_excess_(of(coefficients.at_rest - coefficients.sliding)),
          stiffness_(of(frequency * frequency)), damping_(of(damping_per_frequency * frequency)) {}

    /// Damping rate over frequency: a tenth of critical damping.
    static constexpr double damping_per_frequency = 0.2;
    /// Sliding speed [m/s] above which the coefficient is kinetic.
    static constexpr double stribeck_speed = 0.02;

    /// Radial return: tangential velocity, stretch of the spring after the return to the cone, squared stretch before,
    /// and its length if the anchor slides.
    template <class M>
    struct Trial {
        Vec3<V> speed, stretch;
        V square, length, cone_limit;
        M slides;
    };
    CLOTH_INLINE auto radial_return(Vec3<V> offset, Vec3<V> normal, Vec3<V> slip, V push) const {
        const Vec3<V> tangential = offset - dot(offset, normal) * normal, speed = slip - dot(slip, normal) * normal;
        const V square = norm2(tangential), cone_limit = coefficient(norm2(speed)) * push;
        // Most contacts stick: only sliding ones need roots and divisions.
        const auto slides = stiffness_ * stiffness_ * square > cone_limit * cone_limit;
        V length = of(0.0), fraction = of(1.0);
        if (any(slides)) {
            length = root(square);
            fraction = select(slides, cone_limit / select(slides, stiffness_ * length, of(1.0)), of(1.0));
        }
        return Trial<std::remove_const_t<decltype(slides)>>{speed, fraction * tangential, square, length, cone_limit,
                                                            slides};
    }

    /// Friction force for the offset of the particle from the anchor, the normal, the relative velocity and the push.
    /// Within the cone it sticks. Beyond it the anchor is dragged along, so that the spring stays on the cone. Damping
    /// is limited to the rest of the cone.
    CLOTH_INLINE auto force(Vec3<V> offset, Vec3<V> normal, Vec3<V> slip, V push) const {
        const V unit = of(1.0), none = of(0.0), half = of(0.5);
        const auto trial = radial_return(offset, normal, slip, push);
        const auto slides = trial.slides;
        const V cone_limit = trial.cone_limit;
        const Vec3<V> speed = trial.speed, spring = stiffness_ * trial.stretch, damped = damping_ * speed;
        // Fraction of the damping that fits into the cone: |spring + fraction damped| = cone_limit, solved without
        // cancellation.
        const V capacity = larger(fma(cone_limit, cone_limit, -norm2(spring)), none), square = norm2(damped),
                product = dot(spring, damped);
        const auto exceeds = fma(of(2.0), product, square) > capacity;
        V fraction = unit;
        if (any(exceeds)) {
            const V size = root(fma(product, product, square * capacity));
            const auto against = product < none;
            const V denominator = select(against, square, size + product),
                    numerator = select(against, size - product, capacity);
            const auto defined = denominator > none;
            const V solved = smaller(select(defined, numerator / select(defined, denominator, unit), none), unit);
            fraction = select(exceeds, solved, unit);
        }
        const Vec3<V> acceleration = -(spring + fraction * damped);
        const V elastic_power = select(slides, none, dot(spring, speed));
        const V energy = select(slides, cone_limit * (trial.length - half * cone_limit / stiffness_),
                                half * stiffness_ * trial.square);
        using Mask = std::remove_const_t<decltype(slides)>;
        return FrictionForce<V, Mask>{acceleration, trial.stretch, slides, -dot(acceleration, speed) - elastic_power,
                                      energy};
    }

private:
    static CLOTH_INLINE V of(double a) { return splat<V>(scalar<V>(a)); }
    /// Friction coefficient at a squared sliding speed.
    CLOTH_INLINE V coefficient(V square) const {
        const V none = of(0.0), unit = of(1.0),
                decline = fma(of(-1.0 / (stribeck_speed * stribeck_speed)), square, unit);
        const V r = smaller(larger(of(4.0 / 3.0) * decline, none), unit);
        return fma(static_excess_ * (r * r), fma(of(-2.0), r, of(3.0)), sliding_);
    }

    V sliding_, static_excess_, stiffness_, damping_;
};

}  // namespace cloth::laws
