// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What obstacles do to particles over a run. Particles are looked at in blocks, a grid's row or as many of a list's; a
// block that is far from an obstacle is left alone for as many steps as it takes to get near.
#pragma once

#include "contact_pinch_run.hpp"

namespace cloth {

template <class T>
class ContactRun {
public:
    /// `pitch` numbers lie from one block's particles to the next one's; `place_of(particle)` says where among them.
    template <class F>
    ContactRun(Plan& plan, const Run& run, const double* origin, int threads, std::int64_t blocks, std::int64_t pitch,
               F&& place_of)
        : contacts_(plan.contacts), run_(run), origin_(origin), law_(plan.contacts.template law<V>()), blocks_(blocks),
          pitch_(pitch), pinches_(plan.contacts, run, threads, blocks), masses_(plan.room<T>(run.room).contact_masses) {
        for (int k = 0; k < threads; ++k) threads_.emplace_back(*this);
        for (std::int64_t k = 0; k < contacts_.count(); ++k) fastest_.push_back(T(fastest_surface(k)));
        if (static_cast<std::int64_t>(masses_.size()) != blocks * pitch) {
            masses_.assign(blocks * pitch, T(0));
            for (std::int64_t i = 0; i < plan.count; ++i)
                if (plan.inverse[i] > 0.0) masses_[place_of(i)] = static_cast<T>(plan.masses[i]);
        }
        if (plan.contacts.rough()) {
            held_.assign(blocks * contacts_.count() * anchor_numbers * pitch, T(0));
            pushes_.assign(blocks * contacts_.count() * pitch, T(0));
            for (std::int64_t i = 0; i < plan.count; ++i) where_.push_back(place_of(i));
            for_each_anchor([&](T& held, std::size_t from) { held = static_cast<T>(contacts_.anchors[from]); });
        }
        if (run.books) sums_.assign(blocks * contacts_.count() * booked_numbers * ways, T(0));
        if (!contacts_.reduced.any()) return;
        if (run.books) grown_.assign(blocks * ways, T(0));
        reduced_.assign(contacts_.count() * blocks * pitch, T(contacts_.thickness));
        rates_.assign(reduced_.size(), T(0));
        for (std::int64_t k = 0; k < contacts_.count(); ++k)
            for (std::int64_t i = 0; i < plan.count; ++i) {
                const std::int64_t to = k * blocks * pitch + place_of(i), from = k * (plan.count + 1) + i;
                reduced_[to] = T(contacts_.reduced.at_start[from]);
                rates_[to] = T(contacts_.reduced.rates[from]);
            }
    }

    /// Move pads to a step, before any block is looked at: all blocks have been at the step before.
    void follow(int thread, std::int64_t step) { pinches_.follow(thread, step); }
    PinchRun& pinches() { return pinches_; }
    /// Add the forces on a block's particles at positions x and velocities v to f, all by component; `own` books them.
    void add(int thread, std::int64_t number, std::int64_t step, const T* x, const T* v, T* f, std::int64_t count,
             bool own) {
        const Block<T> block{x, v, pitch_, masses_.data() + number * pitch_, count};
        Mine& mine = threads_[thread];
        for (const std::int64_t obstacle : contacts_.active) {
            Sleep& sleep = mine.sleeps[number * contacts_.count() + obstacle];
            const bool pad = contacts_.obstacles[obstacle].pinch >= 0;
            if (pad) pinches_.feel(obstacle, number, step, {});
            if (step < sleep.until) continue;
            Felt felt;
            const Placed<T> placed = placed_at(mine, thread, obstacle, step);
            T* const held = held_.empty() || !(contacts_.obstacles[obstacle].rough.still > 0.0)
                                ? nullptr
                                : held_.data() + (number * contacts_.count() + obstacle) * anchor_numbers * pitch_;
            T* const sums = own && run_.books && step >= 0 ? sums_of(number, obstacle) : nullptr;
            Reduced reduced;
            if (!reduced_.empty()) {
                reduced.at_start = reduced_.data() + (obstacle * blocks_ + number) * pitch_;
                reduced.rates = rates_.data() + (obstacle * blocks_ + number) * pitch_;
                reduced.t = middle_of(run_, step);
                reduced.grown = sums ? grown_.data() + number * ways : nullptr;
            }
            with_shape(contacts_.obstacles[obstacle].shape, [&](auto shape) {
                Felt* const feel = pad ? &felt : nullptr;
                if (placed.turns())
                    one<shape.value, true>(mine, sleep, placed, obstacle, step, block, f, sums, held, feel, reduced);
                else
                    one<shape.value, false>(mine, sleep, placed, obstacle, step, block, f, sums, held, feel, reduced);
            });
            if (pad) pinches_.feel(obstacle, number, step, felt);
        }
    }
    /// The same for particles as quads, a block of them.
    void add_quads(int thread, std::int64_t number, std::int64_t step, const T* x, const T* v, T* f, std::int64_t count) {
        Mine& mine = threads_[thread];
        bool all_far = true;
        for (const std::int64_t obstacle : contacts_.active)
            all_far = all_far && step < mine.sleeps[number * contacts_.count() + obstacle].until;
        for (const std::int64_t obstacle : contacts_.active)
            if (contacts_.obstacles[obstacle].pinch >= 0) pinches_.feel(obstacle, number, step, {});
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
        Touched touched;
        double pinched = 0.0;
        for (const Mine& mine : threads_) {
            touched.reached = larger(static_cast<double>(mine.cloth.most()), touched.reached);
            touched.gap = smaller(smaller(mine.cloth.least(), mine.pads.least()), touched.gap);
            touched.missed = touched.missed || mine.missed;
            pinched = larger(static_cast<double>(mine.pads.most()), pinched);
        }
        if (run_.steps) touched.reached = pinches_.finish(touched.reached, pinched);
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
        touched.to(run_.touched + k * booked_numbers);
        double grown = 0.0;
        for (const T sum : grown_) grown += static_cast<double>(sum);
        run_.touched[k * booked_numbers + Touched::numbers + 3] = run_.step * grown;
    }

private:
    using V = vec<T>;
    using Felt = PinchRun::Felt;
    /// What is booked is summed in so many sums, whatever the vectors' width.
    static constexpr int ways = 16;
    /// A block that is far from an obstacle is skipped (sleeps) for the time in which its fastest particle, `slack`
    /// [m/s] faster than now, and the obstacle at its fastest would cover the fraction `share` of the distance to contact.
    static constexpr double slack = 0.25, share = 0.25;

    /// Of a block's contacts with an obstacle: their thickness at the start and its rates, null where it is the whole one,
    /// the time of the step, and sums of the power of their growth, or null.
    struct Reduced {
        const T *at_start = nullptr, *rates = nullptr;
        double t = 0.0;
        T* grown = nullptr;
    };
    struct Sleep {
        std::int64_t until = -2;
        T speed = T(0);  ///< that was counted with; zero where it did not sleep
        bool touches = false;
    };
    /// What was met, a number in each place of a vector: the least gap, the largest speed with which a particle was about to
    /// come into contact, and the largest energy per mass of one in contact.
    struct Met {
        V gap = splat<V>(no_gap<T>), entering{}, reached{};
        void take(const Finding<T>& finding) {
            gap = smaller(finding.least(), gap);
            entering = larger(finding.entering(), entering);
        }
        double least() const {
            T least = no_gap<T>;
            for (int k = 0; k < lanes<T>; ++k) least = smaller<T>(gap[k], least);
            return static_cast<double>(least);
        }
        /// The step has to be short enough for the speed of an impact before the particle is in contact.
        T most() const {
            T most = T(0);
            for (int k = 0; k < lanes<T>; ++k) {
                const T speed = entering[k] / T(ContactLaw<T>::speed);
                most = larger<T>(speed * speed, larger<T>(reached[k], most));
            }
            return most;
        }
    };
    struct alignas(128) Mine {
        Poses poses;
        std::vector<Sleep> sleeps;
        Array<T> spread;
        Met cloth, pads;  ///< at obstacles and at pads
        bool missed = false;
        explicit Mine(const ContactRun& run)
            : poses(run.contacts_.paths, run.run_.t, run.run_.step), sleeps(run.blocks_ * run.contacts_.count()),
              spread(9 * run.pitch_) {}
    };

    /// Bound of the speed of an obstacle's surface over the run [m/s]; infinite for a plane that turns.
    ///
    /// A path is a cubic, so its speed lies within the hull of three control points: those at either end, and between
    /// them. A rotation vector changes at least as fast as what it turns.
    double fastest_surface(std::int64_t obstacle) const {
        const double* const path = contacts_.path(obstacle);
        const double begin = run_.t - path[0], end = begin + run_.step * static_cast<double>(run_.steps);
        const auto most = [&](const double* a) {
            double square = 0.0;
            for (const auto& [sum, product] : {std::pair(2.0 * begin, begin * begin), std::pair(begin + end, begin * end),
                                               std::pair(2.0 * end, end * end)}) {
                Vec3<double> v{a[0] + sum * a[3] + 3.0 * product * a[6], a[1] + sum * a[4] + 3.0 * product * a[7],
                               a[2] + sum * a[5] + 3.0 * product * a[8]};
                square = larger(norm2(v), square);
            }
            return root(square);
        };
        const Pinch* const pinch = contacts_.pinch_of(obstacle);
        const double turn = most(path + 17);
        return most(path + 4) + (turn > 0.0 ? turn * contacts_.obstacles[obstacle].radius : 0.0) +
               (pinch ? pinch->speed : 0.0);
    }
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
    Placed<T> placed_at(Mine& mine, int thread, std::int64_t obstacle, std::int64_t step) const {
        const Pose& pose = mine.poses.at(obstacle, step);
        const Obstacle& what = contacts_.obstacles[obstacle];
        if (what.pinch < 0) return Placed<T>(pose, origin_, what);
        const Pose pad = pinches_.pose(thread, obstacle, pose);
        Placed<T> placed(pad, origin_, what);
        const Vec3<double> lever = pad.place - pose.place;
        placed.lever = {T(lever.x), T(lever.y), T(lever.z)};
        return placed;
    }
    T* sums_of(std::int64_t block, std::int64_t obstacle) {
        return sums_.data() + (block * contacts_.count() + obstacle) * booked_numbers * ways;
    }
    template <Shape S, bool Turns>
    void one(Mine& mine, Sleep& sleep, const Placed<T>& placed, std::int64_t obstacle, std::int64_t step,
             const Block<T>& block, T* f, T* sums, T* held, Felt* felt, const Reduced& reduced) {
        const Vec3<double>& all = contacts_.obstacles[obstacle].size;
        const Vec3<T> size{T(all.x), T(all.y), T(all.z)};
        const T thickness = T(contacts_.thickness), ahead = T(2.0 * run_.step);
        Met& met = felt ? mine.pads : mine.cloth;
        const auto looked = [&] {
            const Finding<T> finding = look<S, Turns, T>(placed, size, block, thickness, ahead);
            met.take(finding);
            return finding.found();
        };
        Found<T> found{};
        // A block in contact at its last look is most likely still in contact: it skips `look`, as `push` finds the
        // same.
        const bool looks = !sleep.touches;
        if (looks) found = looked();
        if (!looks || found.gap < thickness) {
            const Finding<T> finding(thickness, ahead);
            if (held)
                sleep.touches = push<S, Turns, true>(met, placed, size, block, finding, f, sums, held, obstacle, step >= 0,
                                                     felt, reduced);
            else
                sleep.touches = push<S, Turns, false>(met, placed, size, block, finding, f, sums, held, obstacle, false,
                                                      felt, reduced);
            if (!looks && !sleep.touches) found = looked();
        }
        mine.missed = mine.missed || (sleep.speed > T(0) && found.speed > T(2) * sleep.speed);
        sleep.speed = T(0);
        if (sleep.touches || !contacts_.sleeps || !run_.steps) return;
        // The obstacle's own speed now is part of what was found; it may be slow now and fast before the next look.
        const T speed = found.speed + T(2) * fastest_[obstacle] + T(slack), way = T(share) * (found.gap - thickness);
        const double steps = static_cast<double>(way) / (static_cast<double>(speed) * run_.step);
        const std::int64_t left = run_.steps - 1 - step;
        const bool soon = steps < static_cast<double>(left);
        sleep.until = step + std::max<std::int64_t>(1, soon ? static_cast<std::int64_t>(steps) : left);
        sleep.speed = speed;
    }
    /// Push a block's particles; return whether any is in contact. Anchors of the obstacle lie in `held`; they move if
    /// `moves`.
    template <Shape S, bool Turns, bool Rough>
    bool push(Met& met, const Placed<T>& placed, const Vec3<T>& size, const Block<T>& block, Finding<T> finding, T* f,
              T* sums, [[maybe_unused]] T* held, [[maybe_unused]] std::int64_t obstacle, [[maybe_unused]] bool moves,
              Felt* felt, const Reduced& reduced) {
        const FrictionLaw<V> friction(contacts_.obstacles[obstacle].rough, contacts_.frequency);
        const V thickness = splat<V>(T(contacts_.thickness)), per = splat<V>(T(1.0 / ContactLaw<T>::speed));
        [[maybe_unused]] const V half = splat<V>(T(0.5 * run_.step));
        V reached{};
        const Vec3<V> axis = splat3<V>(placed.rotation[1]);
        alignas(64) T opening[ways] = {}, touching[ways] = {};
        for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>) {
            const V mass = load(block.mass + j);
            Stand<V> s =
                stand<S, Turns, V>(placed, size, block.template place<V>(j), block.template velocity<V>(j));
            V closing = s.closing, grown{};
            Scaling<V> scaling = whole_thickness<V>();
            const V gap = s.gap;
            if (reduced.at_start) {
                scaling =
                    contacts_.reduced.template scaling<V>(load(reduced.at_start + j), load(reduced.rates + j), reduced.t);
                closing = fma(scaling.growth, gap, closing);
                s.gap = scaling.gap(gap);
                s.closing = scaling.scale * closing;
            }
            const auto inside = finding.take_gap(s, mass) < thickness;
            auto answer = law_.answer(s.gap, s.closing);
            if (reduced.at_start) {
                const V part = splat<V>(T(1)) / scaling.scale;
                answer.push = part * answer.push;
                answer.elastic = part * answer.elastic;
                const V energy = splat<V>(T(ContactLaw<T>::speed * ContactLaw<T>::speed)) * (part * part) * answer.shape;
                grown = mass * scaling.growth * fma(answer.push, gap, energy);
            }
            Vec3<V> force = (mass * answer.push) * s.normal;
            V lost = mass * (answer.push - answer.elastic) * closing;
            if constexpr (Rough) {
                const V bond = load(held + 3 * pitch_ + j);
                const auto known = bond > V{};
                const Vec3<V> here = placed.template inward<V>(s.arm);
                const auto kept = [&](int c, V otherwise) CLOTH_INLINED {
                    return select(known, load(held + c * pitch_ + j), otherwise);
                };
                const Vec3<V> anchor{kept(0, here.x), kept(1, here.y), kept(2, here.z)};
                const Vec3<V> way = placed.template outward<V>(here - anchor);
                const auto rubbed = friction.rub(way, s.normal, s.slip, answer.push);
                const Vec3<V> along = mass * rubbed.push;
                force = force + along;
                lost = fma(mass, rubbed.lost, lost);
                if (moves) {
                    // Forces are met at the middle of a step. Anchors go on to its end, by the slip now and the push
                    // carried on from the last step's: else they would lag by half a step.
                    const Vec3<V> rest = half * s.slip;
                    T* const last = pushes_.data() + (held - held_.data()) / anchor_numbers + j;
                    const V before = load(last), grown = select(before > V{}, answer.push - before, V{});
                    store<T>(last, select(inside, answer.push, V{}));
                    const V then = larger(fma(splat<V>(T(0.5)), grown, answer.push), V{});
                    const auto end = friction.tried(way + rest, s.normal, s.slip, then);
                    const Vec3<V> dragged = here + placed.template inward<V>(rest - end.stretch);
                    const auto keep = [&](int c, V a, V b) CLOTH_INLINED {
                        store<T>(held + c * pitch_ + j, select(inside, select(end.slides, a, b), V{}));
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
            if (felt) {
                add(opening + j % ways, dot(axis, -force));
                add(touching + j % ways, mass);
            }
            if (!sums) continue;
            if (reduced.grown) add(reduced.grown + j % ways, grown);
            const Vec3<V> torque = cross(force, felt ? s.arm + splat3<V>(placed.lever) : s.arm);
            const V work = dot(force, splat3<V>(placed.speed) + cross(splat3<V>(placed.spin), s.arm));
            const V booked[booked_numbers] = {-force.x, -force.y, -force.z, torque.x, torque.y, torque.z, work, lost};
            for (int number = 0; number < booked_numbers; ++number) {
                T* const sum = sums + number * ways + j % ways;
                store<T>(sum, load(sum) + chosen(booked[number]));
            }
        }
        met.take(finding);
        met.reached = larger(reached, met.reached);
        if (felt) {
            double sums_[2] = {0.0, 0.0};
            for (int way = 0; way < ways; ++way) {
                sums_[0] += static_cast<double>(opening[way]);
                sums_[1] += static_cast<double>(touching[way]);
            }
            *felt = {contacts_.obstacles[obstacle].side * sums_[0], sums_[1]};
        }
        return any(finding.least() < thickness);
    }

    const Contacts& contacts_;
    const Run& run_;
    const double* origin_;
    ContactLaw<V> law_;
    std::vector<T> fastest_;  ///< speed of each obstacle's surface at most [m/s]
    std::int64_t blocks_, pitch_;
    PinchRun pinches_;
    Array<T>& masses_;
    std::vector<Mine> threads_;
    Array<T> sums_, held_, pushes_;  ///< the pushes of friction's last step
    Array<T> reduced_, rates_, grown_;  ///< thickness of each contact, its rate, power of growth by the block
    std::vector<std::int64_t> where_;  ///< of each particle among the blocks
};

}  // namespace cloth
