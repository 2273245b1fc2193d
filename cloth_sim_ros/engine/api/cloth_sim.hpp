// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// C ABI of the engine: each function that a library exports, and the layout of what crosses. binding.py and band.py
// declare the same; test/engine/test_engine_abi.py compares them. library.map exports these names alone.
//
// Calls run without the interpreter lock. Python checks shapes, types and ranges before. Arrays are (3, n) doubles by
// component unless stated otherwise. Every call returns a Status unless stated otherwise.
#pragma once

#include <cstddef>
#include <cstdint>

#include "plan/frame_request.hpp"

#define CLOTH_API extern "C" __attribute__((visibility("default")))

namespace cloth::plan {
struct Plan;
}

namespace cloth::api {

using plan::Callback, plan::FrameRequest, plan::Plan;

enum Status : int { ok = 0, failed = 1, no_memory = 2, callback_failed = 3, not_finite = 4, busy = 5 };

/// Status of a call of a band matrix or an ordering.
enum BandStatus : int {
    CLOTH_BAND_OK = 0,
    CLOTH_BAND_NOT_POSITIVE = 1,
    CLOTH_BAND_NO_MEMORY = 2,
    CLOTH_BAND_BAD_SELECTION = 3,  ///< index of a pair out of range
    CLOTH_BAND_BAD_PARTICLE = 4,   ///< particle out of range
    CLOTH_BAND_BAD_BLOCK_ROW = 5,  ///< block row out of range, or two rows further apart than the band width
};

static_assert(sizeof(double) == 8 && sizeof(void*) == 8 && sizeof(int) == 4);
static_assert(sizeof(FrameRequest) == 200 && alignof(FrameRequest) == 8);
static_assert(offsetof(FrameRequest, t) == 0);
static_assert(offsetof(FrameRequest, duration) == 8);
static_assert(offsetof(FrameRequest, runs) == 16);
static_assert(offsetof(FrameRequest, steps) == 24);
static_assert(offsetof(FrameRequest, weights) == 32);
static_assert(offsetof(FrameRequest, single_precision) == 40);
static_assert(offsetof(FrameRequest, bands) == 48);
static_assert(offsetof(FrameRequest, x0) == 56);
static_assert(offsetof(FrameRequest, v0) == 64);
static_assert(offsetof(FrameRequest, out) == 72);
static_assert(offsetof(FrameRequest, result) == 80);
static_assert(offsetof(FrameRequest, records) == 88);
static_assert(offsetof(FrameRequest, record_powers) == 96);
static_assert(offsetof(FrameRequest, summary) == 104);
static_assert(offsetof(FrameRequest, bounds_level) == 112);
static_assert(offsetof(FrameRequest, record_obstacles) == 120);
static_assert(offsetof(FrameRequest, anchors) == 128);
static_assert(offsetof(FrameRequest, jaw_states) == 136);
static_assert(offsetof(FrameRequest, multirate) == 144);
static_assert(offsetof(FrameRequest, combined) == 152);
static_assert(offsetof(FrameRequest, concurrency) == 160);
static_assert(offsetof(FrameRequest, activities) == 168);
static_assert(offsetof(FrameRequest, previous_v0) == 176);
static_assert(offsetof(FrameRequest, previous_ratio) == 184);
static_assert(offsetof(FrameRequest, plastic_lengths) == 192);

/// Number of this interface. The binding refuses any other.
CLOTH_API int cloth_engine_abi();
/// Name of the instruction set of this library.
CLOTH_API const char* cloth_engine_name();
CLOTH_API Plan* cloth_plan_new(std::int64_t count, const double* masses, const double* inverse);
CLOTH_API void cloth_plan_free(Plan* plan);
/// Set the grid. Families: rows of present, k_s, rest length, damping, border, parity.
CLOTH_API int cloth_plan_grid(Plan* plan, std::int64_t rows, std::int64_t columns, const double* families);
CLOTH_API int cloth_plan_list(Plan* plan, int kind, std::int64_t count, const std::int64_t* corners,
                              const double* params, const double* common);
CLOTH_API int cloth_plan_uniform(Plan* plan, const double* gravity, const double* wind, double drag);
/// Set the coefficients of panels, and the wind of panels and added mass: the lists whose common parameters change.
CLOTH_API int cloth_plan_air(Plan* plan, const double* common);
/// Set the plastic lengths [m] at the start of runs, in the order of the list of plastic elements.
CLOTH_API int cloth_plan_plastic_lengths(Plan* plan, const double* lengths);
/// Set the rank of each particle in runs without a grid.
CLOTH_API int cloth_plan_order(Plan* plan, const std::int64_t* rank);
CLOTH_API int cloth_plan_callback(Plan* plan, Callback callback);
/// Set the grips; cloth_plan_gripper_paths sets their motion. `prescribed`: whether each particle follows its point
/// exactly.
CLOTH_API int cloth_plan_grips(Plan* plan, std::int64_t grippers, std::int64_t count, const std::int64_t* particles,
                               const std::int64_t* owners, const double* offsets, const double* stiffness,
                               const double* damping, const std::int64_t* prescribed);
/// Set the paths of the grippers, if all their numbers are finite.
CLOTH_API int cloth_plan_gripper_paths(Plan* plan, const double* paths);
CLOTH_API int cloth_frame(Plan* plan, const FrameRequest* frame);
CLOTH_API int cloth_accelerations(Plan* plan, double t, const double* x, const double* v, double* out);
/// Largest displacement [m] of a particle that velocity errors (3, n) cause within a time [s], and the number of force
/// evaluations that it took. Contact and grips are left out.
CLOTH_API int cloth_velocity_displacement(Plan* plan, double t, const double* x, const double* errors, double time,
                                          double* out);
/// Kinetic and potential energy [J], two numbers; v may be null.
CLOTH_API int cloth_energy(Plan* plan, double t, const double* x, const double* v, double* out);
/// Mass blocks of the air that the cloth carries along [kg], (6, n).
CLOTH_API int cloth_mass_blocks(const Plan* plan, const double* x, double* blocks);
/// Power of damping and drag, and power of the wind [W], without the joints of grippers.
CLOTH_API int cloth_powers(Plan* plan, double t, const double* x, const double* v, double* out);
/// Add the weighted wrench records of the grippers to (grippers, record_numbers).
CLOTH_API int cloth_grip_wrenches(Plan* plan, double t, const double* x, const double* v, double weight, double* out);
/// Set positions and velocities (3, n) of prescribed particles at time t; `out`: the records of the impulses that
/// change their velocities, (grippers, record_numbers), or null.
CLOTH_API int cloth_prescribe(Plan* plan, double t, double* x, double* v, double* out);
CLOTH_API int cloth_spectral_bounds(Plan* plan, const double* x, const double* stiff, const double* damp,
                                    std::int64_t hinges, double* out);
/// Angle [rad] of plan::turn_in_step.
CLOTH_API int cloth_turn_in_step(const Plan* plan, const double* x0, const double* x, std::int64_t steps,
                                 std::int64_t runs, double* out);
CLOTH_API int cloth_bounds(const Plan* plan, const double* x, double* stiff, double* damp);
CLOTH_API int cloth_eigenvalues(const double* blocks, std::int64_t n, double* out);
CLOTH_API int cloth_derivative_product(Plan* plan, double t, const double* x, const double* v, const double* dx,
                                       const double* dv, double* out);
/// Jerk by hinges [m/s^3], (3, n); see plan::hinge_jerk.
CLOTH_API int cloth_hinge_jerk(Plan* plan, const double* x, const double* v, double* out);
/// Velocity changes that runs may miss at kinks [m/s], (3, n), in an interval; see plan::kink_velocities.
CLOTH_API int cloth_kink_velocities(Plan* plan, const double* x0, const double* v0, const double* x1, const double* v1,
                                    const double* plastic0, const double* plastic1, double duration, double step,
                                    double* out);
/// Blocks of a list of springs or joints, in its own order; see pair_blocks.
CLOTH_API int cloth_pair_blocks(const Plan* plan, std::int64_t list, const double* x, double stiffness, double damping,
                                double* out);
/// Blocks of a list of membranes, (3 elements, 9); see membrane_blocks.
CLOTH_API int cloth_membrane_blocks(const Plan* plan, std::int64_t list, const double* x, double stiffness,
                                    double damping, double* out);
/// Paths over a frame, see path_to. Input: poses (count, 7), twists (count, 6), displacements and rotations of the
/// frame before (count, 6), targets (count, 7). Output: paths, twists at their end, displacements and rotations, and
/// the largest change of the displacement along an axis since the frame before [m].
CLOTH_API int cloth_paths(std::int64_t count, double t, double duration, const double* poses, const double* twists,
                          const double* previous, const double* targets, double* paths, double* end_twists,
                          double* motions, double* changes);
/// Rotation vector [rad] from one unit quaternion x, y, z, w to another.
CLOTH_API int cloth_rotation_vector(const double* start, const double* end, double* out);
/// Pose of a gripper on its path, 18 numbers: position, velocity, rotation matrix by rows, angular velocity.
CLOTH_API int cloth_pose(const double* path, double t, double* out);
/// Weighted sum of arrays.
CLOTH_API int cloth_combine(std::int64_t arrays, const double* const* from, const double* weights, std::int64_t size,
                            double* out);
/// Largest distance of a particle in two arrays (3, n) [m]; infinite if a number is not finite.
CLOTH_API int cloth_distance(const double* x, const double* y, std::int64_t n, double* out);
/// Sum of m_i a_i . b_i over particles, in order.
CLOTH_API int cloth_weighted_dot(const double* m, const double* a, const double* b, std::int64_t n, double* out);
/// Combine the plastic lengths at the ends of runs, see combine_plastic_lengths, and the dissipated work of it [J].
CLOTH_API int cloth_combine_plastic_lengths(const Plan* plan, const double* x, std::int64_t runs, const double* weights,
                                            const double* ends, double* out, double* work);
/// Signed lengths h [m] of hinges (count, 4) of a kind with a length, NaN if undefined, and, unless `squares` is
/// null, |dh/dx|^2 of their four corners (count, 4).
CLOTH_API int cloth_hinge_lengths(int kind, std::int64_t count, const std::int64_t* corners, const double* x,
                                  std::int64_t n, double* lengths, double* squares);

// Contact with obstacles.

/// Set the obstacles: shapes, dimensions, radii, friction coefficients at rest and in motion as rows of 3, 1 and 2,
/// paths as those of grippers; thickness [m], damping [s/m], and frequency of anchor springs [1/s]. Clears all anchors.
CLOTH_API int cloth_plan_contact(Plan* plan, std::int64_t count, const std::int64_t* shapes, const double* sizes,
                                 const double* radii, const double* frictions, const double* paths, double thickness,
                                 double damping, double frequency);
/// Set the mesh of an obstacle: vertices (vertices, 3) [m] in its own frame, triangles (triangles, 3).
CLOTH_API int cloth_plan_mesh(Plan* plan, std::int64_t obstacle, std::int64_t vertices, const double* positions,
                              std::int64_t triangles, const std::int64_t* corners);
/// Set new paths of the same obstacles.
CLOTH_API int cloth_plan_contact_paths(Plan* plan, const double* paths);
/// Set the obstacles that are jaws, two per gripper, the one on the positive side of the closing axis first. Numbers
/// per gripper: present, closed, mass [kg], force [N], speed [m/s], half opening of the open gripper, half thickness of a
/// jaw and half opening of the closed gripper [m]. Jaws are open initially.
CLOTH_API int cloth_plan_jaws(Plan* plan, std::int64_t count, const std::int64_t* pads, const double* numbers);
/// Set the states of the jaws at the start of runs, (jaws, jaw_state_size).
CLOTH_API int cloth_plan_jaw_states(Plan* plan, const double* jaw_states);
/// Accelerations of the half openings.
CLOTH_API int cloth_jaw_accelerations(Plan* plan, double t, const double* x, const double* v, double* out);
/// Add the weighted wrench records of the obstacles to (obstacles, record_numbers).
CLOTH_API int cloth_contact_wrenches(Plan* plan, double t, const double* x, const double* v, double weight,
                                     double* out);
/// Number of particles in contact and least gap [m] of each obstacle.
CLOTH_API int cloth_contact_gaps(Plan* plan, double t, const double* x, double* out);
CLOTH_API int cloth_contact_bounds(Plan* plan, double t, const double* x, double* stiff, double* damp);
/// Energy per mass that contact may have to absorb from time t on, see predict_contact_energy, and the number of tests:
/// of all obstacles, and of those with friction. Three numbers.
CLOTH_API int cloth_predict_obstacle_contact(const Plan* plan, double t, double duration, const double* x,
                                             const double* v, double* out);
/// Set the anchors at the start of runs, as in `Contacts`.
CLOTH_API int cloth_contact_anchors(Plan* plan, const double* anchors);
/// Combine the anchors at the ends of runs, see combine_anchors.
CLOTH_API int cloth_combine_anchors(Plan* plan, double t, const double* x, const double* v, std::int64_t runs,
                                    const double* weights, const double* ends, double* out);
/// Whether a particle intersects an obstacle on its straight path from x0 at time t to x1.
CLOTH_API int cloth_ccd_obstacles(const Plan* plan, double t, double duration, const double* x0, const double* x1,
                                  std::int64_t* out);
/// Set the reduced thickness of contacts at a time, (obstacles + 1, n + 1), and the rates of recovery, see
/// ReducedThickness. Null clears them. New obstacles have the full thickness.
CLOTH_API int cloth_contact_thickness(Plan* plan, const double* at_start, const double* rates, double start);
/// Gap of each contact [m], rows and columns as above; infinite without a contact.
CLOTH_API int cloth_contact_gap_rows(Plan* plan, double t, const double* x, double* out);
/// Power of contacts that recover their thickness [W].
CLOTH_API int cloth_contact_growth_power(Plan* plan, double t, const double* x, const double* v, double* out);
/// Changes of friction per mass [m/s^2] and velocities of vibrations [m/s], (2, 3, n), of contact::add_friction_change.
CLOTH_API int cloth_friction_change(Plan* plan, double t, double duration, const double* x0, const double* x1,
                                    const double* v1, const double* ends, double* out);
/// Differences of stretches of anchor springs [m], (3, n), from positions x and the plan's anchors to y and `anchors`.
CLOTH_API int cloth_stretch_difference(Plan* plan, double t, const double* x, const double* y, const double* anchors,
                                       double* out);
/// Changes of the jerk by pushes of contact [m/s^3], (3, n), without damping, in an interval.
CLOTH_API int cloth_contact_jerk_change(Plan* plan, double t, double duration, const double* x0, const double* v0,
                                        const double* x1, const double* v1, double* out);
/// Squared frequency and damping rate of contact that has absorbed an energy.
CLOTH_API int cloth_contact_limits(const Plan* plan, double energy, double* out);

// Contact with points and edges of obstacles.

/// Set the surface for contact with points and edges of obstacles: triangles (count, 3), shortest edge at rest [m].
/// Particles are ordered by cloth_plan_order.
CLOTH_API int cloth_plan_faces(Plan* plan, std::int64_t count, const std::int64_t* triangles, double shortest);
/// Set points (points, 3) [m] and edges (edges, 2) of an obstacle in its own frame, and the radius about them [m]; see
/// Features. Ignored if the cloth has no free surface.
CLOTH_API int cloth_plan_features(Plan* plan, std::int64_t obstacle, std::int64_t points, const double* positions,
                                  std::int64_t edges, const std::int64_t* ends, double radius);
/// Whether runs over a duration may skip features, see FeatureCulling.
CLOTH_API int cloth_features_culled(Plan* plan, double t, double duration, const double* x, const double* v,
                                    std::int64_t* out);
/// Predict contact within a duration, eight numbers: energy and visits as in cloth_predict_obstacle_contact; squared
/// frequency and damping rate as in cloth_contact_limits, at `energy_factor` times the energy; and the results of
/// cloth_predict_surface_contact.
CLOTH_API int cloth_predict_contact(Plan* plan, double t, double duration, double energy_factor, double expected,
                                    const double* x, const double* v, double* out);
/// Predict contact on the surface: squared frequency and damping rate, see predict_self_contact and
/// predict_feature_contact, and the number of pairs evaluated.
CLOTH_API int cloth_predict_surface_contact(Plan* plan, double t, double duration, double expected, const double* x,
                                            const double* v, double* out);
/// Whether a feature intersects the cloth on the straight path from x0 at time t to x1, a duration later.
CLOTH_API int cloth_ccd_features(Plan* plan, double t, double duration, const double* x0, const double* x1,
                                 std::int64_t* out);
/// For each gripper, whether its jaws intersect the cloth, see ccd_jaws.
CLOTH_API int cloth_ccd_jaws(Plan* plan, double t, const double* x, const double* half_openings, std::int64_t* out);
/// Initial intersection of the cloth with a feature, see find_feature_intersection: three numbers.
CLOTH_API int cloth_feature_intersection(Plan* plan, double t, const double* x, std::int64_t* out);

// Self-contact.

/// Set the surface of self-contact: triangles (count, 3), shortest edge at rest [m]. Its thickness is that of
/// cloth_plan_contact. Particles are ordered by cloth_plan_order.
CLOTH_API int cloth_plan_self(Plan* plan, std::int64_t count, const std::int64_t* triangles, double shortest);
/// Set the joined particles of that surface, which do not touch each other: for each particle one that all particles
/// joined to it share, (count,).
CLOTH_API int cloth_self_joints(Plan* plan, const std::int64_t* lowest);
/// Set the friction coefficients between layers, at rest and in motion. The next cloth_plan_contact allocates the
/// anchors.
CLOTH_API int cloth_self_friction(Plan* plan, double at_rest, double sliding);
/// Power of friction between layers [W].
CLOTH_API int cloth_self_friction_power(Plan* plan, double t, const double* x, const double* v, double* out);
/// Whether lists of pairs are kept between evaluations. No bit depends on it.
CLOTH_API int cloth_self_cache_pairs(Plan* plan, std::int64_t caches);
/// Add blocks that bound stiffness and damping.
CLOTH_API int cloth_self_bounds(Plan* plan, double t, const double* x, double* stiff, double* damp);
/// Number of contacts and the least gap [m].
CLOTH_API int cloth_self_gaps(Plan* plan, const double* x, double* out);
/// First edge that intersects a triangle, see find_self_intersection.
CLOTH_API int cloth_self_intersection(Plan* plan, const double* x, std::int64_t* out);
/// Whether runs over a duration may skip self-contact, see SelfCulling.
CLOTH_API int cloth_self_culled(Plan* plan, double duration, const double* x, const double* v, std::int64_t* out);
/// Whether the surface intersects itself on straight paths from x0 to x1.
CLOTH_API int cloth_ccd_self(Plan* plan, const double* x0, const double* x1, std::int64_t* out);

// Band matrices and orderings. Every call returns a BandStatus but for the stride.

CLOTH_API std::int64_t cloth_band_stride(std::int64_t width);
/// Blocks of 6 numbers for pairs, or 9 for couplings; see core/band.hpp.
CLOTH_API int cloth_band_assemble(double* rows, std::int64_t count, std::int64_t width, const std::int64_t* block_rows,
                                  std::int64_t particles, const std::int64_t* pairs, const double* blocks,
                                  std::int64_t numbers, std::int64_t pair_count, const std::int64_t* selected,
                                  std::int64_t selected_count);
CLOTH_API int cloth_band_assemble_diagonal(double* rows, std::int64_t count, std::int64_t width,
                                           const std::int64_t* block_rows, std::int64_t particles, const double* masses,
                                           const double* blocks);
CLOTH_API int cloth_band_factor(double* rows, std::int64_t count, std::int64_t width, std::int64_t inner);
CLOTH_API int cloth_band_forward(double* rows, std::int64_t count, std::int64_t width, std::int64_t inner, double* y);
CLOTH_API int cloth_band_backward(double* rows, std::int64_t count, std::int64_t width, std::int64_t inner, double* y);
CLOTH_API int cloth_band_join(double* upper, std::int64_t count_upper, double* lower, std::int64_t count_lower,
                              std::int64_t width, std::int64_t inner_upper, std::int64_t inner_lower, double* middle,
                              std::int64_t shared, std::int64_t width_middle);
/// Order the particles so that those of a pair lie close together.
CLOTH_API int cloth_cuthill_mckee(std::int64_t count, const std::int64_t* pairs, std::int64_t pair_count,
                                  std::int64_t* order);
/// Sum in an order that depends on `count` alone.
CLOTH_API int cloth_sum(const double* values, std::int64_t count, double* total);

// Depth images (height, width), followed by 16 numbers of padding: inverse depth [1/m], 0 without a surface, and labels.
// Intrinsics: fx, fy, cx, cy. Placement: from the drawn frame to the camera's, see camera::Placement.

/// Draw triangles (count, 3) of vertices x (3, n) [m]. `solid`: seen from outside only.
CLOTH_API int cloth_draw_triangles(std::int64_t width, std::int64_t height, const double* intrinsics,
                                   const double* placement, std::int64_t n, const double* x, std::int64_t count,
                                   const std::int64_t* corners, std::int64_t solid, std::int64_t label, float* inverse,
                                   std::uint16_t* labels);
/// Draw a shape with its dimensions, three numbers, and the radius of a ball about its frame that contains it [m].
CLOTH_API int cloth_draw_solid(std::int64_t width, std::int64_t height, const double* intrinsics,
                               const double* placement, std::int64_t shape, const double* size, double radius,
                               std::int64_t label, float* inverse, std::uint16_t* labels);

}  // namespace cloth::api
