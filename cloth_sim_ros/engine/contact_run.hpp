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
        if (plan.contacts.rough()) {
            held_.assign(blocks * contacts_.count() * anchor_numbers * pitch, T(0));
            for (std::int64_t i = 0; i < plan.count; ++i) where_.push_back(place_of(i));
            for_each_anchor([&](T& held, std::size_t from) { held = static_cast<T>(contacts_.anchors[from]); });
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
            T* const held = held_.empty() || !(contacts_.obstacles[obstacle].rough.still > 0.0)
                                ? nullptr
                                : held_.data() + (number * contacts_.count() + obstacle) * anchor_numbers * pitch_;
            T* const sums = own && run_.books && step >= 0 ? sums_of(number, obstacle) : nullptr;
            with_shape(contacts_.obstacles[obstacle].shape, [&](auto shape) {
                if (placed.turns())
                    one<shape.value, true>(mine, sleep, placed, obstacle, step, block, f, sums, held);
                else
                    one<shape.value, false>(mine, sleep, placed, obstacle, step, block, f, sums, held);
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
        if (run_.anchors)
            for_each_anchor([&](T& held, std::size_t to) { run_.anchors[to] = static_cast<double>(held); });
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

    /// Call `what` with each number of an anchor as the run holds it, and its place among the plan's.
    template <class F>
    void for_each_anchor(F&& what) {
        const std::int64_t k = contacts_.count(), n = static_cast<std::int64_t>(where_.size());
        for (std::int64_t obstacle = 0; obstacle < k; ++obstacle)
            for (int c = 0; c < anchor_numbers; ++c)
                for (std::int64_t i = 0; i < n; ++i) {
                    const std::int64_t row = (where_[i] / pitch_ * k + obstacle) * anchor_numbers + c;
                    what(held_[row * pitch_ + where_[i] % pitch_], (obstacle * anchor_numbers + c) * n + i);
                }
    }
    T* sums_of(std::int64_t block, std::int64_t obstacle) {
        return sums_.data() + (block * contacts_.count() + obstacle) * booked_numbers * ways;
    }
    template <Shape S, bool Turns>
    void one(Mine& mine, Sleep& sleep, const Placed<T>& placed, std::int64_t obstacle, std::int64_t step,
             const Block<T>& block, T* f, T* sums, T* held) {
        const Vec3<double>& all = contacts_.obstacles[obstacle].size;
        const Vec3<T> size{T(all.x), T(all.y), T(all.z)};
        const T thickness = T(contacts_.thickness), ahead = T(2.0 * run_.step);
        Found<T> found;
        // What touched will mostly touch again: one pass does for it.
        if (!sleep.touches) found = look<S, Turns, T>(placed, size, block, thickness, ahead);
        const Finding<T> finding(thickness, ahead);
        if (sleep.touches || found.gap < thickness) {
            if (held)
                found = push<S, Turns, true>(mine, placed, size, block, finding, f, sums, held, obstacle, step >= 0);
            else
                found = push<S, Turns, false>(mine, placed, size, block, finding, f, sums, held, obstacle, false);
        }
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
    /// Anchors of the obstacle lie in `held`; they move if `moves`.
    template <Shape S, bool Turns, bool Rough>
    Found<T> push(Mine& mine, const Placed<T>& placed, const Vec3<T>& size, const Block<T>& block, Finding<T> finding,
                  T* f, T* sums, [[maybe_unused]] T* held, [[maybe_unused]] std::int64_t obstacle,
                  [[maybe_unused]] bool moves) {
        const FrictionLaw<V> friction(contacts_.obstacles[obstacle].rough, contacts_.frequency);
        const V thickness = splat<V>(T(contacts_.thickness)), per = splat<V>(T(1.0 / ContactLaw<T>::speed));
        V reached{};
        for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>) {
            const V mass = load(block.mass + j);
            const Stand<V> s =
                stand<S, Turns, V>(placed, size, block.template place<V>(j), block.template velocity<V>(j));
            const auto inside = finding.take(s, mass) < thickness;
            const auto answer = law_.answer(s.gap, s.closing);
            Vec3<V> force = (mass * answer.push) * s.normal;
            V lost = mass * (answer.push - answer.elastic) * s.closing;
            if constexpr (Rough) {
                const V bond = load(held + 3 * pitch_ + j);
                const auto known = bond > V{};
                const Vec3<V> here = placed.template inward<V>(s.arm);
                const auto kept = [&](int c, V otherwise) CLOTH_INLINED {
                    return select(known, load(held + c * pitch_ + j), otherwise);
                };
                const Vec3<V> anchor{kept(0, here.x), kept(1, here.y), kept(2, here.z)};
                const Vec3<V> way = placed.template outward<V>(here - anchor);
                const auto rubbed = friction.rub(way, s.normal, s.slip, answer.push, bond > splat<V>(T(sticks)));
                const Vec3<V> along = mass * rubbed.push;
                force = force + along;
                lost = fma(mass, rubbed.lost, lost);
                if (moves) {
                    const Vec3<V> dragged = here - placed.template inward<V>(rubbed.stretch);
                    const auto keep = [&](int c, V a, V b) CLOTH_INLINED {
                        store<T>(held + c * pitch_ + j, select(inside, select(rubbed.slides, a, b), V{}));
                    };
                    keep(0, dragged.x, anchor.x);
                    keep(1, dragged.y, anchor.y);
                    keep(2, dragged.z, anchor.z);
                    keep(3, splat<V>(T(slides)), splat<V>(T(sticks)));
                }
            }
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
    Array<T> sums_, held_;
    std::vector<std::int64_t> where_;  ///< of each particle among the blocks
};

}  // namespace cloth
