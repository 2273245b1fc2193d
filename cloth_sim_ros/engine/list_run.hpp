// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs of whatever has no regular grid: meshes, raw springs, single particles. Particles lie as quads, in an order in
// which neighbours are close.
#pragma once

#include "plan.hpp"

namespace cloth {

/// With `Evaluate` one evaluation alone, at x0 and v0: accelerations come out in place of velocities.
template <class T, bool Evaluate = false>
Done run_lists(Plan& plan, const Run& run) {
    Beside<T> beside(plan, run);
    const std::int64_t n = plan.count;
    beside.make(true);
    auto& [velocity, before, carry] = plan.room<T>().more;
    velocity.assign(4 * n, T(0));
    before.assign(4 * n, T(0));
    carry.assign(sizeof(T) == 4 ? 4 * n : 0, T(0));
    for (int c = 0; c < 3; ++c)
        for (std::int64_t i = 0; i < n; ++i) {
            const std::int64_t at = 4 * plan.rank[i] + c;
            beside.x[at] = static_cast<T>(run.x0[c * n + i] - beside.origin[c]);
            beside.v[at] = static_cast<T>(run.v0[c * n + i]);
            if (!Evaluate) velocity[at] = beside.v[at];
        }
    std::vector<T> inverse(n);
    for (std::int64_t i = 0; i < n; ++i) inverse[plan.rank[i]] = static_cast<T>(plan.inverse[i]);

    const quad<T> push{T(plan.push(0)), T(plan.push(1)), T(plan.push(2)), T(0)};
    const T drag = static_cast<T>(plan.drag);
    for (std::int64_t step = -1; step < run.steps; ++step) {
        const Done done = beside.forces(step);
        if (done != Done::well) return done;
        for (std::int64_t grip = 0; grip < plan.held.count(); ++grip) {
            const std::int64_t at = 4 * plan.rank[plan.held.particle[grip]];
            const T *const x = beside.x.data() + at, *const v = beside.v.data() + at;
            const Vec3<T> f = beside.pull(grip, step, {x[0], x[1], x[2]}, {v[0], v[1], v[2]}, true);
            beside.f[at] += f.x, beside.f[at + 1] += f.y, beside.f[at + 2] += f.z;
        }
        const Motion<T> m = Evaluate ? evaluation<T> : motion_of<T>(run, step);
        const auto all = [](T a) { return quad<T>{a, a, a, T(0)}; };
        const quad<T> kick = all(m.kick), now = all(m.now), earlier = all(m.before), drift = all(m.drift);
        for (std::int64_t i = 0; i < 4 * n; i += 4) {
            const T mass = inverse[i / 4];
            const quad<T> field = fma(all(-drag), load4(beside.v.data() + i), push);
            const quad<T> a = fma(all(mass > T(0) ? T(1) : T(0)), field, all(mass) * load4(beside.f.data() + i));
            const quad<T> v = fma(kick, a, load4(velocity.data() + i));
            store4(velocity.data() + i, v);
            store4(beside.v.data() + i, quad<T>(fma(now, a, fma(earlier, load4(before.data() + i), v))));
            store4(before.data() + i, a);
            const quad<T> x = load4(beside.x.data() + i);
            if constexpr (sizeof(T) == 8) {
                store4(beside.x.data() + i, fma(drift, v, x));
            } else {
                const quad<T> way = fma(drift, v, load4(carry.data() + i)), end = x + way;
                store4(carry.data() + i, quad<T>(way - (end - x)));
                store4(beside.x.data() + i, end);
            }
        }
    }
    for (int c = 0; c < 3; ++c)
        for (std::int64_t i = 0; i < n; ++i) {
            const std::int64_t at = 4 * plan.rank[i] + c, k = c * n + i;
            const double x = ended<T>(run.x0[k], beside.origin[c], beside.x[at], sizeof(T) == 4 ? carry[at] : T(0));
            if (run.v) run.v[k] = ended<T>(run.v0[k], 0.0, velocity[at], T(0));
            run.x[k] = x;
        }
    beside.finish();
    return Done::well;
}

inline Done evaluate_lists(Plan& plan, const Run& run) { return run_lists<double, true>(plan, run); }

}  // namespace cloth
