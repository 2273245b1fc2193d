// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact law of the jaws of a parallel gripper: their stops, and the stiffness of cloth between them.
#pragma once

#include "contact/parallel_jaw.hpp"
#include "laws/contact.hpp"

namespace cloth::contact {

using laws::stopping_gap;

inline double ParallelJaw::acceleration(const ContactLaw<double>& law, double thickness, double half_opening,
                                        double jaw_speed, double cloth_force) const {
    const double drive_force = 2.0 * force * ((closed ? -1.0 : 1.0) - jaw_speed / speed);
    const double inner = law.push(half_opening + 0.75 * thickness, -jaw_speed),
                 outer = law.push(max_half_opening + thickness - half_opening, jaw_speed);
    return (cloth_force + drive_force) / mass + (inner - outer);
}
inline double ParallelJaw::stop_energy(const ContactLaw<double>& law, double thickness, double half_opening,
                                       double jaw_speed, double horizon) const {
    const auto at = [&](double gap, double closing) {
        const double w = larger(closing, 0.0) / ContactLaw<double>::speed;
        return gap - horizon * larger(closing, 0.0) < thickness ? w * w + law.shape(gap) : 0.0;
    };
    return larger(at(half_opening + 0.75 * thickness, -jaw_speed),
                  at(max_half_opening + thickness - half_opening, jaw_speed));
}

/// Energy per mass, in U^2/2, at which contact is `factor` times as stiff as at `energy`.
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

}  // namespace cloth::contact
