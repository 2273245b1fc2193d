// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of a whole scene: energy, power, derivative product, bounds. Arrays are (3, n). plan/queries.cpp defines them.
#pragma once

#include "plan/plan.hpp"

namespace cloth::plan {

inline Vec3<double> particle(const double* a, std::int64_t n, std::int64_t i) { return {a[i], a[n + i], a[2 * n + i]}; }

struct Energy {
    double kinetic = 0.0, potential = 0.0;
};
/// Kinetic and potential energy; v may be null.
Energy energy_of(Plan& plan, double t, const double* x, const double* v);

/// Mass blocks of the air [kg], (6, n); all zero without added mass.
void mass_blocks(const Plan& plan, const double* x, double* blocks);

/// Block i of blocks (6, n).
inline Sym3<double> block_of(const double* blocks, std::int64_t n, std::int64_t i) {
    return {blocks[i], blocks[n + i], blocks[2 * n + i], blocks[3 * n + i], blocks[4 * n + i], blocks[5 * n + i]};
}

/// Powers of the damping of a sheet, of drag and of wind at x and v, without lists and joints of grippers.
void grid_and_field_powers(const Plan& plan, const double* x, const double* v, double& dissipation, double& external);
/// The same with lists and friction between layers.
void total_powers(Plan& plan, double t, const double* x, const double* v, double& dissipation, double& external);

/// Add the wrench, power and dissipation of the joints at time t, (grippers, record_numbers).
void add_grip_wrenches(const Plan& plan, double t, const double* x, const double* v, double* wrenches);

/// Add (df/dx) dx + (df/dv) dv [N] to out.
void add_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                 double* out);

/// Jerk by hinges at constant velocities v [m/s^3], (3, n), zero for anchored particles, without added mass.
void hinge_jerk(const Plan& plan, const double* x, const double* v, double* out);

/// Positions and velocities (3, n) and plastic lengths at both ends of an interval of a duration [s], of runs with a step
/// [s]. Without hinges with friction, plastic lengths are null.
struct Interval {
    const double *x0, *v0, *x1, *v1, *plastic0, *plastic1;
    double duration, step;
};
/// Largest velocity changes [m/s], (3, n), that all runs may miss at kinks within half a step of the ends of an interval:
/// where a strain meets a limit of stiffening, and where hinges with friction begin or cease to yield. Changes of a
/// particle never cancel, since kinks are at different times.
void kink_velocities(const Plan& plan, const Interval& interval, double* out);

/// Largest eigenvalues of n matrices (6, n).
void eigenvalues(const double* blocks, std::int64_t n, double* to);
/// Add the bounds of stiffness and damping of all parts except grippers, contact and drag to (6, n).
void add_bounds(const Plan& plan, const double* x, double* stiff, double* damp);
struct SpectralBounds {
    double omega2, damping;
    /// Of hinges alone, and of the transverse stiffness of springs; zero without hinges.
    double hinge_omega2 = 0.0, hinge_damping = 0.0, transverse_omega2 = 0.0;
};
/// Bounds of the squared highest frequency [1/s^2] and the highest damping rate [1/s], without contact. `stiff` [N/m]
/// and `damp` [N s/m], (6, n) or null: blocks of forces in Python. `hinges`: whether those of hinges alone are
/// requested.
SpectralBounds spectral_bounds(Plan& plan, const double* x, const double* stiff, const double* damp, bool hinges);

/// Largest angle [rad] by which a spring turns in a step of an interval, if its vector changes steadily. Its force turns
/// round as its ends pass each other. Of combined runs, also that of a panel's normal, and of the vector by whose length
/// a hinge divides, where these nearly vanish.
double turn_in_step(const Plan& plan, const double* x0, const double* x, std::int64_t steps, std::int64_t runs);

/// Blocks of a list of springs or joints, in its own order, (count, 6): k dd' without the transverse part of
/// compression, and those of their damping, each with its weight.
void pair_blocks(const List& list, const double* x, std::int64_t n, double stiffness, double damping, double* blocks);
/// Couplings of the corners (0, 1), (0, 2) and (1, 2) of each membrane of a list, (3 count, 9); see
/// `laws::MembraneLaw::couplings`.
void membrane_blocks(const List& list, const double* x, std::int64_t n, double stiffness, double damping,
                     double* blocks);
/// Combine the plastic lengths after runs, each (count), at the combined positions x (3, n). Those that no run moved are
/// kept, the others are combined with the weights of the runs. All are returned to the reach of their elements. The work
/// [J] of this return is returned.
double combine_plastic_lengths(const Plan& plan, const double* x, std::int64_t runs, const double* weights,
                               const double* ends, double* out);
/// Signed lengths h [m] of hinges of a list, NaN if undefined, and, unless `squares` is null, |dh/dx|^2 of their four
/// corners (count, 4).
void hinge_lengths(const List& list, const double* x, std::int64_t n, double* lengths, double* squares);

}  // namespace cloth::plan
