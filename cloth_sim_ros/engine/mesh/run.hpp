// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs without a regular grid: meshes, raw springs, single particles. Particles are quads in an order with neighbours
// close together. Each thread has its own particles and evaluates all elements that touch them.
#pragma once

#include "core/thread_pool.hpp"
#include "mesh/added_mass.hpp"
#include "plan/off_grid_forces.hpp"

namespace cloth::mesh {

using plan::Partition, grid::StepFactors, plan::evaluation, plan::final_value, plan::OffGridForces, plan::Plan,
    plan::Run, plan::RunStatus;

/// With `Evaluate` a single evaluation at x0 and v0, which returns accelerations in place of velocities.
template <class T, bool Evaluate>
class ListRun {
public:
    ListRun(Plan& plan, const Run& run)
        : plan_(plan), run_(run), off_grid_(plan, run), velocity_(plan.workspace<T>(run.workspace).particle_arrays[0]),
          previous_acceleration_(plan.workspace<T>(run.workspace).particle_arrays[1]),
          compensation_(plan.workspace<T>(run.workspace).particle_arrays[2]),
          velocity_compensation_(plan.workspace<T>(run.workspace).particle_arrays[3]),
          middle_(plan.workspace<T>(run.workspace).middle_velocities) {
        threads_ =
            off_grid_.is_single_threaded() ? 1 : static_cast<int>(std::clamp<std::int64_t>(run.bands, 1, plan.count));
        borders_ = threads_ > 1 ? plan.even_borders(threads_) : std::vector<std::int64_t>{0, plan.count};
        off_grid_.allocate(borders_);
        off_grid_.prepare_poses(threads_);
        if (run.motion) run.motion->start<T>(plan.count, run.steps, run.step, threads_, run.x0, run.v0, plan.rank);
        off_grid_.init_contact_by_ranks(threads_);
        const std::int64_t n = plan.count;
        velocity_.assign(4 * n, T(0));
        previous_acceleration_.assign(4 * n, T(0));
        compensation_.assign(sizeof(T) == 4 ? 4 * n : 0, T(0));
        velocity_compensation_.assign(sizeof(T) == 4 ? 4 * n : 0, T(0));
        middle_.resize(run.activity ? 4 * n : 0);
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < n; ++i) {
                const std::int64_t at = 4 * plan.rank[i] + c;
                off_grid_.x[at] = static_cast<T>(run.x0[c * n + i] - off_grid_.origin[c]);
                off_grid_.v[at] = static_cast<T>(run.v0[c * n + i]);
                if (!Evaluate) velocity_[at] = off_grid_.v[at];
            }
        inverse_.resize(n);
        free_.resize(n);
        for (std::int64_t i = 0; i < n; ++i) {
            inverse_[plan.rank[i]] = static_cast<T>(plan.inverse[i]);
            free_[plan.rank[i]] = plan.inverse[i] > 0.0 ? T(1) : T(0);
        }
    }

    RunStatus execute() {
        RunStatus done = RunStatus::ok;
        Barrier barrier(threads_);
        ThreadPool::shared().run(
            threads_,
            [&](int thread) {
                for (std::int64_t step = -1; step < run_.steps; ++step) {
                    force(step, thread);
                    barrier.wait();  // all threads have read the positions
                    move(step, thread);
                    barrier.wait();
                }
            },
            [&] {
                for (std::int64_t step = -1; step < run_.steps && done == RunStatus::ok; ++step) {
                    for (int thread = 0; thread < threads_ && done == RunStatus::ok; ++thread)
                        done = force(step, thread);
                    for (int thread = 0; thread < threads_ && done == RunStatus::ok; ++thread) move(step, thread);
                }
            });
        if (done == RunStatus::ok) unload();
        return done;
    }

private:
    RunStatus force(std::int64_t step, int thread) {
        off_grid_.advance_jaws(thread, step);
        const RunStatus done = off_grid_.compute_forces(step, thread);
        if (done != RunStatus::ok) return done;
        T* const f = (*off_grid_.partitions)[thread].f.data();
        for (std::int64_t grip = 0; grip < plan_.grips.count(); ++grip) {
            if (plan_.grips.prescribed[grip]) continue;
            const std::int64_t rank = plan_.rank[plan_.grips.particle[grip]];
            if (rank < borders_[thread] || rank >= borders_[thread + 1]) continue;
            const T *const x = off_grid_.x.data() + 4 * rank, *const v = off_grid_.v.data() + 4 * rank;
            const Vec3<T> force = off_grid_.grip_force(
                thread, grip, step, {to_double<T>({x[0], x[1], x[2]}), to_double<T>({v[0], v[1], v[2]})}, true);
            f[4 * rank] += force.x, f[4 * rank + 1] += force.y, f[4 * rank + 2] += force.z;
        }
        off_grid_.add_contact(thread, step, f);
        if (off_grid_.has_prescribed() && plan_.has_added_mass()) hold(step, thread);
        return RunStatus::ok;
    }
    void move(std::int64_t step, int thread) {
        // Loaded once, because the compiler has to assume that the stores in the loop alias these pointers.
        const T *const f = (*off_grid_.partitions)[thread].f.data(), *const inverse = inverse_.data(),
                       *const free = free_.data();
        const T* const mass = plan_.has_added_mass() ? (*off_grid_.partitions)[thread].mass_blocks.data() : nullptr;
        if (mass) accelerate(thread, mass);
        T *const position_quads = off_grid_.x.data(), *const damping_v = off_grid_.v.data();
        T *const velocity = velocity_.data(), *const previous_a = previous_acceleration_.data(),
                 *const carry = compensation_.data(), *const velocity_carry = velocity_compensation_.data();
        const quad<T> body_acceleration{T(plan_.body_acceleration(0)), T(plan_.body_acceleration(1)),
                                        T(plan_.body_acceleration(2)), T(0)};
        const StepFactors<T> m = Evaluate ? evaluation<T> : motion_of<T>(run_, step);
        const auto all = [](T a) { return quad<T>{a, a, a, a}; };
        const quad<T> kick = all(m.kick), predict = all(m.predict), predict_previous = all(m.predict_previous),
                      drift = all(m.drift);
        const quad<T> drag = all(static_cast<T>(-plan_.drag));
        for (std::int64_t p = borders_[thread]; p < borders_[thread + 1]; ++p) {
            const std::int64_t i = 4 * p;
            const quad<T> field = fma(drag, load4(damping_v + i), body_acceleration);
            const quad<T> a = mass ? load4(f + i) : fma(all(free[p]), field, all(inverse[p]) * load4(f + i));
            quad<T> v, low_v{};
            if constexpr (sizeof(T) == 8) {
                v = fma(kick, a, load4(velocity + i));
            } else {
                // Kahan summation: constant accelerations would be rounded with one sign in each step.
                const quad<T> v_old = load4(velocity + i), increment = fma(kick, a, load4(velocity_carry + i));
                v = v_old + increment;
                low_v = increment - (v - v_old);
                store4(velocity_carry + i, low_v);
            }
            store4(velocity + i, v);
            store4(damping_v + i, quad<T>(fma(predict, a, fma(predict_previous, load4(previous_a + i), v))));
            store4(previous_a + i, a);
            const quad<T> x = load4(position_quads + i);
            if constexpr (sizeof(T) == 8) {
                store4(position_quads + i, fma(drift, v, x));
            } else {
                // Kahan summation: the compensation carries the rounding error of the position.
                const quad<T> increment = fma(drift, v, quad<T>(fma(drift, low_v, load4(carry + i)))),
                              end = x + increment;
                store4(carry + i, quad<T>(increment - (end - x)));
                store4(position_quads + i, end);
            }
        }
        if (!Evaluate && off_grid_.has_prescribed()) prescribe(step, thread);
        if (!Evaluate && run_.motion)
            off_grid_.record_motion(thread, step, velocity, borders_[thread], borders_[thread + 1]);
        if (run_.ends_first_half(step))
            std::copy(velocity + 4 * borders_[thread], velocity + 4 * borders_[thread + 1],
                      middle_.data() + 4 * borders_[thread]);
    }
    /// Replace the forces on the particles of a thread by their accelerations with the mass of the air.
    void accelerate(int thread, const T* mass) {
        using V = vec<T>;
        constexpr std::int64_t L = lanes<T>;
        T* const f = (*off_grid_.partitions)[thread].f.data();
        const T* const damping_v = off_grid_.v.data();
        const auto all = [](T a) { return quad<T>{a, a, a, a}; };
        const quad<T> body_acceleration{T(plan_.body_acceleration(0)), T(plan_.body_acceleration(1)),
                                        T(plan_.body_acceleration(2)), T(0)},
            drag = all(static_cast<T>(-plan_.drag));
        for (std::int64_t first = borders_[thread]; first < borders_[thread + 1]; first += L) {
            const std::int64_t n_lanes = std::min(L, borders_[thread + 1] - first);
            quad<T> rows[L] = {}, diagonal[L] = {}, off_diagonal[L] = {};
            alignas(64) T inverse[L] = {};
            for (std::int64_t k = 0; k < n_lanes; ++k) {
                const std::int64_t p = first + k;
                const quad<T> field = fma(drag, load4(damping_v + 4 * p), body_acceleration);
                rows[k] = fma(all(free_[p]), field, all(inverse_[p]) * load4(f + 4 * p));
                diagonal[k] = load4(mass + 8 * p), off_diagonal[k] = load4(mass + 8 * p + 4);
                inverse[k] = inverse_[p];
            }
            Vec3<V> a;
            Sym3<V> block;
            deinterleave(rows, a.x, a.y, a.z);
            deinterleave(diagonal, block.xx, block.yy, block.zz);
            deinterleave(off_diagonal, block.xy, block.xz, block.yz);
            a = laws::accelerated(block, load(inverse), a);
            interleave(a.x, a.y, a.z, rows);
            for (std::int64_t k = 0; k < n_lanes; ++k) store4(f + 4 * (first + k), rows[k]);
        }
    }
    /// The air at prescribed particles moves as they do: its inertia is a force on them.
    void hold(std::int64_t step, int thread) {
        Partition<T>& partition = (*off_grid_.partitions)[thread];
        for (std::int64_t grip = 0; grip < plan_.grips.count(); ++grip) {
            const std::int64_t rank = plan_.rank[plan_.grips.particle[grip]];
            if (!plan_.grips.prescribed[grip] || rank < borders_[thread] || rank >= borders_[thread + 1]) continue;
            T *const block = partition.mass_blocks.data() + 8 * rank, *const f = partition.f.data() + 4 * rank;
            const Vec3<T> inertia = off_grid_.air_inertia(grip, step, mass_block(block));
            f[0] -= inertia.x, f[1] -= inertia.y, f[2] -= inertia.z;
            std::fill_n(block, 8, T(0));
        }
    }
    /// Move prescribed particles to their points after a step.
    void prescribe(std::int64_t step, int thread) {
        for (std::int64_t grip = 0; grip < plan_.grips.count(); ++grip) {
            const std::int64_t rank = plan_.rank[plan_.grips.particle[grip]], at = 4 * rank;
            if (!plan_.grips.prescribed[grip] || rank < borders_[thread] || rank >= borders_[thread + 1]) continue;
            const T* const a = previous_acceleration_.data() + at;
            const auto end = off_grid_.prescribe(thread, grip, step, {a[0], a[1], a[2]}, true);
            const auto put = [&](Array<T>& to, Vec3<T> p) { to[at] = p.x, to[at + 1] = p.y, to[at + 2] = p.z; };
            put(off_grid_.x, narrowed<T>(end.x));
            put(velocity_, narrowed<T>(end.v));
            put(off_grid_.v, narrowed<T>(end.v));
            if constexpr (sizeof(T) == 4)
                put(compensation_, {T(0), T(0), T(0)}), put(velocity_compensation_, {T(0), T(0), T(0)});
        }
    }
    void unload() {
        const std::int64_t n = plan_.count;
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < n; ++i) {
                const std::int64_t at = 4 * plan_.rank[i] + c, k = c * n + i;
                const T carry = sizeof(T) == 4 ? compensation_[at] : T(0),
                        velocity_carry = sizeof(T) == 4 ? velocity_compensation_[at] : T(0);
                if (run_.x) run_.x[k] = final_value<T>(run_.x0[k], off_grid_.origin[c], off_grid_.x[at], carry);
                if (run_.v) run_.v[k] = final_value<T>(run_.v0[k], 0.0, velocity_[at], velocity_carry);
            }
        if (run_.activity) {
            plan::HalfDifference difference(run_);
            for (std::int64_t i = 0; i < n; ++i) {
                const std::int64_t at = 4 * plan_.rank[i];
                if (off_grid_.has_prescribed() && !(plan_.free_inverse[i] > 0.0)) continue;
                difference.add(i, n, middle_.data() + at, velocity_.data() + at, 1);
            }
            difference.store(run_.activity);
        }
        off_grid_.finish();
    }

    Plan& plan_;
    const Run& run_;
    OffGridForces<T> off_grid_;
    Array<T>&velocity_, &previous_acceleration_, &compensation_, &velocity_compensation_, &middle_;
    int threads_ = 1;
    std::vector<std::int64_t> borders_;
    std::vector<T> inverse_, free_;  ///< 1/m, and 1 for free particles
};

}  // namespace cloth::mesh
