// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Obstacles that move as commanded, and how a block of particles stands to one of them.
#pragma once

#include "contact_friction.hpp"
#include "contact_law.hpp"
#include "contact_shapes.hpp"
#include "held.hpp"

#include <algorithm>
#include <numeric>

namespace cloth {

struct Obstacle {
    Shape shape;
    Vec3<double> size;
    double radius;  ///< of a sphere about its frame's origin that holds it all; infinite for a plane
    Roughness rough;
};

struct Contacts {
    std::vector<Obstacle> obstacles;
    std::vector<double> paths;
    double thickness = 0.0, damping = 0.0;
    /// Of the anchors' springs [1/s], and the anchors at the start of runs, (obstacles, anchor_numbers, particles).
    double frequency = 0.0;
    std::vector<double> anchors;
    /// Those that a run may meet, and whether blocks of particles that are far from one may be left alone for a while.
    std::vector<std::int64_t> active;
    bool sleeps = true;

    void wake() {
        active.resize(obstacles.size());
        std::iota(active.begin(), active.end(), std::int64_t{0});
    }
    std::int64_t count() const { return static_cast<std::int64_t>(obstacles.size()); }
    const double* path(std::int64_t obstacle) const { return paths.data() + obstacle * path_numbers; }
    bool rough() const {
        for (const Obstacle& obstacle : obstacles)
            if (obstacle.rough.still > 0.0) return true;
        return false;
    }
    template <class V>
    ContactLaw<V> law() const {
        return ContactLaw<V>(thickness, damping);
    }
};

/// What a run met: energy per mass that contact has to take up, in units of U^2/2, the least gap [m], and whether a block
/// that was left alone turned out faster than was counted with.
struct Touched {
    static constexpr int numbers = 3;
    double reached = 0.0, gap = 1e30;
    bool missed = false;
    void to(double* where) const {
        where[0] = reached;
        where[1] = gap;
        where[2] = missed ? 1.0 : 0.0;
    }
};
/// Particles of a list that are looked at together.
inline constexpr std::int64_t contact_block = 64;

/// An obstacle at a moment; places are seen from a run's origin.
template <class T>
struct Placed {
    Vec3<T> place, rotation[3], speed, spin;

    Placed(const Pose& pose, const double* origin) {
        const auto narrowed = [](Vec3<double> a) { return Vec3<T>{T(a.x), T(a.y), T(a.z)}; };
        place = narrowed(pose.place - Vec3<double>{origin[0], origin[1], origin[2]});
        for (int j = 0; j < 3; ++j) rotation[j] = narrowed(pose.rotation[j]);
        speed = narrowed(pose.speed);
        spin = narrowed(pose.spin);
    }
    /// A vector of the world in the obstacle's frame, and back.
    template <class V>
    CLOTH_INLINE Vec3<V> inward(const Vec3<V>& a) const {
        return {dot(axis<V>(0), a), dot(axis<V>(1), a), dot(axis<V>(2), a)};
    }
    template <class V>
    CLOTH_INLINE Vec3<V> outward(const Vec3<V>& a) const {
        return a.x * axis<V>(0) + a.y * axis<V>(1) + a.z * axis<V>(2);
    }
    template <class V>
    CLOTH_INLINE Vec3<V> axis(int k) const {
        return {splat<V>(rotation[k].x), splat<V>(rotation[k].y), splat<V>(rotation[k].z)};
    }
    bool turns() const { return norm2(spin) > T(0); }
};
template <class V>
CLOTH_INLINE Vec3<V> splat3(const Vec3<scalar<V>>& a) {
    return {splat<V>(a.x), splat<V>(a.y), splat<V>(a.z)};
}

/// How a particle stands to an obstacle: its way from the obstacle's place, the gap, the direction off it, how fast the gap
/// closes, and its velocity seen from the obstacle.
template <class V>
struct Stand {
    Vec3<V> arm;
    V gap;
    Vec3<V> normal, slip;
    V closing;
};
/// With Turns the obstacle may turn; else its spin is zero and left out, which changes no bit.
template <Shape S, bool Turns, class V>
CLOTH_INLINE Stand<V> stand(const Placed<scalar<V>>& placed, const Vec3<scalar<V>>& size, Vec3<V> x, Vec3<V> v) {
    const Vec3<V> c = splat3<V>(placed.rotation[2]);
    Stand<V> s;
    s.arm = x - splat3<V>(placed.place);
    if constexpr (S == Shape::plane) {
        s.gap = dot(c, s.arm);
        s.normal = c;
    } else if constexpr (S == Shape::sphere) {
        const Near<V> n = near<S, V>(s.arm, splat3<V>(size));
        s.gap = n.gap;
        s.normal = n.normal;
    } else {
        const Vec3<V> a = splat3<V>(placed.rotation[0]), b = splat3<V>(placed.rotation[1]);
        const Near<V> n = near<S, V>({dot(a, s.arm), dot(b, s.arm), dot(c, s.arm)}, splat3<V>(size));
        s.gap = n.gap;
        s.normal = n.normal.x * a + n.normal.y * b + n.normal.z * c;
    }
    s.slip = v - splat3<V>(placed.speed);
    if constexpr (Turns) s.slip = s.slip - cross(splat3<V>(placed.spin), s.arm);
    s.closing = -dot(s.slip, s.normal);
    return s;
}

/// Particles side by side: positions and velocities by component, `pitch` numbers apart, and masses, zero where a particle
/// is anchored or none. Whole vectors may be read.
template <class T>
struct Block {
    const T *x, *v;
    std::ptrdiff_t pitch;
    const T* mass;
    std::int64_t count;

    template <class V>
    CLOTH_INLINE Vec3<V> place(std::ptrdiff_t j) const {
        return {load_as<V>(x + j), load_as<V>(x + pitch + j), load_as<V>(x + 2 * pitch + j)};
    }
    template <class V>
    CLOTH_INLINE Vec3<V> velocity(std::ptrdiff_t j) const {
        return {load_as<V>(v + j), load_as<V>(v + pitch + j), load_as<V>(v + 2 * pitch + j)};
    }
};

/// What a look at a block finds: the least gap, the largest speed seen from the obstacle, and the largest speed with which
/// a particle is about to come into contact.
template <class T>
struct Found {
    T gap, speed, entering;
};
/// A gap that is none: of particles that don't count.
template <class T>
inline constexpr T no_gap = T(1e30);

/// Found, as it is put together from vectors of particles. Who would come nearer than `near` within `ahead` seconds is about
/// to come into contact.
template <class T>
class Finding {
    using V = vec<T>;

public:
    Finding(T near, T ahead) : near_(splat<V>(near)), ahead_(splat<V>(-ahead)) {}
    /// Takes particles with these masses in; returns their gaps, which are none where the mass is.
    CLOTH_INLINE V take(const Stand<V>& s, V mass) {
        const auto moves = mass > V{};
        const V gap = select(moves, s.gap, splat<V>(no_gap<T>));
        least_ = smaller(gap, least_);
        fastest_ = larger(select(moves, norm2(s.slip), V{}), fastest_);
        entering_ = larger(select(fma(ahead_, s.closing, gap) < near_, s.closing, V{}), entering_);
        return gap;
    }
    Found<T> found() const {
        Found<T> found{no_gap<T>, T(0), T(0)};
        for (int k = 0; k < lanes<T>; ++k) {
            found.gap = smaller<T>(least_[k], found.gap);
            found.speed = larger<T>(fastest_[k], found.speed);
            found.entering = larger<T>(entering_[k], found.entering);
        }
        found.speed = root(found.speed);
        return found;
    }

private:
    V near_, ahead_, least_ = splat<V>(no_gap<T>), fastest_{}, entering_{};
};

template <Shape S, bool Turns, class T>
inline Found<T> look(const Placed<T>& placed, const Vec3<T>& size, const Block<T>& block, T near, T ahead) {
    using V = vec<T>;
    Finding<T> finding(near, ahead);
    for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>)
        finding.take(stand<S, Turns, V>(placed, size, block.template place<V>(j), block.template velocity<V>(j)),
                     load(block.mass + j));
    return finding.found();
}

}  // namespace cloth
