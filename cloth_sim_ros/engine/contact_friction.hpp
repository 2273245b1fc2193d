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

/// A spring of squared frequency `stiffness` [1/s^2] and rate `damping` [1/s] along the surface.
template <class V>
class FrictionLaw {
public:
    FrictionLaw(const Roughness& rough, double frequency)
        : still_(of(rough.still)), sliding_(of(rough.sliding)), stiffness_(of(frequency * frequency)),
          damping_(of(damping_share * frequency)) {}

    /// Rate of damping over frequency: a tenth of critical damping.
    static constexpr double damping_share = 0.2;

    /// At a way from the anchor to the particle, a normal, a velocity seen from the obstacle, and a push across the surface.
    /// While it sticks the cone is that of the coefficient at rest. Beyond it the anchor is dragged along, so that its spring
    /// stays on the cone of the coefficient in motion, until a trial falls within that cone. Damping takes what the cone has
    /// room for beside the spring.
    template <class M>
    CLOTH_INLINE auto rub(Vec3<V> way, Vec3<V> normal, Vec3<V> slip, V push, M slid) const {
        const V one = of(1.0);
        const Vec3<V> along = way - dot(way, normal) * normal, speed = slip - dot(slip, normal) * normal;
        const V pull = stiffness_ * root(norm2(along)), motion = sliding_ * push, rest = still_ * push;
        const auto slides = pull > select(slid, motion, rest);
        const V share = select(slides, motion / select(slides, pull, one), one);
        const Vec3<V> stretch = share * along, spring = stiffness_ * stretch, damped = damping_ * speed;
        // Of damping as much as the cone has room for: |spring + part damped| = most, solved without cancellation.
        const V none = of(0.0), most = select(slides, motion, rest);
        const V room = larger(fma(most, most, -norm2(spring)), none), square = norm2(damped), with = dot(spring, damped);
        const V size = root(fma(with, with, square * room));
        const auto against = with < none;
        const V under = select(against, square, size + with), over = select(against, size - with, room);
        const auto some = under > none;
        const V part = smaller(select(some, over / select(some, under, one), none), one);
        const Vec3<V> push_ = -(spring + part * damped);
        const V held = select(slides, none, dot(spring, speed));
        const V way_ = root(norm2(along)), half = of(0.5);
        const V energy = select(slides, motion * (way_ - half * motion / stiffness_), half * pull * way_);
        using Mask = std::remove_const_t<decltype(slides)>;
        return Rubbing<V, Mask>{push_, stretch, slides, -dot(push_, speed) - held, energy};
    }

private:
    static CLOTH_INLINE V of(double a) { return splat<V>(scalar<V>(a)); }

    V still_, sliding_, stiffness_, damping_;
};

}  // namespace cloth
