// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Two pads that a gripper closes on the cloth: obstacles with one degree of freedom together, which its drive and the cloth
// move. docs/contact.md derives it.
#pragma once

#include "contact_law.hpp"
#include "held.hpp"

namespace cloth {

/// Half the way between the pads' faces [m], and its rate [m/s].
inline constexpr int pinch_numbers = 2;

struct Pinch {
    bool present = false;  ///< whether the gripper is anywhere
    bool closed = false;   ///< whether its drive closes, else it opens
    /// Inertia of the drive as the pads feel it [kg]; force of each pad at rest [N]; speed of each without load [m/s].
    double mass = 1.0, force = 0.0, speed = 1.0;
    double open = 0.0;   ///< half the way between the faces of open pads [m]
    double thick = 0.0;  ///< half a pad's extent along the closing axis [m]

    /// Acceleration [m/s^2] of half the way between the faces, at a force of the cloth that opens the pads, both summed [N].
    /// A motor's line: its force falls from that at rest to none at the speed without load. The same law as contact's stops
    /// pads at each other, from where half a thickness is left between their faces, which is closer than cloth between
    /// them lets them come; and at their widest, from where a thickness is left.
    double acceleration(const ContactLaw<double>& law, double thickness, double way, double rate, double felt) const {
        const double drive = 2.0 * force * ((closed ? -1.0 : 1.0) - rate / speed);
        const double inner = law.push(way + 0.75 * thickness, -rate), outer = law.push(open + thickness - way, rate);
        return (felt + drive) / mass + (inner - outer);
    }
    /// Energy per mass, in U^2/2, that a stop has to take up at that rate; none where none is near.
    double stopped(const ContactLaw<double>& law, double thickness, double way, double rate, double soon) const {
        const auto at = [&](double gap, double closing) {
            const double w = larger(closing, 0.0) / ContactLaw<double>::speed;
            return gap - soon * larger(closing, 0.0) < thickness ? w * w + law.shape(gap) : 0.0;
        };
        return larger(at(way + 0.75 * thickness, -rate), at(open + thickness - way, rate));
    }
};

/// Pose of the pad on a side, +1 or -1, of a gripper's closing axis y, from the gripper's.
inline Pose pad_pose(Pose pose, double side, double way, double rate) {
    const Vec3<double> out = (side * way) * pose.rotation[1];
    pose.place = pose.place + out;
    pose.speed = pose.speed + (side * rate) * pose.rotation[1] + cross(pose.spin, out);
    return pose;
}

/// Energy per mass, in U^2/2, at which contact is `times` as stiff as at the energy per mass `reached`.
inline double stiffened(const ContactLaw<double>& law, double thickness, double reached, double times) {
    if (!(reached > 0.0) || !(times > 1.0)) return reached;
    double high = stopping_gap(reached), low = 0.0;
    const double wanted = times * law.stiffness(high * thickness);
    for (int k = 0; k < 64; ++k) {
        const double middle = 0.5 * (low + high);
        (law.stiffness(middle * thickness) < wanted ? high : low) = middle;
    }
    return law.shape(low * thickness);
}

}  // namespace cloth
