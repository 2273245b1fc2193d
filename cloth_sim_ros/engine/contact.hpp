// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Obstacles that move as commanded, and how a block of particles stands to one of them.
#pragma once

#include "contact_friction.hpp"
#include "contact_law.hpp"
#include "contact_pinch.hpp"
#include "contact_shapes.hpp"
#include "held.hpp"

#include <algorithm>
#include <memory>
#include <numeric>

namespace cloth {

struct Obstacle {
    Shape shape;
    Vec3<double> size;
    double radius;  ///< of a sphere about its frame's origin that holds it all; infinite for a plane
    Roughness rough;
    std::int64_t pinch = -1;  ///< of the pad of a gripper that pinches, which; negative for all else
    double side = 0.0;        ///< on which side of its closing axis
    std::shared_ptr<const Mesh> mesh = nullptr;  ///< of a mesh
};

/// Contacts that have a reduced thickness for a while. They regain the whole one, each at a constant rate over a frame.
struct ReducedThickness {
    /// Thickness [m] at the time `start` [s] of the contact of each obstacle with each particle, and in a last row of the
    /// cloth with itself; the last column is of obstacles' points and edges. Room for a vector lies behind. Empty where
    /// all contacts have the whole thickness.
    std::vector<double> at_start;
    std::vector<double> rates;  ///< of the same contacts [m/s]
    double whole = 0.0, start = 0.0;

    bool any() const { return !at_start.empty(); }
    /// Of contacts by their thickness at the start and its rate, at a time t [s].
    template <class V>
    CLOTH_INLINE Scaling<V> scaling(V at_start, V rate, double t) const {
        const auto of = [](double a) CLOTH_INLINED { return splat<V>(scalar<V>(a)); };
        const V now = smaller(fma(rate, of(t - start), at_start), of(whole));
        return {of(whole) / now, rate / now};
    }
    /// Of one contact by its row and column, of so many columns.
    Scaling<double> scaling(std::int64_t row, std::int64_t column, std::int64_t columns, double t) const {
        const std::int64_t k = row * columns + column;
        return any() ? scaling<double>(at_start[k], rates[k], t) : whole_thickness<double>();
    }
};

struct Contacts {
    std::vector<Obstacle> obstacles;
    std::vector<double> paths;
    double thickness = 0.0, damping = 0.0;
    /// Frequency of the springs to friction's anchors [1/s]. `anchors` holds the anchors at the start of runs,
    /// (obstacles, anchor_numbers, particles), and behind them those on layers of the cloth, see LayerAnchors.
    double frequency = 0.0;
    std::vector<double> anchors;
    /// Grippers that pinch, and where their pads are at the start of runs, (pinches, pinch_numbers).
    std::vector<Pinch> pinches;
    std::vector<double> pinched;
    ReducedThickness reduced;
    /// Indices of the obstacles that a run may meet. `sleeps`: whether a run may skip a block of particles for some
    /// steps while the block is far from an obstacle.
    std::vector<std::int64_t> active;
    bool sleeps = true;

    void wake() {
        active.clear();
        for (std::int64_t k = 0; k < count(); ++k)
            if (present(k)) active.push_back(k);
    }
    std::int64_t count() const { return static_cast<std::int64_t>(obstacles.size()); }
    const double* path(std::int64_t obstacle) const { return paths.data() + obstacle * path_numbers; }
    /// The pinch of an obstacle that is a pad, or null.
    const Pinch* pinch_of(std::int64_t obstacle) const {
        const std::int64_t pinch = obstacles[obstacle].pinch;
        return pinch < 0 ? nullptr : &pinches[pinch];
    }
    bool present(std::int64_t obstacle) const {
        const Pinch* const pinch = pinch_of(obstacle);
        return !pinch || pinch->present;
    }
    /// Pose of an obstacle, from `pose` of its path. A pad is shifted along its gripper's closing axis: its face is
    /// `way` [m] from the gripper and moves outward at `rate` [m/s].
    Pose shifted(const Pose& pose, std::int64_t obstacle, double way, double rate) const {
        const Pinch* const pinch = pinch_of(obstacle);
        return pinch ? pad_pose(pose, obstacles[obstacle].side, way + pinch->thick, rate) : pose;
    }
    /// Pose of an obstacle, pads being where they are at the start of runs.
    Pose pose(std::int64_t obstacle, double t) const {
        const Pose at = pose_at(path(obstacle), t);
        if (!pinch_of(obstacle)) return at;
        const double* const state = pinched.data() + obstacles[obstacle].pinch * pinch_numbers;
        return shifted(at, obstacle, state[0], state[1]);
    }
    /// The same, pads moving as fast as they may within a duration [s] from then on, towards where they are driven: at the
    /// speed without load, or at their own where that is larger.
    Pose driven(std::int64_t obstacle, double t, double duration) const {
        const Pinch* const pinch = pinch_of(obstacle);
        if (!pinch || duration == 0.0) return pose(obstacle, t);
        const double* const state = pinched.data() + obstacles[obstacle].pinch * pinch_numbers;
        const double rate = pinch->closed ? smaller(state[1], -pinch->speed) : larger(state[1], pinch->speed);
        return shifted(pose_at(path(obstacle), t), obstacle, state[0], rate);
    }
    /// The larger of both speeds of a pad [m/s].
    double pad_speed(std::int64_t obstacle) const {
        const double now = pinched[obstacles[obstacle].pinch * pinch_numbers + 1];
        return larger(pinch_of(obstacle)->speed, absolute(now));
    }
    /// Numbers of anchors on obstacles; behind them are those on layers of the cloth, if any.
    std::int64_t obstacle_anchors(std::int64_t particles) const { return count() * anchor_numbers * particles; }
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

/// What a run met. `reached`: largest energy per mass that contact has to take up, in units of U^2/2. `gap`: least gap
/// [m]. `missed`: whether a block that was skipped for some steps moved faster than the skip allowed for.
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
    const Mesh* mesh;  ///< of an obstacle that is one
    Vec3<T> lever{};  ///< from the point about which torques are booked, a pad's gripper, to its place

    Placed(const Pose& pose, const double* origin, const Obstacle& obstacle) : mesh(obstacle.mesh.get()) {
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
        const Vec3<V> here{dot(a, s.arm), dot(b, s.arm), dot(c, s.arm)};
        const Near<V> n = [&]() CLOTH_INLINED {
            if constexpr (S == Shape::mesh)
                return near_mesh<V>(*placed.mesh, here);
            else
                return near<S, V>(here, splat3<V>(size));
        }();
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
/// Stands for the gap of a particle that doesn't count (anchored, or padding): larger than any real gap.
template <class T>
inline constexpr T no_gap = T(1e30);

/// Collects `Found` from vectors of particles. A particle is about to come into contact if, at its present speed, its
/// gap falls below `near` [m] within `ahead` [s].
template <class T>
class Finding {
    using V = vec<T>;

public:
    Finding(T near, T ahead) : near_(splat<V>(near)), ahead_(splat<V>(-ahead)) {}
    /// Takes a vector of particles in and returns their gaps: `no_gap` where the mass is zero.
    CLOTH_INLINE V take(const Stand<V>& s, V mass) {
        fastest_ = larger(select(mass > V{}, norm2(s.slip), V{}), fastest_);
        return take_gap(s, mass);
    }
    /// The same without speeds.
    CLOTH_INLINE V take_gap(const Stand<V>& s, V mass) {
        const V gap = select(mass > V{}, s.gap, splat<V>(no_gap<T>));
        least_ = smaller(gap, least_);
        entering_ = larger(select(fma(ahead_, s.closing, gap) < near_, s.closing, V{}), entering_);
        return gap;
    }
    V least() const { return least_; }
    V entering() const { return entering_; }
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
inline Finding<T> look(const Placed<T>& placed, const Vec3<T>& size, const Block<T>& block, T near, T ahead) {
    using V = vec<T>;
    Finding<T> finding(near, ahead);
    for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>)
        finding.take(stand<S, Turns, V>(placed, size, block.template place<V>(j), block.template velocity<V>(j)),
                     load(block.mass + j));
    return finding;
}

}  // namespace cloth
