// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// A frame in one call: several runs over the same stretch of time, their combination, and what step control asks of it.
#pragma once

#include <limits>

#include "contact_ahead.hpp"
#include "contact_approach.hpp"
#include "contact_feature_measures.hpp"
#include "grid_forces.hpp"
#include "grid_run.hpp"
#include "list_run.hpp"
#include "measures.hpp"

namespace cloth {

/// Runs of one frame at most.
inline constexpr int max_runs = 8;

template <class T>
inline Done one_run(Plan& plan, const Run& run) {
    if (plan.grid) return GridRun<T>(plan, run).go();
    return run_lists<T>(plan, run);
}
inline Done one_run(Plan& plan, const Run& run) {
    return run.narrow && !plan.surface_acts() ? one_run<float>(plan, run) : one_run<double>(plan, run);
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
    std::int64_t runs;               ///< how many, each with its steps
    const std::int64_t* steps;
    const double* weights;           ///< of the runs in the combination
    std::int64_t narrow;             ///< whether runs calculate in single precision
    std::int64_t bands;
    const double *x0, *v0;
    double* out;            ///< positions and velocities of each run, (runs, 2, 3, n)
    double* result;         ///< those of the combination, (2, 3, n), or null: then the first run is the result
    /// Of each run what was booked for each gripper, then lost and given power; where there is contact, what was booked
    /// for each obstacle, what `Touched` has, squared frequency and damping rate that the cloth's contact with itself
    /// and with points and edges of obstacles had to be followed at, what friction between layers took, and what contacts
    /// gave that regained their thickness [J]. Null where nothing is wanted and there is none.
    double* notes;
    std::int64_t powers;    ///< whether powers are noted
    /// Nine numbers about the frame's end, or null.
    /// 0: largest change of a particle's velocity over the frame [m/s]. It is infinite where the result is not finite,
    /// lies beyond an obstacle's surface, or the cloth may have passed through itself.
    /// 1, 2: bounds of squared frequency [1/s^2] and damping rate [1/s], contact aside.
    /// 3: energy per mass, in U^2/2, that contact with obstacles has to take up from the frame's end on.
    /// 4, 5: squared frequency [1/s^2] and damping rate [1/s] of the cloth's contact with itself and with points and
    /// edges of obstacles.
    /// 6, 7: bounds of squared frequency [1/s^2] and damping rate [1/s] of hinges alone; 8: of the squared frequency that
    /// springs have across themselves. Zero without hinges, or where they are not wanted.
    double* told;
    std::int64_t rates;     ///< whether bounds of frequency and damping are wanted; 2: those of hinges as well
    std::int64_t books;     ///< whether what obstacles do is booked
    double* anchors;        ///< of each run at its end, as `Contacts` has them, or null
    double* pinched;        ///< of each run at its end, (runs, pinches, pinch_numbers), or null
    std::int64_t every;     ///< steps for which hinges are asked for once
    std::int64_t combined;  ///< how many of the runs, from the first on, are in the combination
    std::int64_t abreast;   ///< how many may be made at once
};

/// Numbers of a run's notes about contact: what obstacles did, what contact met, the rates of the cloth's contact with
/// itself, what its friction took, and what contacts gave that regained their thickness.
inline std::int64_t touched_numbers(const Plan& plan) {
    return plan.touches() ? plan.contacts.count() * booked_numbers + Touched::numbers + 4 : 0;
}

/// What a frame is asked for of each of its runs.
inline std::vector<Run> runs_of(const Plan& plan, const Frame& frame) {
    const std::int64_t n = plan.count, size = plan.held.grippers * booked_numbers;
    const std::int64_t touched = touched_numbers(plan), whole = size + 2 + touched;
    const auto pinches = static_cast<std::int64_t>(plan.contacts.pinches.size());
    std::vector<Run> runs;
    for (std::int64_t k = 0; k < frame.runs; ++k) {
        double* const notes = frame.notes ? frame.notes + k * whole : nullptr;
        double* const out = frame.out + k * 6 * n;
        runs.push_back({frame.t,
                        frame.duration / static_cast<double>(frame.steps[k]),
                        frame.steps[k],
                        frame.narrow != 0,
                        static_cast<int>(frame.bands),
                        frame.x0,
                        frame.v0,
                        out,
                        out + 3 * n,
                        notes,
                        frame.powers ? notes + size : nullptr,
                        touched ? notes + size + 2 : nullptr,
                        touched && frame.books,
                        frame.anchors ? frame.anchors + k * plan.anchor_count() : nullptr,
                        frame.pinched ? frame.pinched + k * pinches * pinch_numbers : nullptr,
                        frame.every});
    }
    return runs;
}

/// Runs at once, each by one thread: they share what they read, and write into rooms of their own.
inline void make_abreast(Plan& plan, const Frame& frame, std::vector<Run>& runs) {
    if (frame.narrow)
        plan.lay_tables<float>();
    else
        plan.lay_tables<double>();
    const int threads = static_cast<int>(std::min<std::int64_t>(frame.abreast, max_abreast));
    Pool::shared().share(static_cast<int>(runs.size()), threads, [&](int number, int room) {
        runs[number].bands = 1;
        runs[number].room = room;
        one_run(plan, runs[number]);
    });
}

inline Done make_runs(Plan& plan, const Frame& frame) {
    std::vector<Run> runs = runs_of(plan, frame);
    if (frame.abreast > 1 && runs.size() > 1 && plan.apart()) {
        make_abreast(plan, frame, runs);
        return Done::well;
    }
    const std::int64_t touched = touched_numbers(plan), size = plan.held.grippers * booked_numbers + 2 + touched;
    Approach approach(plan, frame.duration, frame.x0, frame.v0);
    SelfRest rest(plan, frame.duration, frame.x0, frame.v0);
    FeatureRest features(plan, frame.t, frame.duration, frame.x0, frame.v0);
    for (std::int64_t k = 0; k < frame.runs; ++k) {
        const Run& run = runs[k];
        const Done done = one_run(plan, run);
        if (done != Done::well) return done;
        const bool missed = touched && approach.missed(run.v, run.touched + plan.contacts.count() * booked_numbers);
        if (missed || rest.missed(run.v) || features.missed(run.v)) {
            if (missed) approach.wake();
            rest.wake();
            features.wake();
            std::fill(frame.notes, frame.notes + frame.runs * size, 0.0);
            k = -1;
        }
    }
    return Done::well;
}

inline Done make_frame(Plan& plan, const Frame& frame) {
    const std::int64_t n = plan.count;
    const Done done = make_runs(plan, frame);
    if (done != Done::well) return done;
    const double* x = frame.out;
    if (frame.result) {
        const double* from[max_runs];
        for (std::int64_t k = 0; k < frame.combined; ++k) from[k] = frame.out + k * 6 * n;
        combine(frame.combined, from, frame.weights, 6 * n, frame.result);
        x = frame.result;
    }
    if (!frame.told) return Done::well;
    frame.told[0] = largest_distance(x + 3 * n, frame.v0, n);
    const double moved = largest_distance(x, frame.x0, n);
    if (!(moved < std::numeric_limits<double>::infinity())) frame.told[0] = moved;
    if (plan.contacts.count()) {
        // Drifts of half a step and combinations of runs may lead beyond a surface that no run met.
        const std::vector<double> start = plan.contacts.pinched;
        const auto size = static_cast<std::int64_t>(start.size());
        if (frame.pinched && frame.result) {
            const double* from[max_runs];
            for (std::int64_t k = 0; k < frame.combined; ++k) from[k] = frame.pinched + k * size;
            combine(frame.combined, from, frame.weights, size, plan.contacts.pinched.data());
        } else if (frame.pinched) {
            plan.contacts.pinched.assign(frame.pinched, frame.pinched + size);
        }
        frame.told[3] = contact_ahead(plan, frame.t + frame.duration, 0.0, x, x + 3 * n);
        plan.contacts.pinched = start;
        if (!(frame.told[3] < std::numeric_limits<double>::infinity())) frame.told[0] = frame.told[3];
    }
    const double* const finest = frame.out + (frame.combined - 1) * 6 * n;
    const auto follow = [&](SelfRates r, auto&& crosses) {
        frame.told[4] += r.omega2;
        frame.told[5] += r.damping;
        const bool bad = !(r.omega2 < std::numeric_limits<double>::infinity());
        if (bad || (x != finest && crosses())) frame.told[0] = std::numeric_limits<double>::infinity();
    };
    frame.told[4] = frame.told[5] = 0.0;
    const double end = frame.t + frame.duration;
    if (plan.self_acts())
        follow(self_ahead(plan, end, 0.0, 1.0, x, x + 3 * n), [&] { return self_crosses(plan, finest, x); });
    if (plan.features_act())
        follow(feature_ahead(plan, end, 0.0, 1.0, x, x + 3 * n),
               [&] { return features_cross(plan, end, 0.0, finest, x); });
    if (frame.rates) {
        const Rates r = rates_of(plan, x, nullptr, nullptr, frame.rates > 1);
        frame.told[1] = r.omega2;
        frame.told[2] = r.damping;
        frame.told[6] = r.hinges2;
        frame.told[7] = r.hinge_damping;
        frame.told[8] = r.across2;
    }
    return Done::well;
}

/// One evaluation of all forces over masses; zero where anchored.
inline Done accelerations(Plan& plan, double t, const double* x, const double* v, double* out) {
    const Run run{t, 1.0, 0, false, 1, x, v, nullptr, out, nullptr, nullptr};
    plan.contacts.wake();
    plan.self_rests = false;
    if (plan.features) plan.features->wake(plan.contacts);
    return plan.grid ? GridForces(plan, run).go() : evaluate_lists(plan, run);
}

}  // namespace cloth
