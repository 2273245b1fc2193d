// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Coulomb friction: a spring from each contact to an anchor on the obstacle, whose force stays within a cone.
// docs/contact.md derives it.
#pragma once

#include "algebra.hpp"

namespace cloth {

/// Coefficients of a pair of surfaces, at rest and in motion.
struct Roughness {
    double still = 0.0, sliding = 0.0;
};
/// What is known of a contact: none, one that sticks, or one that slides.
enum Bond : int { no_bond = 0, sticks = 1, slides = 2 };
/// An anchor's numbers: its place in the obstacle's frame [m], and its bond.
inline constexpr int anchor_numbers = 4;

/// What friction does at one moment: an acceleration, by how much the anchor's spring is stretched afterwards, whether the
/// contact slides, and per mass the power that is lost and the energy of which the push is the slope at an anchor at rest.
template <class V, class M>
struct Rubbing {
    Vec3<V> push, stretch;
    M slides;
    V lost, energy;
};

/// A spring of squared frequency `stiffness` [1/s^2] and rate `damping` [1/s] along the surface. The coefficient depends on
/// the speed of sliding alone (Stribeck): at rest up to half of `moving`, in motion from there on, smooth between. A jump
/// at the moment where a contact breaks loose would cost all order of the error.
template <class V>
class FrictionLaw {
public:
    FrictionLaw(const Roughness& rough, double frequency)
        : sliding_(of(rough.sliding)), more_(of(rough.still - rough.sliding)), stiffness_(of(frequency * frequency)),
          damping_(of(damping_share * frequency)) {}

    /// Rate of damping over frequency: a tenth of critical damping.
    static constexpr double damping_share = 0.2;
    /// Speed [m/s] from which on the coefficient is that in motion.
    static constexpr double moving = 0.02;

    /// The part of a velocity along the surface, how far the anchor's spring is stretched once it is back within the cone,
    /// the square of how far it was stretched before, and its root where the anchor had to be dragged for it.
    template <class M>
    struct Trial {
        Vec3<V> speed, stretch;
        V square, way, most;
        M slides;
    };
    CLOTH_INLINE auto tried(Vec3<V> way, Vec3<V> normal, Vec3<V> slip, V push) const {
        const Vec3<V> along = way - dot(way, normal) * normal, speed = slip - dot(slip, normal) * normal;
        const V square = norm2(along), most = coefficient(norm2(speed)) * push;
        // Most contacts stick: roots and divisions are for those that slide.
        const auto slides = stiffness_ * stiffness_ * square > most * most;
        V length = of(0.0), share = of(1.0);
        if (any(slides)) {
            length = root(square);
            share = select(slides, most / select(slides, stiffness_ * length, of(1.0)), of(1.0));
        }
        return Trial<std::remove_const_t<decltype(slides)>>{speed, share * along, square, length, most, slides};
    }

    /// At a way from the anchor to the particle, a normal, a velocity seen from the obstacle, and a push across the surface.
    /// Within the cone it sticks. Beyond it the anchor is dragged along, so that its spring stays on the cone. Damping takes
    /// what the cone has room for beside the spring.
    CLOTH_INLINE auto rub(Vec3<V> way, Vec3<V> normal, Vec3<V> slip, V push) const {
        const V one = of(1.0), none = of(0.0), half = of(0.5);
        const auto trial = tried(way, normal, slip, push);
        const auto slides = trial.slides;
        const V most = trial.most;
        const Vec3<V> speed = trial.speed, spring = stiffness_ * trial.stretch, damped = damping_ * speed;
        // Of damping as much as the cone has room for: |spring + part damped| = most, solved without cancellation, where all
        // of it has none.
        const V room = larger(fma(most, most, -norm2(spring)), none), square = norm2(damped), with = dot(spring, damped);
        const auto beyond = fma(of(2.0), with, square) > room;
        V part = one;
        if (any(beyond)) {
            const V size = root(fma(with, with, square * room));
            const auto against = with < none;
            const V under = select(against, square, size + with), over = select(against, size - with, room);
            const auto some = under > none;
            const V solved = smaller(select(some, over / select(some, under, one), none), one);
            part = select(beyond, solved, one);
        }
        const Vec3<V> push_ = -(spring + part * damped);
        const V held = select(slides, none, dot(spring, speed));
        const V energy = select(slides, most * (trial.way - half * most / stiffness_), half * stiffness_ * trial.square);
        using Mask = std::remove_const_t<decltype(slides)>;
        return Rubbing<V, Mask>{push_, trial.stretch, slides, -dot(push_, speed) - held, energy};
    }

private:
    static CLOTH_INLINE V of(double a) { return splat<V>(scalar<V>(a)); }
    /// Of friction, at a squared speed of sliding.
    CLOTH_INLINE V coefficient(V square) const {
        const V none = of(0.0), one = of(1.0), rest = fma(of(-1.0 / (moving * moving)), square, one);
        const V r = smaller(larger(of(4.0 / 3.0) * rest, none), one);
        return fma(more_ * (r * r), fma(of(-2.0), r, of(3.0)), sliding_);
    }

    V sliding_, more_, stiffness_, damping_;
};

}  // namespace cloth
