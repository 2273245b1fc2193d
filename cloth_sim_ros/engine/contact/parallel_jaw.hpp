// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Two pads that a gripper closes on the cloth: obstacles with one degree of freedom together, which its drive and the cloth
// move. docs/contact.md derives it.
#pragma once

#include "laws/contact.hpp"
#include "plan/grips.hpp"

namespace cloth {

/// Half the way between the pads' faces [m], and its rate [m/s].
inline constexpr int jaw_state_size = 2;

struct ParallelJaw {
    bool present = false;  ///< whether the gripper is anywhere
    bool closed = false;   ///< whether its drive closes, else it opens
    /// Inertia of the drive as the pads feel it [kg]; force of each pad at rest [N]; speed of each without load [m/s].
    double mass = 1.0, force = 0.0, speed = 1.0;
    double max_half_opening = 0.0;   ///< half the way between the faces of open pads [m]
    double half_thickness = 0.0;  ///< half a pad's extent along the closing axis [m]

    /// Acceleration [m/s^2] of half the way between the faces, at a force of the cloth that opens the pads, both summed [N].
    /// A motor's line: its force falls from that at rest to none at the speed without load. The same law as contact's stops
    /// pads at each other, from where half a thickness is left between their faces, which is closer than cloth between
    /// them lets them come; and at their widest, from where a thickness is left.
    double acceleration(const ContactLaw<double>& law, double thickness, double half_opening, double jaw_speed, double cloth_force) const {
        const double drive_force = 2.0 * force * ((closed ? -1.0 : 1.0) - jaw_speed / speed);
        const double inner = law.push(half_opening + 0.75 * thickness, -jaw_speed), outer = law.push(max_half_opening + thickness - half_opening, jaw_speed);
        return (cloth_force + drive_force) / mass + (inner - outer);
    }
    /// Energy per mass, in U^2/2, that a stop has to take up at that rate; none where none is near.
    double stop_energy(const ContactLaw<double>& law, double thickness, double half_opening, double jaw_speed, double horizon) const {
        const auto at = [&](double gap, double closing) {
            const double w = larger(closing, 0.0) / ContactLaw<double>::speed;
            return gap - horizon * larger(closing, 0.0) < thickness ? w * w + law.shape(gap) : 0.0;
        };
        return larger(at(half_opening + 0.75 * thickness, -jaw_speed), at(max_half_opening + thickness - half_opening, jaw_speed));
    }
};

/// Pose of the pad on a side, +1 or -1, of a gripper's closing axis y, from the gripper's.
inline Pose jaw_pose(Pose pose, double jaw_side, double half_opening, double jaw_speed) {
    const Vec3<double> offset = (jaw_side * half_opening) * pose.rotation[1];
    pose.position = pose.position + offset;
    pose.velocity = pose.velocity + (jaw_side * jaw_speed) * pose.rotation[1] + cross(pose.spin, offset);
    return pose;
}

/// Energy per mass, in U^2/2, at which contact is `times` as stiff as at the energy per mass `reached`.
inline double stiffened_energy(const ContactLaw<double>& law, double thickness, double energy, double factor) {
    if (!(energy > 0.0) || !(factor > 1.0)) return energy;
    double high = stopping_gap(energy), low = 0.0;
    const double target = factor * law.stiffness(high * thickness);
    for (int k = 0; k < 64; ++k) {
        const double middle = 0.5 * (low + high);
        (law.stiffness(middle * thickness) < target ? high : low) = middle;
    }
    return law.shape(low * thickness);
}

}  // namespace cloth
