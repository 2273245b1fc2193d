// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Force of the joint between a gripper and a particle.
#pragma once

#include "laws/joint.hpp"
#include "plan/grips.hpp"

namespace cloth::plan {

using laws::Joint;

inline Vec3<double> Grips::force(std::int64_t grip, const Point& point, Vec3<double> x, Vec3<double> v) const {
    const typename Joint::Params<double> params{stiffness[grip], damping[grip]};
    const Vec3<double> d = x - point.position, u = v - point.velocity;
    Vec3<double> f;
    Joint::force(params, &d, &u, &f, true);
    return f;
}

}  // namespace cloth::plan
