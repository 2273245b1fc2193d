// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Parallel gripper: two jaws with one degree of freedom, moved by a drive and by the cloth between them; their stops,
// and the stiffness of cloth between them. docs/derivations/parallel_jaw.md derives it.
#pragma once

#include "laws/contact.hpp"
#include "plan/grips.hpp"

namespace cloth::contact {

using laws::ContactLaw, laws::stopping_gap, plan::Pose;

/// Half the opening between the faces of the jaws [m], and its rate [m/s].
inline constexpr int jaw_state_size = 2;

struct ParallelJaw {
    bool present = false;  ///< whether the gripper exists
    bool closed = false;   ///< whether the drive closes; otherwise it opens
    /// Inertia of the drive at the jaws [kg]; stall force of each jaw [N]; speed of each without load [m/s].
    double mass = 1.0, force = 0.0, speed = 1.0;
    double max_half_opening = 0.0;  ///< half opening of the open gripper [m]
    double half_thickness = 0.0;    ///< half the thickness of a jaw along the closing axis [m]
    double min_half_opening = 0.0;  ///< half opening of the closed gripper [m]

    /// Acceleration [m/s^2] of the half opening under a force of the cloth that opens the jaws, summed over both [N].
    /// The drive has the force-speed line of a motor: stall force at rest, none at the speed without load. The contact
    /// barrier stops the jaws at each other when half a thickness is left between their faces, which is closer than
    /// cloth between them allows, or that far from a larger smallest opening. It stops them at the full opening when a
    /// thickness is left.
    double acceleration(const ContactLaw<double>& law, double thickness, double half_opening, double jaw_speed,
                        double cloth_force) const {
        const double drive_force = 2.0 * force * ((closed ? -1.0 : 1.0) - jaw_speed / speed);
        const double inner = law.push(half_opening - min_half_opening + 0.75 * thickness, -jaw_speed),
                     outer = law.push(max_half_opening + thickness - half_opening, jaw_speed);
        return (cloth_force + drive_force) / mass + (inner - outer);
    }
    /// Energy per mass, in U^2/2, that a stop has to absorb at that rate; zero if no stop is near.
    double stop_energy(const ContactLaw<double>& law, double thickness, double half_opening, double jaw_speed,
                       double horizon) const {
        const auto at = [&](double gap, double closing) {
            const double w = larger(closing, 0.0) / ContactLaw<double>::speed;
            return gap - horizon * larger(closing, 0.0) < thickness ? w * w + law.shape(gap) : 0.0;
        };
        return larger(at(half_opening - min_half_opening + 0.75 * thickness, -jaw_speed),
                      at(max_half_opening + thickness - half_opening, jaw_speed));
    }
    /// Rate of the half opening [m/s] of jaws that move as fast as they may within a duration [s]: at the speed without
    /// load, or at their present speed if that is larger.
    double driven_speed(double jaw_speed, double duration) const {
        if (duration == 0.0) return jaw_speed;
        return closed ? smaller(jaw_speed, -speed) : larger(jaw_speed, speed);
    }
};

/// Energy per mass, in U^2/2, at which a single contact is as stiff as a particle between two jaws, or as jaws between
/// particles of `mass_ratio` times their mass, by the energies that contact and a stop have to absorb.
/// docs/derivations/parallel_jaw.md has the bound.
inline double stiffened_energy(const ContactLaw<double>& law, double thickness, double contact_energy,
                               double stop_energy, double mass_ratio) {
    const double energy = larger(stop_energy, contact_energy),
                 factor = 2.0 + mass_ratio + (stop_energy > 0.0 ? 1.0 : 0.0);
    if (!(energy > 0.0) || !(factor > 1.0)) return energy;
    double high = stopping_gap(energy), low = 0.0;
    const double target = factor * law.stiffness(high * thickness);
    for (int k = 0; k < 64; ++k) {
        const double middle = 0.5 * (low + high);
        (law.stiffness(middle * thickness) < target ? high : low) = middle;
    }
    return law.shape(low * thickness);
}

/// Pose of the jaw on a side, +1 or -1, of the closing axis y, from the pose of the gripper.
inline Pose jaw_pose(Pose pose, double jaw_side, double half_opening, double jaw_speed) {
    const Vec3<double> offset = (jaw_side * half_opening) * pose.rotation[1];
    pose.position = pose.position + offset;
    pose.velocity = pose.velocity + (jaw_side * jaw_speed) * pose.rotation[1] + cross(pose.spin, offset);
    return pose;
}

}  // namespace cloth::contact
