// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of contact that a plan makes. Arrays are (3, n) by component. api/contact.cpp defines them.
#pragma once

#include "plan/plan.hpp"

namespace cloth::contact {

using plan::Plan;

/// Number of tests of a particle against an obstacle: of all, and of those with friction.
struct VisitCounts {
    std::int64_t all = 0, with_friction = 0;
};

/// Add (df/dx) dx + (df/dv) dv to out, by the law on dual numbers: of particles against obstacles, and on the surface.
void add_contact_product(const Plan& plan, double t, const double* x, const double* v, const double* dx,
                         const double* dv, double* out);
void add_surface_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                         double* out);
double contact_energy(const Plan& plan, double t, const double* x);

/// Add a vector to an array (3, n).
inline void add_to(double* out, std::int64_t n, const Vec3<double>& a) {
    out[0] += a.x, out[n] += a.y, out[2 * n] += a.z;
}

/// Time, positions, velocities or null, and anchors of friction of a state.
struct AnchoredState {
    double t;
    const double *x, *v, *anchors;
};

/// Add what friction with obstacles may have changed between two states, by anchor springs in the frames of obstacles:
/// changes of the friction per mass [m/s^2] of particles that slid, (3, n), then velocities [m/s] of vibrations, (3, n).
/// An anchor that sticks does not move by one bit, and its force is smooth. But its particle may vibrate faster than
/// steps resolve: with the velocity along the surface less the mean rate of the stretch, or that which its stretch
/// causes if it slid before.
void add_friction_change(const Plan& plan, const AnchoredState& start, const AnchoredState& end, double* out);
/// Add the differences of the stretches of anchor springs with obstacles [m], (3, n), between two states of one time.
/// Springs that slide in both are left out, because the cone limits them.
void add_stretch_difference(const Plan& plan, const AnchoredState& a, const AnchoredState& b, double* out);

/// Positions and velocities at a time.
struct Moment {
    double t;
    const double *x, *v;
};

/// Add the jerk by pushes at a moment times a factor [m/s^3], (3, n), without damping: by obstacles, and on the surface.
/// What touches only within the interval counts with the jerk where it stops. The interval has a duration [s], and begins
/// at the moment if the factor is negative, else ends there.
void add_contact_jerk(const Plan& plan, const Moment& moment, double factor, double duration, double* out);
void add_surface_jerk(Plan& plan, const Moment& moment, double factor, double duration, double* out);

/// Energy per mass, in U^2/2, that contact may have to absorb within `duration`. A particle in contact counts with its
/// contact energy and its closing speed. A particle that comes into contact counts with its speed then, field
/// accelerations included.
double predict_contact_energy(const Plan& plan, double t, double duration, const double* x, const double* v,
                              VisitCounts* visits = nullptr);

/// Add the energy of contact on the surface.
void add_surface_energy(Plan& plan, double t, const double* x, double& potential);
/// Power of damping and friction of the cloth on itself [W].
double self_dissipation(Plan& plan, double t, const double* x, const double* v);
/// Squared frequency and damping rate of self-contact once it has absorbed `expected` times its energy: of contacts,
/// and of pairs that come into contact within a duration [s] at the present velocities. Infinite if a position is not
/// finite.
ContactBounds predict_self_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                   const double* v);
/// Whether the surface intersects itself on straight paths from x0 to x1, by additive continuous collision detection
/// (Li et al., Codimensional IPC, 2021): each step along a path is one gap long.
bool ccd_self(Plan& plan, const double* x0, const double* x1);

/// Squared frequency and damping rate of contact with features once it has absorbed `expected` times its energy: of
/// contacts, and of pairs that come into contact within a duration [s] at the present velocities. Infinite if a feature
/// intersects the cloth or a position is not finite.
ContactBounds predict_feature_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                      const double* v);
/// Whether any feature intersects the cloth on the path from x0 at time t to x1, `duration` [s] later.
bool ccd_features(Plan& plan, double t, double duration, const double* x0, const double* x1);

}  // namespace cloth::contact
