// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Points and edges of an obstacle, with a radius, for contact with triangles and edges of the cloth.
#pragma once

#include "contact/obstacles.hpp"
#include "contact/surface.hpp"

namespace cloth::contact {

/// Points of one obstacle in its own frame, edges between them, and their radius [m]: the centre of a ball, corners and
/// edges of a box. `reach` [m]: largest distance of a point from the origin of the frame.
struct Features {
    std::vector<Vec3<double>> points;
    std::vector<std::array<Index, 2>> edges;
    double radius = 0.0, reach = 0.0;
};

/// Features at one time. `lever` [m]: vector from the reference point of torques (the gripper of a jaw) to the
/// position.
struct FeaturesAt {
    const Features& features;
    const Pose& pose;
    Vec3<double> lever{};

    Vec3<double> arm(Index k) const {
        const Vec3<double> p = features.points[k];
        return p.x * pose.rotation[0] + p.y * pose.rotation[1] + p.z * pose.rotation[2];
    }
    Vec3<double> position(Index k) const { return pose.position + arm(k); }
    Vec3<double> velocity(Index k) const { return pose.velocity + cross(pose.spin, arm(k)); }
};

/// Functions of the corners of gaps: positions and velocities of particles, by `at`, and of points of an obstacle, ~k.
template <class X>
auto with_point_positions(const FeaturesAt& from, const X& at) {
    return [&](Index c) {
        using V = decltype(at(c).x);
        return c < 0 ? splat3<V>(from.position(~c)) : at(c);
    };
}
template <class X>
auto with_point_velocities(const FeaturesAt& from, const X& at) {
    return [&](Index c) {
        using V = decltype(at(c).x);
        return c < 0 ? splat3<V>(from.velocity(~c)) : at(c);
    };
}

}  // namespace cloth::contact
