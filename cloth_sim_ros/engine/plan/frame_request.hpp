// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What Python passes by its layout: the request of a frame, and the callback of its forces.
#pragma once

#include <cstdint>

namespace cloth::plan {

/// Maximum number of runs of one frame.
inline constexpr int max_runs = 8;

/// Callback of forces in Python: adds to f at time t [s], positions x [m] and velocities v [m/s], all (3, n), and,
/// unless `powers` is null, to the dissipated and the external power [W]. A result other than `callback_ok` ends the
/// run.
using Callback = int (*)(double t, const double* x, const double* v, double* f, double* powers);
inline constexpr int callback_ok = 1611516433;  // unlikely to be left behind by a call that did not return

/// Request of a frame; the same layout as binding.FrameRequest.
struct FrameRequest {
    double t, duration;
    std::int64_t runs;  ///< number of runs, each with its number of steps
    const std::int64_t* steps;
    const double* weights;          ///< of the runs in the combination
    std::int64_t single_precision;  ///< whether runs use single precision
    std::int64_t bands;
    const double *x0, *v0;
    double* out;     ///< positions and velocities of each run, (runs, 2, 3, n)
    double* result;  ///< of the combination, (2, 3, n), or null: then the first run is the result
    /// For each run: the records of the grippers; dissipated and external power. With contact also: the records of the
    /// obstacles; the `ContactSummary`, with a violation if the run was repeated without culling, or dropped; squared frequency and damping rate of contact on the surface; friction work
    /// between layers; work of contacts that recover their thickness [J]. Null if none is requested.
    double* records;
    std::int64_t record_powers;  ///< whether powers are recorded
    /// Eleven numbers about the end of the frame, or null. 0: largest change of a particle's velocity over the frame
    /// [m/s]; infinite if the result is not finite, is beyond the surface of an obstacle, or the cloth may intersect
    /// itself. 1, 2: bounds of squared frequency [1/s^2] and damping rate [1/s] without contact. 3: energy per mass, in
    /// U^2/2, that contact with obstacles has to absorb from the end of the frame on. 4, 5: squared frequency [1/s^2]
    /// and damping rate [1/s] of contact on the surface. 6, 7: bounds of squared frequency [1/s^2] and damping rate
    /// [1/s] of hinges alone; 8: bound of the squared transverse frequency of springs. Zero without hinges, or if not
    /// requested. 9: angle by which a spring turns in a step of the
    /// first run [rad], see `turn_in_step`. 10: a quarter of the largest difference of a particle's velocity
    /// change and that of the interval before, per time [m/s]; 0 if `previous_v0` is null.
    double* summary;
    std::int64_t bounds_level;      ///< 1: bounds of frequency and damping are requested; 2: those of hinges too
    std::int64_t record_obstacles;  ///< whether the work of obstacles is recorded
    double* anchors;                ///< of each run at its end, as in `Contacts`, or null
    double* jaw_states;             ///< of each run at its end, (runs, jaws, jaw_state_size), or null
    std::int64_t multirate;         ///< steps per evaluation of hinges
    /// Number of the requested runs, from the first on. They are combined. The others are prefetched: all of them are
    /// dropped if any run violates the culling of contact.
    std::int64_t combined;
    std::int64_t concurrency;  ///< maximum number of concurrent runs
    /// For each run two numbers, (runs, 2). 0: largest difference of a particle's velocity changes over both halves of
    /// the run [m/s]; of a single step, its whole change. 1: largest change of a particle's jerk from the start to the
    /// middle of the run, times T^2/4 [m/s]; 0 if `previous_v0` is null, and for a single step.
    double* activities;
    const double* previous_v0;  ///< velocities at the start of the interval before, or null
    double previous_ratio;      ///< length of the frame relative to that interval
    double* plastic_lengths;    ///< of each run at its end, (runs, plastic elements), or null
};

}  // namespace cloth::plan
