// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of contact: energy, powers, bounds, derivative product, prediction, continuous collision detection. Arrays
// are (3, n) by component. contact/queries.cpp defines them.
#pragma once

#include "plan/plan.hpp"

namespace cloth::contact {

using plan::Plan;

/// Number of tests of a particle against an obstacle: of all, and of those with friction.
struct VisitCounts {
    std::int64_t all = 0, with_friction = 0;
};

/// Squared frequency [1/s^2] and damping rate [1/s] of contact that has absorbed an energy per mass, in U^2/2.
ContactBounds contact_limits(const Contacts& contacts, double energy);
/// Combine the anchors after runs, each (obstacles, anchor_numbers, n), at the combined state x and v. Anchors that no
/// run moved are kept. The others are combined with the weights of the runs, and returned to the cone.
void combine_anchors(const Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                     const double* weights, const double* ends, double* out);
double contact_energy(const Plan& plan, double t, const double* x);
/// Add the wrench on each obstacle about its position, the power on the cloth and the dissipation, (obstacles,
/// record_numbers).
void add_contact_wrenches(const Plan& plan, double t, const double* x, const double* v, double weight,
                          double* wrenches);
/// Power of contacts that recover their thickness [W].
double contact_growth_power(const Plan& plan, double t, const double* x, const double* v);
/// Add blocks of stiffness and damping across the gap. The curvature of a surface only softens.
void add_contact_bounds(const Plan& plan, double t, const double* x, double* stiff, double* damp);
/// Accelerations [m/s^2] of the half openings at time t, by the cloth and the drives; `jaw_forces` [N] are other
/// opening forces by gripper.
void jaw_accelerations(const Plan& plan, double t, const double* x, const double* v, std::vector<double> jaw_forces,
                       double* out);
/// Add (df/dx) dx + (df/dv) dv to out, by the law on dual numbers.
void add_contact_product(const Plan& plan, double t, const double* x, const double* v, const double* dx,
                         const double* dv, double* out);
/// Number of particles in contact with each obstacle, and the least gap to any particle: (obstacles, 2).
void contact_gaps(const Plan& plan, double t, const double* x, double* out);
/// Gap of each contact [m] in the rows and columns of `ReducedThickness`: obstacles and particles.
void contact_gap_rows(const Plan& plan, double t, const double* x, double* out);
/// Whether a particle intersects an obstacle on its straight path from x0 at time t to x1, `duration` [s] later.
/// Conservative advancement: a particle cannot reach the surface before its relative motion equals its gap. Each step
/// along the path is one gap long; then the gap is measured again.
bool ccd_obstacles(const Plan& plan, double t, double duration, const double* x0, const double* x1);

/// Energy per mass, in U^2/2, that contact may have to absorb within `duration`. A particle in contact counts with its
/// contact energy and its closing speed. A particle that comes into contact counts with its speed then, field
/// accelerations included.
double predict_contact_energy(const Plan& plan, double t, double duration, const double* x, const double* v,
                              VisitCounts* visits = nullptr);

double self_energy(Plan& plan, double t, const double* x);
/// Power of damping and friction [W].
double self_dissipation(Plan& plan, double t, const double* x, const double* v);
/// Power of friction between layers [W].
double self_friction_power(Plan& plan, double t, const double* x, const double* v);
/// Power of contacts that recover their thickness [W].
double self_growth_power(Plan& plan, double t, const double* x, const double* v);
/// Combine the anchors on layers after runs, see combine_layer_anchors; those of obstacles come before them.
void combine_self_anchors(Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                          const double* weights, const double* ends, double* out);
/// Add blocks that bound stiffness and damping: for a gap k g g', g = weights times normal, at most 2 k |w_c| n n' at
/// corner c, because the weights of either side add up to one. Terms with a negative sign only soften.
void add_self_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp);
/// Add (df/dx) dx + (df/dv) dv to out, by the law on dual numbers.
void add_self_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                      double* out);
/// Number of particles and pairs of edges in contact, and their least gap [m], infinite if there are none.
void self_gaps(Plan& plan, const double* x, double* out);
/// Least gap of each particle's contacts [m], in the caller's order: to triangles, edges and particles within the
/// thickness, and twice that of an edge of the particle with another edge.
void self_gap_row(Plan& plan, const double* x, double* out);
/// Squared frequency and damping rate of self-contact once it has absorbed `expected` times its energy: of contacts,
/// and of pairs that come into contact within a duration [s] at the present velocities. Infinite if a position is not
/// finite.
ContactBounds predict_self_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                   const double* v);
/// Whether the surface intersects itself on straight paths from x0 to x1, by additive continuous collision detection
/// (Li et al., Codimensional IPC, 2021): each step along a path is one gap long.
bool ccd_self(Plan& plan, const double* x0, const double* x1);
/// First edge that intersects a triangle: its two particles and those of the triangle, or -1 if there is none. Pairs
/// with a common corner do not count.
void find_self_intersection(Plan& plan, const double* x, std::int64_t* out);

double feature_energy(Plan& plan, double t, const double* x);
/// Add the wrench on each obstacle about its position, the power on the cloth and the dissipation, (obstacles,
/// record_numbers).
void add_feature_wrenches(Plan& plan, double t, const double* x, const double* v, double weight, double* wrenches);
/// Power of contacts that recover their thickness [W].
double feature_growth_power(Plan& plan, double t, const double* x, const double* v);
/// Add the forces that open the jaws [N], by gripper.
void add_feature_jaw_forces(Plan& plan, double t, const double* x, const double* v, std::vector<double>& jaw_forces);
/// Add blocks that bound stiffness and damping: for a gap k |w_c| n n' at corner c. Terms with a negative sign and
/// fading edges only soften.
void add_feature_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp);
/// Add (df/dx) dx + (df/dv) dv to out, by the law on dual numbers.
void add_feature_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                         double* out);
/// Lower the gaps in column 1 of (obstacles, 2) to the least gap of each obstacle's features.
void feature_gaps(Plan& plan, double t, const double* x, double* out);
/// Lower the gaps in the last column of (obstacles + 1, n + 1) to the least gap of each obstacle's features within half
/// the thickness, in units of the full thickness.
void feature_gap_column(Plan& plan, double t, const double* x, double* out);
/// Squared frequency and damping rate of contact with features once it has absorbed `expected` times its energy: of
/// contacts, and of pairs that come into contact within a duration [s] at the present velocities. Infinite if a feature
/// intersects the cloth or a position is not finite.
ContactBounds predict_feature_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                      const double* v);
/// Whether any feature intersects the cloth on the path from x0 at time t to x1, `duration` [s] later.
bool ccd_features(Plan& plan, double t, double duration, const double* x0, const double* x1);
/// For each gripper, whether a jaw intersects the cloth at x while it moves from a half opening [m] to its present one.
void ccd_jaws(Plan& plan, double t, const double* x, const double* half_openings, std::int64_t* out);
/// Find an initial intersection at time t, three numbers: the obstacle, and two particles of the edge inside it or of
/// the triangle that its feature intersects; -1 if there is none.
void find_feature_intersection(Plan& plan, double t, const double* x, std::int64_t* out);

}  // namespace cloth::contact
