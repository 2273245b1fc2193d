// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs of whatever has no regular grid: meshes, raw springs, single particles. Particles lie as quads, in an order in
// which neighbours are close. Each thread has its own particles, and takes all elements that touch them.
#pragma once

#include "beside.hpp"
#include "threads.hpp"

namespace cloth {

/// With `Evaluate` one evaluation alone, at x0 and v0: accelerations come out in place of velocities.
template <class T, bool Evaluate>
class ListRun {
public:
    ListRun(Plan& plan, const Run& run)
        : plan_(plan), run_(run), beside_(plan, run), velocity_(plan.room<T>(run.room).more[0]),
          before_(plan.room<T>(run.room).more[1]), carry_(plan.room<T>(run.room).more[2]) {
        threads_ = beside_.alone() ? 1 : static_cast<int>(std::clamp<std::int64_t>(run.bands, 1, plan.count));
        borders_ = threads_ > 1 ? plan.even_borders(threads_) : std::vector<std::int64_t>{0, plan.count};
        beside_.make(borders_);
        beside_.hold(threads_);
        beside_.touch_ranks(threads_);
        const std::int64_t n = plan.count;
        velocity_.assign(4 * n, T(0));
        before_.assign(4 * n, T(0));
        carry_.assign(sizeof(T) == 4 ? 4 * n : 0, T(0));
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < n; ++i) {
                const std::int64_t at = 4 * plan.rank[i] + c;
                beside_.x[at] = static_cast<T>(run.x0[c * n + i] - beside_.origin[c]);
                beside_.v[at] = static_cast<T>(run.v0[c * n + i]);
                if (!Evaluate) velocity_[at] = beside_.v[at];
            }
        inverse_.resize(n);
        free_.resize(n);
        for (std::int64_t i = 0; i < n; ++i) {
            inverse_[plan.rank[i]] = static_cast<T>(plan.inverse[i]);
            free_[plan.rank[i]] = plan.inverse[i] > 0.0 ? T(1) : T(0);
        }
    }

    Done go() {
        Done done = Done::well;
        Barrier barrier(threads_);
        Pool::shared().run(
            threads_,
            [&](int own) {
                for (std::int64_t step = -1; step < run_.steps; ++step) {
                    force(step, own);
                    barrier.wait();  // positions are read up to here
                    move(step, own);
                    barrier.wait();
                }
            },
            [&] {
                for (std::int64_t step = -1; step < run_.steps && done == Done::well; ++step) {
                    for (int own = 0; own < threads_ && done == Done::well; ++own) done = force(step, own);
                    for (int own = 0; own < threads_ && done == Done::well; ++own) move(step, own);
                }
            });
        if (done == Done::well) unload();
        return done;
    }

private:
    Done force(std::int64_t step, int own) {
        beside_.follow(own, step);
        const Done done = beside_.forces(step, own);
        if (done != Done::well) return done;
        T* const f = (*beside_.shares)[own].f.data();
        for (std::int64_t grip = 0; grip < plan_.held.count(); ++grip) {
            const std::int64_t place = plan_.rank[plan_.held.particle[grip]];
            if (place < borders_[own] || place >= borders_[own + 1]) continue;
            const T *const x = beside_.x.data() + 4 * place, *const v = beside_.v.data() + 4 * place;
            const Vec3<T> pull = beside_.pull(own, grip, step, {x[0], x[1], x[2]}, {v[0], v[1], v[2]}, true);
            f[4 * place] += pull.x, f[4 * place + 1] += pull.y, f[4 * place + 2] += pull.z;
        }
        beside_.add_contact(own, step, f);
        return Done::well;
    }
    void move(std::int64_t step, int own) {
        // Asked for once: what is stored in the loop might be one of these addresses, as far as the compiler knows.
        const T *const f = (*beside_.shares)[own].f.data(), *const inverse = inverse_.data(), *const free = free_.data();
        T *const place = beside_.x.data(), *const seen = beside_.v.data();
        T *const velocity = velocity_.data(), *const before = before_.data(), *const carry = carry_.data();
        const quad<T> push{T(plan_.push(0)), T(plan_.push(1)), T(plan_.push(2)), T(0)};
        const Motion<T> m = Evaluate ? evaluation<T> : motion_of<T>(run_, step);
        const auto all = [](T a) { return quad<T>{a, a, a, a}; };
        const quad<T> kick = all(m.kick), now = all(m.now), earlier = all(m.before), drift = all(m.drift);
        const quad<T> drag = all(static_cast<T>(-plan_.drag));
        for (std::int64_t p = borders_[own]; p < borders_[own + 1]; ++p) {
            const std::int64_t i = 4 * p;
            const quad<T> field = fma(drag, load4(seen + i), push);
            const quad<T> a = fma(all(free[p]), field, all(inverse[p]) * load4(f + i));
            const quad<T> v = fma(kick, a, load4(velocity + i));
            store4(velocity + i, v);
            store4(seen + i, quad<T>(fma(now, a, fma(earlier, load4(before + i), v))));
            store4(before + i, a);
            const quad<T> x = load4(place + i);
            if constexpr (sizeof(T) == 8) {
                store4(place + i, fma(drift, v, x));
            } else {
                // Kahan's sum: the position carries what rounding takes from it.
                const quad<T> way = fma(drift, v, load4(carry + i)), end = x + way;
                store4(carry + i, quad<T>(way - (end - x)));
                store4(place + i, end);
            }
        }
    }
    void unload() {
        const std::int64_t n = plan_.count;
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < n; ++i) {
                const std::int64_t at = 4 * plan_.rank[i] + c, k = c * n + i;
                const T carry = sizeof(T) == 4 ? carry_[at] : T(0);
                if (run_.x) run_.x[k] = ended<T>(run_.x0[k], beside_.origin[c], beside_.x[at], carry);
                if (run_.v) run_.v[k] = ended<T>(run_.v0[k], 0.0, velocity_[at], T(0));
            }
        beside_.finish();
    }

    Plan& plan_;
    const Run& run_;
    Beside<T> beside_;
    Array<T>&velocity_, &before_, &carry_;
    int threads_ = 1;
    std::vector<std::int64_t> borders_;
    std::vector<T> inverse_, free_;  ///< 1/m, and one for free particles
};

template <class T>
inline Done run_lists(Plan& plan, const Run& run) {
    return ListRun<T, false>(plan, run).go();
}
inline Done evaluate_lists(Plan& plan, const Run& run) { return ListRun<double, true>(plan, run).go(); }

}  // namespace cloth
