// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What obstacles do to particles over a run. Particles are looked at in blocks, a grid's row or as many of a list's; a
// block that is far from an obstacle is left alone for as many steps as it takes to get near.
#pragma once

#include "plan.hpp"

namespace cloth {

template <class T>
class ContactRun {
public:
    /// `pitch` numbers lie from one block's particles to the next one's; `place_of(particle)` says where among them.
    template <class F>
    ContactRun(Plan& plan, const Run& run, const double* origin, int threads, std::int64_t blocks, std::int64_t pitch,
               F&& place_of)
        : contacts_(plan.contacts), run_(run), origin_(origin), law_(plan.contacts.template law<V>()), blocks_(blocks),
          pitch_(pitch), masses_(plan.room<T>().contact_masses) {
        for (int k = 0; k < threads; ++k) threads_.emplace_back(*this);
        if (static_cast<std::int64_t>(masses_.size()) != blocks * pitch) {
            masses_.assign(blocks * pitch, T(0));
            for (std::int64_t i = 0; i < plan.count; ++i)
                if (plan.inverse[i] > 0.0) masses_[place_of(i)] = static_cast<T>(plan.masses[i]);
        }
        if (run.books) sums_.assign(blocks * contacts_.count() * booked_numbers * ways, T(0));
    }

    /// Add the forces on a block's particles at positions x and velocities v to f, all by component; `own` books them.
    void add(int thread, std::int64_t number, std::int64_t step, const T* x, const T* v, T* f, std::int64_t count,
             bool own) {
        const Block<T> block{x, v, pitch_, masses_.data() + number * pitch_, count};
        Mine& mine = threads_[thread];
        for (const std::int64_t obstacle : contacts_.active) {
            Sleep& sleep = mine.sleeps[number * contacts_.count() + obstacle];
            if (step < sleep.until) continue;
            const Placed<T> placed(mine.poses.at(obstacle, step), origin_);
            T* const sums = own && run_.books && step >= 0 ? sums_of(number, obstacle) : nullptr;
            with_shape(contacts_.obstacles[obstacle].shape, [&](auto shape) {
                if (placed.turns())
                    one<shape.value, true>(mine, sleep, placed, obstacle, step, block, f, sums);
                else
                    one<shape.value, false>(mine, sleep, placed, obstacle, step, block, f, sums);
            });
        }
    }
    /// The same for particles as quads, a block of them.
    void add_quads(int thread, std::int64_t number, std::int64_t step, const T* x, const T* v, T* f, std::int64_t count) {
        Mine& mine = threads_[thread];
        bool all_far = true;
        for (const std::int64_t obstacle : contacts_.active)
            all_far = all_far && step < mine.sleeps[number * contacts_.count() + obstacle].until;
        if (all_far) return;
        T *const places = mine.spread.data(), *const speeds = places + 3 * pitch_, *const forces = speeds + 3 * pitch_;
        const auto spread = [&](const T* from, T* to) {
            for (std::int64_t i = 0; i < count; ++i)
                for (int c = 0; c < 3; ++c) to[c * pitch_ + i] = from[4 * i + c];
        };
        spread(x, places);
        spread(v, speeds);
        spread(f, forces);
        add(thread, number, step, places, speeds, forces, count, true);
        for (std::int64_t i = 0; i < count; ++i)
            for (int c = 0; c < 3; ++c) f[4 * i + c] = forces[c * pitch_ + i];
    }
    /// Sum up what was booked, in order of the blocks, and what was met.
    void finish() {
        if (!run_.touched) return;
        const std::int64_t k = contacts_.count();
        for (std::int64_t obstacle = 0; run_.books && obstacle < k; ++obstacle)
            for (int number = 0; number < booked_numbers; ++number) {
                double sum = 0.0;
                for (std::int64_t block = 0; block < blocks_; ++block) {
                    const T* const from = sums_of(block, obstacle) + number * ways;
                    for (int way = 0; way < ways; ++way) sum += static_cast<double>(from[way]);
                }
                run_.touched[obstacle * booked_numbers + number] += run_.step * sum;
            }
        Touched touched;
        for (const Mine& mine : threads_) {
            touched.reached = larger(static_cast<double>(mine.reached), touched.reached);
            touched.gap = smaller(static_cast<double>(mine.gap), touched.gap);
            touched.missed = touched.missed || mine.missed;
        }
        touched.to(run_.touched + k * booked_numbers);
    }

private:
    using V = vec<T>;
    /// What is booked is summed in so many sums, whatever the vectors' width.
    static constexpr int ways = 16;
    /// A block sleeps while the speed that it has, and so much more [m/s], would take it a quarter of the way.
    static constexpr double slack = 0.25, share = 0.25;

    struct Sleep {
        std::int64_t until = -2;
        T speed = T(0);  ///< that was counted with; zero where it did not sleep
        bool touches = false;
    };
    struct alignas(128) Mine {
        Poses poses;
        std::vector<Sleep> sleeps;
        Array<T> spread;
        T reached = T(0), gap = no_gap<T>;
        bool missed = false;
        explicit Mine(const ContactRun& run)
            : poses(run.contacts_.paths, run.run_.t, run.run_.step), sleeps(run.blocks_ * run.contacts_.count()),
              spread(9 * run.pitch_) {}
    };

    T* sums_of(std::int64_t block, std::int64_t obstacle) {
        return sums_.data() + (block * contacts_.count() + obstacle) * booked_numbers * ways;
    }
    template <Shape S, bool Turns>
    void one(Mine& mine, Sleep& sleep, const Placed<T>& placed, std::int64_t obstacle, std::int64_t step,
             const Block<T>& block, T* f, T* sums) {
        const Vec3<double>& all = contacts_.obstacles[obstacle].size;
        const Vec3<T> size{T(all.x), T(all.y), T(all.z)};
        const T thickness = T(contacts_.thickness), ahead = T(2.0 * run_.step);
        Found<T> found;
        // What touched will mostly touch again: one pass does for it.
        if (!sleep.touches) found = look<S, Turns, T>(placed, size, block, thickness, ahead);
        if (sleep.touches || found.gap < thickness)
            found = push<S, Turns>(mine, placed, size, block, Finding<T>(thickness, ahead), f, sums);
        sleep.touches = found.gap < thickness;
        mine.gap = smaller(found.gap, mine.gap);
        // Whoever comes into contact at a speed has to be followed at it, before it is there.
        const T entering = found.entering / T(ContactLaw<T>::speed);
        mine.reached = larger(entering * entering, mine.reached);
        mine.missed = mine.missed || (sleep.speed > T(0) && found.speed > T(2) * sleep.speed);
        sleep.speed = T(0);
        if (sleep.touches || !contacts_.sleeps || !run_.steps) return;
        const T speed = found.speed + T(slack), way = T(share) * (found.gap - thickness);
        const double steps = static_cast<double>(way) / (static_cast<double>(speed) * run_.step);
        const std::int64_t left = run_.steps - 1 - step;
        const bool soon = steps < static_cast<double>(left);
        sleep.until = step + std::max<std::int64_t>(1, soon ? static_cast<std::int64_t>(steps) : left);
        sleep.speed = speed;
    }
    template <Shape S, bool Turns>
    Found<T> push(Mine& mine, const Placed<T>& placed, const Vec3<T>& size, const Block<T>& block, Finding<T> finding,
                  T* f, T* sums) {
        const V thickness = splat<V>(T(contacts_.thickness)), per = splat<V>(T(1.0 / ContactLaw<T>::speed));
        V reached{};
        for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>) {
            const V mass = load(block.mass + j);
            const Stand<V> s =
                stand<S, Turns, V>(placed, size, block.template place<V>(j), block.template velocity<V>(j));
            const auto inside = finding.take(s, mass) < thickness;
            const auto answer = law_.answer(s.gap, s.closing);
            const Vec3<V> force = (mass * answer.push) * s.normal;
            const auto chosen = [&](V a) CLOTH_INLINED { return select(inside, a, V{}); };
            const auto add = [&](T* to, V a) CLOTH_INLINED {
                const V before = load(to);
                store<T>(to, select(inside, before + a, before));
            };
            add(f + j, force.x);
            add(f + pitch_ + j, force.y);
            add(f + 2 * pitch_ + j, force.z);
            const V speed = per * larger(s.closing, V{});
            reached = larger(chosen(fma(speed, speed, answer.shape)), reached);
            if (!sums) continue;
            const Vec3<V> torque = cross(force, s.arm);
            const V work = dot(force, splat3<V>(placed.speed) + cross(splat3<V>(placed.spin), s.arm));
            const V lost = mass * (answer.push - answer.elastic) * s.closing;
            const V booked[booked_numbers] = {-force.x, -force.y, -force.z, torque.x, torque.y, torque.z, work, lost};
            for (int number = 0; number < booked_numbers; ++number) {
                T* const sum = sums + number * ways + j % ways;
                store<T>(sum, load(sum) + chosen(booked[number]));
            }
        }
        for (int k = 0; k < lanes<T>; ++k) mine.reached = larger<T>(reached[k], mine.reached);
        return finding.found();
    }

    const Contacts& contacts_;
    const Run& run_;
    const double* origin_;
    ContactLaw<V> law_;
    std::int64_t blocks_, pitch_;
    Array<T>& masses_;
    std::vector<Mine> threads_;
    Array<T> sums_;
};

}  // namespace cloth
