// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// A frame in one call: several runs over the same stretch of time, their combination, and what step control asks of it.
#pragma once

#include <limits>

#include "grid_run.hpp"
#include "list_run.hpp"
#include "measures.hpp"

namespace cloth {

template <class T>
inline Done one_run(Plan& plan, const Run& run) {
    if (plan.grid) return GridRun<T>(plan, run).go();
    return run_lists<T>(plan, run);
}
inline Done one_run(Plan& plan, const Run& run) {
    return run.narrow ? one_run<float>(plan, run) : one_run<double>(plan, run);
}

inline void combine(std::int64_t arrays, const double* const* from, const double* weights, std::int64_t size,
                    double* out) {
    for (std::int64_t i = 0; i < size; ++i) {
        double sum = weights[0] * from[0][i];
        for (std::int64_t k = 1; k < arrays; ++k) sum = fma(weights[k], from[k][i], sum);
        out[i] = sum;
    }
}

inline double largest_distance(const double* x, const double* y, std::int64_t n) {
    double most = 0.0;
    bool bad = false;
    for (std::int64_t i = 0; i < n; ++i) {
        const double a = x[i] - y[i], b = x[n + i] - y[n + i], c = x[2 * n + i] - y[2 * n + i];
        const double square = fma(c, c, fma(b, b, a * a));
        most = square > most ? square : most;
        bad |= !(square < std::numeric_limits<double>::infinity());
    }
    return bad ? std::numeric_limits<double>::infinity() : root(most);
}

/// What a frame is asked for; the same layout as binding.Frame.
struct Frame {
    double t, duration;
    std::int64_t runs;              ///< how many, each with its steps
    const std::int64_t* steps;
    const double* weights;          ///< of the runs in the combination
    std::int64_t narrow, alternate;  ///< of the first run
    std::int64_t bands;
    const double *x0, *v0;
    double* const* run_x;  ///< positions and velocities of each run, (3, n)
    double* const* run_v;
    double *x, *v;         ///< the combination, or null: then the first run is the result
    double* booked;        ///< (grippers, booked_numbers) of each run, or null
    double* powers;        ///< integrals of lost and given power of each run, or null
    double* told;          ///< largest change of a velocity [m/s] (infinite where the result is not finite), then rates if wanted
    std::int64_t rates;    ///< whether bounds of frequency and damping are wanted
};

inline Done make_frame(Plan& plan, const Frame& frame) {
    const std::int64_t n = plan.count, size = plan.held.grippers * booked_numbers;
    for (std::int64_t k = 0; k < frame.runs; ++k) {
        const Run run{frame.t,
                      frame.duration / static_cast<double>(frame.steps[k]),
                      frame.steps[k],
                      frame.narrow && k == 0,
                      frame.alternate && k == 0 && plan.has_weak(),
                      static_cast<int>(frame.bands),
                      frame.x0,
                      frame.v0,
                      frame.run_x[k],
                      frame.run_v[k],
                      frame.booked ? frame.booked + k * size : nullptr,
                      frame.powers ? frame.powers + 2 * k : nullptr};
        const Done done = one_run(plan, run);
        if (done != Done::well) return done;
    }
    const double *x = frame.run_x[0], *v = frame.run_v[0];
    if (frame.x) {
        combine(frame.runs, frame.run_x, frame.weights, 3 * n, frame.x);
        combine(frame.runs, frame.run_v, frame.weights, 3 * n, frame.v);
        x = frame.x;
        v = frame.v;
    }
    if (!frame.told) return Done::well;
    frame.told[0] = largest_distance(v, frame.v0, n);
    const double moved = largest_distance(x, frame.x0, n);
    if (!(moved < std::numeric_limits<double>::infinity())) frame.told[0] = moved;
    if (frame.rates) {
        const Rates r = rates_of(plan, x, nullptr, nullptr);
        frame.told[1] = r.omega2;
        frame.told[2] = r.damping;
    }
    return Done::well;
}

/// One evaluation of all forces over masses; zero where anchored.
inline Done accelerations(Plan& plan, double t, const double* x, const double* v, double* out) {
    // A step that kicks a cloth at rest for a second and moves nothing: its velocities are the accelerations.
    std::vector<double> places(3 * plan.count);
    const Run run{t, 1.0, 0, false, false, 1, x, v, places.data(), out, nullptr, nullptr};
    return plan.grid ? GridRun<double>(plan, run).evaluate() : evaluate_lists(plan, run);
}

}  // namespace cloth
