// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Obstacles on prescribed paths, and the kinematics of a block of particles relative to one of them.
#pragma once

#include "contact/parallel_jaw.hpp"
#include "contact/shapes.hpp"
#include "laws/anchor.hpp"
#include "laws/scaling.hpp"
#include "plan/grips.hpp"

#include <algorithm>
#include <memory>
#include <numeric>

namespace cloth::contact {

using laws::anchor_numbers, laws::FrictionCoefficients, laws::full_thickness, laws::Scaling, plan::path_numbers,
    plan::pose_at;

struct Obstacle {
    Shape shape;
    Vec3<double> size;
    double radius;  ///< of the bounding sphere about the origin of its frame; infinite for a plane
    FrictionCoefficients friction;
    std::int64_t parallel_jaw = -1;  ///< index of the gripper whose jaw this is; negative for other obstacles
    double jaw_side = 0.0;           ///< side on the closing axis, +1 or -1
    std::shared_ptr<const Mesh> mesh = nullptr;  ///< of a mesh obstacle

    bool has_friction() const { return friction.at_rest > 0.0; }
};

/// Contacts with a temporarily reduced thickness. Each recovers the full thickness at a constant rate over a frame.
struct ReducedThickness {
    /// Thickness [m] at time `start` [s] of the contact of each obstacle with each particle; the last row is for
    /// contact of the cloth with itself, the last column for points and edges of obstacles. Padded by a vector. Empty
    /// if all contacts have the full thickness.
    std::vector<double> at_start;
    std::vector<double> rates;  ///< of the same contacts [m/s]
    double full = 0.0, start = 0.0;

    bool any() const { return !at_start.empty(); }
    /// Scaling of contacts with thickness `at_start` and its rate, at time t [s].
    template <class V>
    CLOTH_INLINE Scaling<V> scaling(V at_start, V rate, double t) const {
        const auto of = [](double a) CLOTH_INLINED { return splat<V>(scalar<V>(a)); };
        const V thickness = smaller(fma(rate, of(t - start), at_start), of(full));
        return {of(full) / thickness, rate / thickness};
    }
    /// Scaling of a vector of contacts from an index on.
    Scaling<vec<double>> lane_scaling(std::int64_t index, double t) const {
        using V = vec<double>;
        return any() ? scaling<V>(load(at_start.data() + index), load(rates.data() + index), t) : full_thickness<V>();
    }
    /// Scaling of one contact by row and column.
    Scaling<double> scaling(std::int64_t row, std::int64_t column, std::int64_t columns, double t) const {
        const std::int64_t k = row * columns + column;
        return any() ? scaling<double>(at_start[k], rates[k], t) : full_thickness<double>();
    }
};

struct Contacts {
    std::vector<Obstacle> obstacles;
    std::vector<double> paths;
    double thickness = 0.0, damping = 0.0;
    /// Frequency of the anchor springs of friction [1/s]. `anchors`: anchors at the start of runs, (obstacles,
    /// anchor_numbers, particles), followed by those of friction between layers, see LayerAnchors.
    double frequency = 0.0;
    std::vector<double> anchors;
    /// Parallel grippers, and the states of their jaws at the start of runs, (jaws, jaw_state_size).
    std::vector<ParallelJaw> parallel_jaws;
    std::vector<double> jaw_states;
    ReducedThickness reduced;
    /// Indices of the obstacles that a run may meet. `may_skip_blocks`: whether a run may skip a block of particles for
    /// some steps while the block is far from an obstacle.
    std::vector<std::int64_t> active;
    bool may_skip_blocks = true;

    void activate_all() {
        active.clear();
        for (std::int64_t k = 0; k < count(); ++k)
            if (present(k)) active.push_back(k);
    }
    std::int64_t count() const { return static_cast<std::int64_t>(obstacles.size()); }
    /// Scaling of the contacts of an obstacle's points and edges with a cloth of a number of particles.
    Scaling<double> feature_scaling(std::int64_t obstacle, std::int64_t particles, double t) const {
        return reduced.scaling(obstacle, particles, particles + 1, t);
    }
    const double* path(std::int64_t obstacle) const { return paths.data() + obstacle * path_numbers; }
    /// The gripper whose jaw an obstacle is, or null.
    const ParallelJaw* jaw_of(std::int64_t obstacle) const {
        const std::int64_t jaw = obstacles[obstacle].parallel_jaw;
        return jaw < 0 ? nullptr : &parallel_jaws[jaw];
    }
    bool present(std::int64_t obstacle) const {
        const ParallelJaw* const jaw = jaw_of(obstacle);
        return !jaw || jaw->present;
    }
    /// Pose of an obstacle from the `pose` on its path. A jaw is shifted along the closing axis: its face is
    /// `half_opening` [m] from the gripper and moves outward at `jaw_speed` [m/s].
    Pose shifted_pose(const Pose& pose, std::int64_t obstacle, double half_opening, double jaw_speed) const {
        const ParallelJaw* const jaw = jaw_of(obstacle);
        return jaw ? jaw_pose(pose, obstacles[obstacle].jaw_side, half_opening + jaw->half_thickness, jaw_speed) : pose;
    }
    /// Pose of an obstacle. The jaws are as at the start of runs, but as fast as they may be within a duration [s].
    Pose obstacle_pose(std::int64_t obstacle, double t, double duration = 0.0) const {
        const Pose at = pose_at(path(obstacle), t);
        const ParallelJaw* const jaw = jaw_of(obstacle);
        if (!jaw) return at;
        const double* const state = jaw_states.data() + obstacles[obstacle].parallel_jaw * jaw_state_size;
        return shifted_pose(at, obstacle, state[0], jaw->driven_speed(state[1], duration));
    }
    /// The larger of the present speed of a jaw and its speed without load [m/s].
    double max_jaw_speed(std::int64_t obstacle) const {
        const double speed = jaw_states[obstacles[obstacle].parallel_jaw * jaw_state_size + 1];
        return larger(jaw_of(obstacle)->speed, absolute(speed));
    }
    /// Size of the anchors on obstacles; those on layers of the cloth follow.
    std::int64_t obstacle_anchors(std::int64_t particles) const { return count() * anchor_numbers * particles; }
    bool has_friction() const {
        for (const Obstacle& obstacle : obstacles)
            if (obstacle.has_friction()) return true;
        return false;
    }
    template <class V>
    ContactLaw<V> law() const {
        return ContactLaw<V>(thickness, damping);
    }
};

/// Upper bounds of the distance [m] and of the angle [rad] that an obstacle covers on its path between two times [s]
/// after the path's start.
struct PathMotion {
    double length = 0.0, angle = 0.0;
};
inline PathMotion max_path_motion(const double* path, double begin, double end) {
    PathMotion motion;
    double begin_power = 1.0, end_power = 1.0;
    for (int order = 0; order < 3; ++order) {
        begin_power *= begin, end_power *= end;
        const double power = end_power - begin_power;
        const double *const a = path + 4 + 3 * order, *const r = path + 17 + 3 * order;
        motion.length += power * root(norm2(Vec3<double>{a[0], a[1], a[2]}));
        motion.angle += power * root(norm2(Vec3<double>{r[0], r[1], r[2]}));
    }
    return motion;
}

/// Contact summary of a run. `energy`: largest energy per mass that contact has to absorb, in units of U^2/2. `gap`:
/// least gap [m]. `violated`: whether a skipped block moved faster than assumed.
struct ContactSummary {
    static constexpr int numbers = 3, violation = 2;
    double energy = 0.0, gap = 1e30;
    bool violated = false;
    void write(double* out) const {
        out[0] = energy;
        out[1] = gap;
        out[violation] = violated ? 1.0 : 0.0;
    }
};
/// Particles in a block of a list.
inline constexpr std::int64_t contact_block = 64;

/// An obstacle with its pose at one time. Positions are relative to the origin of a run.
template <class T>
struct PosedObstacle {
    Vec3<T> position, rotation[3], velocity, spin;
    const Mesh* mesh;  ///< null if the obstacle is not a mesh
    Vec3<T> lever{};   ///< from the reference point of torques (the gripper of a jaw) to its position

    PosedObstacle(const Pose& pose, const Obstacle& obstacle, Vec3<double> origin = {}) : mesh(obstacle.mesh.get()) {
        const auto rounded = [](Vec3<double> a) { return Vec3<T>{T(a.x), T(a.y), T(a.z)}; };
        position = rounded(pose.position - origin);
        for (int j = 0; j < 3; ++j) rotation[j] = rounded(pose.rotation[j]);
        velocity = rounded(pose.velocity);
        spin = rounded(pose.spin);
    }
    /// Rotate a vector into the frame of the obstacle, and back.
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
    bool is_rotating() const { return norm2(spin) > T(0); }
};
template <class V>
CLOTH_INLINE Vec3<V> splat3(const Vec3<scalar<V>>& a) {
    return {splat<V>(a.x), splat<V>(a.y), splat<V>(a.z)};
}

/// Kinematics of a particle relative to an obstacle: vector from its position, gap, normal, relative velocity and
/// closing speed.
template <class V>
struct ContactKinematics {
    Vec3<V> arm;
    V gap;
    Vec3<V> normal, slip;
    V closing;
};
/// Gap of a particle that does not count (anchored or padding): larger than any real gap.
template <class T>
inline constexpr T no_gap = T(1e30);

/// Rotating: whether the obstacle may rotate. Without rotation the term is left out, which changes no bit. `limit` [m]:
/// gap of a mesh above which a lower bound of it suffices, and `hints`, see `nearest_on_mesh`.
template <Shape S, bool Rotating, class V>
CLOTH_INLINE ContactKinematics<V> contact_kinematics(const PosedObstacle<scalar<V>>& posed, const Vec3<scalar<V>>& size,
                                                     Vec3<V> x, Vec3<V> v,
                                                     [[maybe_unused]] double limit = no_gap<double>,
                                                     [[maybe_unused]] Index* hints = nullptr) {
    const Vec3<V> c = splat3<V>(posed.rotation[2]);
    ContactKinematics<V> s;
    s.arm = x - splat3<V>(posed.position);
    if constexpr (S == Shape::plane) {
        s.gap = dot(c, s.arm);
        s.normal = c;
    } else if constexpr (S == Shape::sphere) {
        const SurfacePoint<V> n = nearest_on<S, V>(s.arm, splat3<V>(size));
        s.gap = n.gap;
        s.normal = n.normal;
    } else {
        const Vec3<V> a = splat3<V>(posed.rotation[0]), b = splat3<V>(posed.rotation[1]);
        const Vec3<V> local{dot(a, s.arm), dot(b, s.arm), dot(c, s.arm)};
        const SurfacePoint<V> n = [&]() CLOTH_INLINED {
            if constexpr (S == Shape::mesh)
                return nearest_on_mesh<V>(*posed.mesh, local, limit, hints);
            else
                return nearest_on<S, V>(local, splat3<V>(size));
        }();
        s.gap = n.gap;
        s.normal = n.normal.x * a + n.normal.y * b + n.normal.z * c;
    }
    s.slip = v - splat3<V>(posed.velocity);
    if constexpr (Rotating) s.slip = s.slip - cross(splat3<V>(posed.spin), s.arm);
    s.closing = -dot(s.slip, s.normal);
    return s;
}

/// Gap of a point at x from an obstacle [m].
inline double gap_of(const PosedObstacle<double>& posed, const Obstacle& obstacle, Vec3<double> x) {
    return with_shape(obstacle.shape, [&](auto shape) {
        return contact_kinematics<shape.value, true, double>(posed, obstacle.size, x, {}).gap;
    });
}

/// A block of particles: positions and velocities by component, `pitch` numbers apart, and masses, zero for anchored
/// particles and padding. Whole vectors may be read.
template <class T>
struct Block {
    const T *x, *v;
    std::ptrdiff_t pitch;
    const T* mass;
    std::int64_t count;

    template <class V>
    CLOTH_INLINE Vec3<V> position(std::ptrdiff_t j) const {
        return {load_as<V>(x + j), load_as<V>(x + pitch + j), load_as<V>(x + 2 * pitch + j)};
    }
    template <class V>
    CLOTH_INLINE Vec3<V> velocity(std::ptrdiff_t j) const {
        return {load_as<V>(v + j), load_as<V>(v + pitch + j), load_as<V>(v + 2 * pitch + j)};
    }
};

/// Result of a scan of a block: least gap, largest relative speed, and largest closing speed of a particle about to
/// touch.
template <class T>
struct ScanResult {
    T gap, speed, approach_speed;
};
/// Collects a `ScanResult` from vectors of particles. A particle is about to touch if its gap falls below
/// `contact_distance` [m] within `lookahead` [s] at its present speed.
template <class T>
class BlockScan {
    using V = vec<T>;

public:
    BlockScan(T contact_distance, T lookahead)
        : contact_distance_(splat<V>(contact_distance)), negative_lookahead_(splat<V>(-lookahead)) {}
    /// Include a vector of particles; return their gaps, `no_gap` if the mass is zero.
    CLOTH_INLINE V include(const ContactKinematics<V>& s, V mass) {
        max_speed2_ = larger(select(mass > V{}, norm2(s.slip), V{}), max_speed2_);
        return include_gap(s, mass);
    }
    /// The same without speeds.
    CLOTH_INLINE V include_gap(const ContactKinematics<V>& s, V mass) {
        const V gap = select(mass > V{}, s.gap, splat<V>(no_gap<T>));
        min_gap_ = smaller(gap, min_gap_);
        approach_speed_ = larger(select(fma(negative_lookahead_, s.closing, gap) < contact_distance_, s.closing, V{}),
                                 approach_speed_);
        return gap;
    }
    V min_gap() const { return min_gap_; }
    V approach_speed() const { return approach_speed_; }
    ScanResult<T> result() const {
        ScanResult<T> total{no_gap<T>, T(0), T(0)};
        for (int k = 0; k < lanes<T>; ++k) {
            total.gap = smaller<T>(min_gap_[k], total.gap);
            total.speed = larger<T>(max_speed2_[k], total.speed);
            total.approach_speed = larger<T>(approach_speed_[k], total.approach_speed);
        }
        total.speed = root(total.speed);
        return total;
    }

private:
    V contact_distance_, negative_lookahead_, min_gap_ = splat<V>(no_gap<T>), max_speed2_{}, approach_speed_{};
};

/// Scan a block. Gaps of a mesh above `limit` [m] may be lower bounds; `hints`: a triangle for each particle.
template <Shape S, bool Rotating, class T>
inline BlockScan<T> scan_block(const PosedObstacle<T>& posed, const Vec3<T>& size, const Block<T>& block,
                               T contact_distance, T lookahead, double limit = no_gap<double>, Index* hints = nullptr) {
    using V = vec<T>;
    BlockScan<T> scan(contact_distance, lookahead);
    for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>)
        scan.include(
            contact_kinematics<S, Rotating, V>(posed, size, block.template position<V>(j),
                                               block.template velocity<V>(j), limit, hints ? hints + j : nullptr),
            load(block.mass + j));
    return scan;
}

/// Bounds of a block without a search of the obstacle's surface: a lower one of the gap, from the block's box and the
/// ball about the obstacle, and an upper one of the relative speed. Not for planes.
template <class T>
inline ScanResult<T> bound_block(const PosedObstacle<T>& posed, const Obstacle& obstacle, const Block<T>& block) {
    T square = T(0), low[3], high[3];
    for (int c = 0; c < 3; ++c) low[c] = high[c] = block.x[c * block.pitch];
    for (std::int64_t i = 0; i < block.count; ++i) {
        T speed2 = T(0);
        for (int c = 0; c < 3; ++c) {
            const T x = block.x[c * block.pitch + i], v = block.v[c * block.pitch + i];
            low[c] = smaller(x, low[c]);
            high[c] = larger(x, high[c]);
            speed2 += v * v;
        }
        square = larger(speed2, square);
    }
    const T position[3] = {posed.position.x, posed.position.y, posed.position.z};
    T nearest = T(0), furthest = T(0), size = T(0);
    for (int c = 0; c < 3; ++c) {
        const T below = low[c] - position[c], above = position[c] - high[c];
        const T out = larger(larger(below, above), T(0)), far = larger(absolute(below), absolute(above));
        nearest += out * out;
        furthest += far * far;
        size += far + absolute(position[c]);
    }
    // Rounding, in single precision too.
    const T margin = T(1e-5) * size;
    const T speed = root(square) + root(norm2(posed.velocity)) + root(norm2(posed.spin)) * root(furthest);
    return {root(nearest) - T(obstacle.radius) - margin, T(1.001) * speed, T(0)};
}

/// Squared frequency [1/s^2] and damping rate [1/s].
struct ContactBounds {
    double omega2 = 0.0, damping = 0.0;
};

}  // namespace cloth::contact
