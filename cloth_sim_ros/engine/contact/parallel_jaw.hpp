// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Parallel gripper: two jaws with one degree of freedom, moved by a drive and by the cloth between them.
// docs/derivations/parallel_jaw.md derives it.
#pragma once

#include "plan/grips.hpp"

namespace cloth::laws {
template <class V>
class ContactLaw;
}

namespace cloth::contact {

using laws::ContactLaw, plan::Pose;

/// Half the opening between the faces of the jaws [m], and its rate [m/s].
inline constexpr int jaw_state_size = 2;

struct ParallelJaw {
    bool present = false;  ///< whether the gripper exists
    bool closed = false;   ///< whether the drive closes; otherwise it opens
    /// Inertia of the drive at the jaws [kg]; stall force of each jaw [N]; speed of each without load [m/s].
    double mass = 1.0, force = 0.0, speed = 1.0;
    double max_half_opening = 0.0;  ///< half opening of the open gripper [m]
    double half_thickness = 0.0;    ///< half the thickness of a jaw along the closing axis [m]

    /// Acceleration [m/s^2] of the half opening under a force of the cloth that opens the jaws, summed over both [N].
    /// The drive has the force-speed line of a motor: stall force at rest, none at the speed without load. The contact
    /// barrier stops the jaws at each other when half a thickness is left between their faces, which is closer than
    /// cloth between them allows, and at the full opening when a thickness is left.
    double acceleration(const ContactLaw<double>& law, double thickness, double half_opening, double jaw_speed,
                        double cloth_force) const;
    /// Energy per mass, in U^2/2, that a stop has to absorb at that rate; zero if no stop is near.
    double stop_energy(const ContactLaw<double>& law, double thickness, double half_opening, double jaw_speed,
                       double horizon) const;
};

/// Pose of the jaw on a side, +1 or -1, of the closing axis y, from the pose of the gripper.
inline Pose jaw_pose(Pose pose, double jaw_side, double half_opening, double jaw_speed) {
    const Vec3<double> offset = (jaw_side * half_opening) * pose.rotation[1];
    pose.position = pose.position + offset;
    pose.velocity = pose.velocity + (jaw_side * jaw_speed) * pose.rotation[1] + cross(pose.spin, offset);
    return pose;
}

}  // namespace cloth::contact
