// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact of particles with obstacles over a run. Particles are processed in blocks, rows of a grid or blocks of a
// list. A block far from an obstacle is skipped for as many steps as it needs to get near.
#pragma once

#include "contact/jaw_run.hpp"
#include "laws/friction.hpp"

namespace cloth::contact {

using laws::FrictionLaw, plan::Plan, plan::PoseCache, plan::record_numbers;

/// Index of a particle in the blocks of a run: by its rank, or by its row and column in a sheet.
struct ParticleSlots {
    const std::int64_t* rank;  ///< null for the rows of a sheet
    std::int64_t columns, pitch;
    std::int64_t operator()(std::int64_t i) const { return rank ? rank[i] : i / columns * pitch + i % columns; }
};

template <class T>
class ObstacleRun {
    using V = vec<T>;

public:
    /// The particles of consecutive blocks are `pitch` numbers apart.
    ObstacleRun(Plan& plan, const Run& run, const double* origin, int threads, std::int64_t blocks, std::int64_t pitch,
                const ParticleSlots& slot_of)
        : contacts_(plan.contacts), run_(run), origin_{origin[0], origin[1], origin[2]},
          law_(plan.contacts.template law<V>()), blocks_(blocks), pitch_(pitch),
          jaws_(plan.contacts, run, threads, blocks), masses_(plan.workspace<T>(run.workspace).contact_masses) {
        for (int k = 0; k < threads; ++k) threads_.emplace_back(*this);
        for (std::int64_t k = 0; k < contacts_.count(); ++k) max_surface_speeds_.push_back(T(max_surface_speed(k)));
        if (static_cast<std::int64_t>(masses_.size()) != blocks * pitch) {
            masses_.assign(blocks * pitch, T(0));
            for (std::int64_t i = 0; i < plan.count; ++i)
                if (plan.inverse[i] > 0.0) masses_[slot_of(i)] = static_cast<T>(plan.masses[i]);
        }
        for (const std::int64_t obstacle : contacts_.active)
            if (contacts_.obstacles[obstacle].has_friction()) friction_obstacles_.push_back(obstacle);
        if (const auto n = static_cast<std::int64_t>(friction_obstacles_.size())) {
            anchors_.assign(blocks * n * anchor_numbers * pitch, T(0));
            pushes_.assign(blocks * n * pitch, T(0));
            slots_.reserve(plan.count);
            for (std::int64_t i = 0; i < plan.count; ++i) slots_.push_back(slot_of(i));
            for_each_anchor([&](T& anchor, std::size_t from) { anchor = static_cast<T>(contacts_.anchors[from]); });
        }
        for (const Obstacle& obstacle : contacts_.obstacles)
            if (obstacle.mesh) hints_.resize(blocks * contacts_.count() * pitch);
        if (run.record_obstacles) sums_.assign(blocks * contacts_.count() * record_numbers * n_partials, T(0));
        if (!contacts_.reduced.any()) return;
        if (run.record_obstacles) growth_powers_.assign(blocks * n_partials, T(0));
        reduced_.assign(contacts_.count() * blocks * pitch, T(contacts_.thickness));
        rates_.assign(reduced_.size(), T(0));
        for (std::int64_t k = 0; k < contacts_.count(); ++k)
            for (std::int64_t i = 0; i < plan.count; ++i) {
                const std::int64_t to = k * blocks * pitch + slot_of(i), from = k * (plan.count + 1) + i;
                reduced_[to] = T(contacts_.reduced.at_start[from]);
                rates_[to] = T(contacts_.reduced.rates[from]);
            }
    }

    /// Advance the jaws to a step, before any block is processed and after all blocks have finished the step before.
    void advance_jaws(int thread, std::int64_t step) { jaws_.advance(thread, step); }
    JawRun& jaws() { return jaws_; }
    /// Add the forces on a block of particles at positions x and velocities v to f, all by component; `record`
    /// accumulates them.
    void add(int thread, std::int64_t index, std::int64_t step, const T* x, const T* v, T* f, std::int64_t count,
             bool record) {
        const Block<T> block{x, v, pitch_, masses_.data() + index * pitch_, count};
        ThreadState& state = threads_[thread];
        std::int64_t friction_rank = 0;
        for (const std::int64_t obstacle : contacts_.active) {
            const std::int64_t rank = contacts_.obstacles[obstacle].has_friction() ? friction_rank++ : -1;
            SkipState& skip = state.skips[index * contacts_.count() + obstacle];
            const bool is_jaw = contacts_.obstacles[obstacle].parallel_jaw >= 0;
            if (is_jaw) jaws_.record_load(obstacle, index, step, {});
            if (step < skip.until) continue;
            JawLoad jaw_load;
            const PosedObstacle<T> posed = posed_at(state, thread, obstacle, step);
            T limit = no_gap<T>;
            Index* hints = nullptr;
            if (posed.mesh) {
                hints = hints_.data() + (index * contacts_.count() + obstacle) * pitch_;
                const ScanResult<T> bound = bound_block(posed, contacts_.obstacles[obstacle], block);
                // One evaluation needs no approach.
                limit = T(contacts_.thickness) + (run_.steps ? T(2.0 * run_.step) * bound.speed : T(0));
                if (skip_far_mesh(skip, bound, limit, obstacle, step)) continue;
            }
            T* const anchors = rank < 0 ? nullptr : anchors_.data() + anchor_row(index, rank) * pitch_;
            T* const sums = record && run_.record_obstacles && step >= 0 ? sums_of(index, obstacle) : nullptr;
            Reduced reduced;
            if (!reduced_.empty()) {
                reduced.at_start = reduced_.data() + (obstacle * blocks_ + index) * pitch_;
                reduced.rates = rates_.data() + (obstacle * blocks_ + index) * pitch_;
                reduced.t = midpoint_time(run_, step);
                reduced.growth_power = sums ? growth_powers_.data() + index * n_partials : nullptr;
            }
            with_shape(contacts_.obstacles[obstacle].shape, [&](auto shape) {
                JawLoad* const load_of_jaw = is_jaw ? &jaw_load : nullptr;
                if (posed.is_rotating())
                    add_obstacle<shape.value, true>(state, skip, posed, obstacle, step, block, f, sums, anchors,
                                                    load_of_jaw, reduced, limit, hints);
                else
                    add_obstacle<shape.value, false>(state, skip, posed, obstacle, step, block, f, sums, anchors,
                                                     load_of_jaw, reduced, limit, hints);
            });
            if (is_jaw) jaws_.record_load(obstacle, index, step, jaw_load);
        }
    }
    /// Record a violation if a block that is skipped is faster than assumed, by its squared speeds [m^2/s^2].
    void check_speed(int thread, std::int64_t index, std::int64_t step, V square) {
        ThreadState& state = threads_[thread];
        for (const std::int64_t obstacle : contacts_.active) {
            const SkipState& skip = state.skips[index * contacts_.count() + obstacle];
            if (!(skip.speed > T(0)) || step >= skip.until) continue;
            state.violated = state.violated || any(square > splat<V>(T(4) * skip.speed * skip.speed));
        }
    }
    /// The same for a block of particles as quads.
    void add_quads(int thread, std::int64_t index, std::int64_t step, const T* x, const T* v, T* f,
                   std::int64_t count) {
        ThreadState& state = threads_[thread];
        bool all_skipped = true;
        for (const std::int64_t obstacle : contacts_.active)
            all_skipped = all_skipped && step < state.skips[index * contacts_.count() + obstacle].until;
        for (const std::int64_t obstacle : contacts_.active)
            if (contacts_.obstacles[obstacle].parallel_jaw >= 0) jaws_.record_load(obstacle, index, step, {});
        if (all_skipped) return;
        T *const positions = state.buffer.data(), *const velocities = positions + 3 * pitch_,
                 *const forces = velocities + 3 * pitch_;
        const auto to_components = [&](const T* from, T* to) {
            for (std::int64_t i = 0; i < count; ++i)
                for (int c = 0; c < 3; ++c) to[c * pitch_ + i] = from[4 * i + c];
        };
        to_components(x, positions);
        to_components(v, velocities);
        to_components(f, forces);
        add(thread, index, step, positions, velocities, forces, count, true);
        for (std::int64_t i = 0; i < count; ++i)
            for (int c = 0; c < 3; ++c) f[4 * i + c] = forces[c * pitch_ + i];
    }
    /// Sum up the records in order of the blocks, and the contact summary. The run's anchors at other obstacles stay.
    void finish() {
        if (run_.anchors)
            for_each_anchor([&](T& anchor, std::size_t to) { run_.anchors[to] = static_cast<double>(anchor); });
        ContactSummary summary;
        double jaw_energy = 0.0;
        for (const ThreadState& state : threads_) {
            summary.energy = larger(static_cast<double>(state.obstacles.max_energy()), summary.energy);
            summary.gap = smaller(smaller(state.obstacles.min_gap(), state.jaws.min_gap()), summary.gap);
            summary.violated = summary.violated || state.violated;
            jaw_energy = larger(static_cast<double>(state.jaws.max_energy()), jaw_energy);
        }
        if (run_.steps) summary.energy = jaws_.finish(summary.energy, jaw_energy);
        if (!run_.contact_record) return;
        const std::int64_t k = contacts_.count();
        for (std::int64_t obstacle = 0; run_.record_obstacles && obstacle < k; ++obstacle)
            for (int component = 0; component < record_numbers; ++component) {
                double sum = 0.0;
                for (std::int64_t block = 0; block < blocks_; ++block) {
                    const T* const from = sums_of(block, obstacle) + component * n_partials;
                    for (int partial = 0; partial < n_partials; ++partial) sum += static_cast<double>(from[partial]);
                }
                run_.contact_record[obstacle * record_numbers + component] += run_.step * sum;
            }
        summary.write(run_.contact_record + k * record_numbers);
        double growth_power = 0.0;
        for (const T sum : growth_powers_) growth_power += static_cast<double>(sum);
        run_.contact_record[k * record_numbers + ContactSummary::numbers + 3] = run_.step * growth_power;
    }

private:
    using JawLoad = JawRun::JawLoad;
    /// Number of partial sums of a record, independent of the vector width.
    static constexpr int n_partials = 16;
    /// A block far from an obstacle is skipped for the time in which its fastest particle, `speed_margin` [m/s] faster
    /// than now, and the obstacle at its largest speed cover the fraction `skip_fraction` of the distance to contact.
    static constexpr double speed_margin = 0.25, skip_fraction = 0.25;

    /// Reduced thickness of a block's contacts with an obstacle: at the start, and its rates, null if it is the full
    /// one; the time of the step; sums of the growth power, or null.
    struct Reduced {
        const T *at_start = nullptr, *rates = nullptr;
        double t = 0.0;
        T* growth_power = nullptr;
    };
    struct SkipState {
        std::int64_t until = -2;
        T speed = T(0);  ///< assumed speed; zero if the block was not skipped
        bool in_contact = false;
    };
    /// Contact of a thread, by lane: least gap, largest closing speed of a particle about to touch, and largest energy
    /// per mass in contact.
    struct Encounter {
        V gap = splat<V>(no_gap<T>), approach_speed{}, energy{};
        void include(const BlockScan<T>& scan) {
            gap = smaller(scan.min_gap(), gap);
            approach_speed = larger(scan.approach_speed(), approach_speed);
        }
        double min_gap() const {
            T min = no_gap<T>;
            for (int k = 0; k < lanes<T>; ++k) min = smaller<T>(gap[k], min);
            return static_cast<double>(min);
        }
        /// The step has to be short enough for the impact speed before the particle is in contact.
        T max_energy() const {
            T max = T(0);
            for (int k = 0; k < lanes<T>; ++k) {
                const T speed = approach_speed[k] / T(ContactLaw<T>::speed);
                max = larger<T>(speed * speed, larger<T>(energy[k], max));
            }
            return max;
        }
    };
    struct alignas(128) ThreadState {
        PoseCache poses;
        std::vector<SkipState> skips;
        Array<T> buffer;
        Encounter obstacles, jaws;  ///< with obstacles and with jaws
        bool violated = false;
        explicit ThreadState(const ObstacleRun& run)
            : poses(run.contacts_.paths, run.run_.t, run.run_.step), skips(run.blocks_ * run.contacts_.count()),
              buffer(9 * run.pitch_) {}
    };

    /// Upper bound of the speed of an obstacle's surface over the run [m/s]; infinite for a plane that rotates.
    ///
    /// A path is a cubic, so its velocity lies in the convex hull of three control points: those at either end, and the
    /// one between them. A rotation vector changes at least as fast as the rotation.
    double max_surface_speed(std::int64_t obstacle) const {
        const double* const path = contacts_.path(obstacle);
        const double begin = run_.t - path[0], end = begin + run_.step * static_cast<double>(run_.steps);
        const auto max_speed = [&](const double* a) {
            double square = 0.0;
            for (const auto& [sum, product] : {std::pair(2.0 * begin, begin * begin),
                                               std::pair(begin + end, begin * end), std::pair(2.0 * end, end * end)}) {
                Vec3<double> v{a[0] + sum * a[3] + 3.0 * product * a[6], a[1] + sum * a[4] + 3.0 * product * a[7],
                               a[2] + sum * a[5] + 3.0 * product * a[8]};
                square = larger(norm2(v), square);
            }
            return root(square);
        };
        const ParallelJaw* const jaw = contacts_.jaw_of(obstacle);
        const double angular_speed = max_speed(path + 17);
        return max_speed(path + 4) +
               (angular_speed > 0.0 ? angular_speed * contacts_.obstacles[obstacle].radius : 0.0) +
               (jaw ? jaw->speed : 0.0);
    }
    /// Call `visit` with each number of an anchor in the run, and its index among those of the plan.
    template <class F>
    void for_each_anchor(F&& visit) {
        const std::int64_t n = static_cast<std::int64_t>(slots_.size());
        for (std::size_t rank = 0; rank < friction_obstacles_.size(); ++rank)
            for (int c = 0; c < anchor_numbers; ++c)
                for (std::int64_t i = 0; i < n; ++i) {
                    const std::int64_t row = anchor_row(slots_[i] / pitch_, rank) + c;
                    visit(anchors_[row * pitch_ + slots_[i] % pitch_],
                          (friction_obstacles_[rank] * anchor_numbers + c) * n + i);
                }
    }
    /// Row of a block's first anchor number at the obstacle of a rank in `friction_obstacles_`.
    std::int64_t anchor_row(std::int64_t block, std::int64_t rank) const {
        return (block * static_cast<std::int64_t>(friction_obstacles_.size()) + rank) * anchor_numbers;
    }
    PosedObstacle<T> posed_at(ThreadState& state, int thread, std::int64_t obstacle, std::int64_t step) const {
        const Pose& pose = state.poses.at(obstacle, step);
        const Obstacle& properties = contacts_.obstacles[obstacle];
        if (properties.parallel_jaw < 0) return PosedObstacle<T>(pose, properties, origin_);
        const Pose jaw_pose = jaws_.pose(thread, obstacle, pose);
        PosedObstacle<T> posed(jaw_pose, properties, origin_);
        const Vec3<double> lever = jaw_pose.position - pose.position;
        posed.lever = {T(lever.x), T(lever.y), T(lever.z)};
        return posed;
    }
    T* sums_of(std::int64_t block, std::int64_t obstacle) {
        return sums_.data() + (block * contacts_.count() + obstacle) * record_numbers * n_partials;
    }
    /// Skip a block whose bounds show that it is further from a mesh than a limit [m]; return whether it does.
    bool skip_far_mesh(SkipState& skip, const ScanResult<T>& bound, T limit, std::int64_t obstacle,
                       std::int64_t step) const {
        if (skip.in_contact || !contacts_.may_skip_blocks || !run_.steps) return false;
        if (!(bound.gap > limit) || (skip.speed > T(0) && bound.speed > T(2) * skip.speed)) return false;
        skip_steps(skip, bound, obstacle, step);
        return true;
    }
    /// Skip a block for as many steps as it needs to get near.
    void skip_steps(SkipState& skip, const ScanResult<T>& result, std::int64_t obstacle, std::int64_t step) const {
        // The result includes the present speed of the obstacle only; it may be faster before the next scan.
        const T speed = result.speed + T(2) * max_surface_speeds_[obstacle] + T(speed_margin),
                free_path = T(skip_fraction) * (result.gap - T(contacts_.thickness));
        const double steps = static_cast<double>(free_path) / (static_cast<double>(speed) * run_.step);
        const std::int64_t n_left = run_.steps - 1 - step;
        const bool before_end = steps < static_cast<double>(n_left);
        skip.until = step + std::max<std::int64_t>(1, before_end ? static_cast<std::int64_t>(steps) : n_left);
        skip.speed = speed;
    }
    /// Add the contact of a block with one obstacle. Gaps of a mesh above `limit` [m] may be lower bounds.
    template <Shape S, bool Rotating>
    void add_obstacle(ThreadState& state, SkipState& skip, const PosedObstacle<T>& posed, std::int64_t obstacle,
                      std::int64_t step, const Block<T>& block, T* f, T* sums, T* anchors, JawLoad* jaw_load,
                      const Reduced& reduced, T limit, Index* hints) {
        const Vec3<double>& dimensions = contacts_.obstacles[obstacle].size;
        const Vec3<T> size{T(dimensions.x), T(dimensions.y), T(dimensions.z)};
        const T thickness = T(contacts_.thickness), lookahead = T(2.0 * run_.step);
        Encounter& encounter = jaw_load ? state.jaws : state.obstacles;
        const auto scan = [&] {
            const BlockScan<T> finding =
                scan_block<S, Rotating, T>(posed, size, block, thickness, lookahead, limit, hints);
            encounter.include(finding);
            return finding.result();
        };
        ScanResult<T> result{};
        // A block in contact in the last step most likely still is: it skips the scan, because `add_contact_forces`
        // finds the same.
        const bool must_scan = !skip.in_contact;
        if (must_scan) result = scan();
        if (!must_scan || result.gap < thickness) {
            const BlockScan<T> block_scan(thickness, lookahead);
            if (anchors)
                skip.in_contact =
                    add_contact_forces<S, Rotating, true>(encounter, posed, size, block, block_scan, f, sums, anchors,
                                                          obstacle, step >= 0, jaw_load, reduced, limit, hints);
            else
                skip.in_contact =
                    add_contact_forces<S, Rotating, false>(encounter, posed, size, block, block_scan, f, sums, anchors,
                                                           obstacle, false, jaw_load, reduced, limit, hints);
            if (!must_scan && !skip.in_contact) result = scan();
        }
        state.violated = state.violated || (skip.speed > T(0) && result.speed > T(2) * skip.speed);
        skip.speed = T(0);
        if (skip.in_contact || !contacts_.may_skip_blocks || !run_.steps) return;
        skip_steps(skip, result, obstacle, step);
    }
    /// Add the contact forces on a block of particles; return whether any is in contact. `anchors` of the obstacle move
    /// if `move_anchors`.
    template <Shape S, bool Rotating, bool Friction>
    bool add_contact_forces(Encounter& encounter, const PosedObstacle<T>& posed, const Vec3<T>& size,
                            const Block<T>& block, BlockScan<T> scan, T* f, T* sums, [[maybe_unused]] T* anchors,
                            [[maybe_unused]] std::int64_t obstacle, [[maybe_unused]] bool move_anchors,
                            JawLoad* jaw_load, const Reduced& reduced, T limit, Index* hints) {
        const FrictionLaw<V> friction(contacts_.obstacles[obstacle].friction, contacts_.frequency);
        const V thickness = splat<V>(T(contacts_.thickness)), inverse_speed = splat<V>(T(1.0 / ContactLaw<T>::speed));
        [[maybe_unused]] const V half = splat<V>(T(0.5 * run_.step));
        V energy{};
        const Vec3<V> axis = splat3<V>(posed.rotation[1]);
        alignas(64) T opening_force[n_partials] = {}, contact_mass[n_partials] = {};
        for (std::ptrdiff_t j = 0; j < block.count; j += lanes<T>) {
            const V mass = load(block.mass + j);
            ContactKinematics<V> s =
                contact_kinematics<S, Rotating, V>(posed, size, block.template position<V>(j),
                                                   block.template velocity<V>(j), limit, hints ? hints + j : nullptr);
            V closing = s.closing, growth_power{};
            Scaling<V> scaling = full_thickness<V>();
            const V gap = s.gap;
            if (reduced.at_start) {
                scaling = contacts_.reduced.template scaling<V>(load(reduced.at_start + j), load(reduced.rates + j),
                                                                reduced.t);
                closing = fma(scaling.growth, gap, closing);
                s.gap = scaling.gap(gap);
                s.closing = scaling.scale * closing;
            }
            const auto in_contact = scan.include_gap(s, mass) < thickness;
            auto law_force = law_.force(s.gap, s.closing);
            if (reduced.at_start) {
                const V inverse_scale = splat<V>(T(1)) / scaling.scale;
                law_force.push = inverse_scale * law_force.push;
                law_force.elastic = inverse_scale * law_force.elastic;
                const V energy = splat<V>(T(ContactLaw<T>::speed * ContactLaw<T>::speed)) *
                                 (inverse_scale * inverse_scale) * law_force.shape;
                growth_power = mass * scaling.growth * fma(law_force.push, gap, energy);
            }
            Vec3<V> force = (mass * law_force.push) * s.normal;
            [[maybe_unused]] V friction_dissipation{};
            if constexpr (Friction) {
                const V bond = load(anchors + 3 * pitch_ + j);
                const auto bonded = bond > V{};
                const Vec3<V> local = posed.template inward<V>(s.arm);
                const auto anchor_or = [&](int c, V otherwise) CLOTH_INLINED {
                    return select(bonded, load(anchors + c * pitch_ + j), otherwise);
                };
                const Vec3<V> anchor{anchor_or(0, local.x), anchor_or(1, local.y), anchor_or(2, local.z)};
                const Vec3<V> offset = posed.template outward<V>(local - anchor);
                const auto friction_force = friction.force(offset, s.normal, s.slip, law_force.push);
                const Vec3<V> tangential = mass * friction_force.push;
                force = force + tangential;
                friction_dissipation = friction_force.dissipation;
                if (move_anchors) {
                    // Forces are evaluated at the middle of a step. Anchors are advanced to its end, by the present
                    // relative velocity and the extrapolated push; otherwise they would lag by half a step.
                    const Vec3<V> remaining = half * s.slip;
                    T* const previous_push = pushes_.data() + (anchors - anchors_.data()) / anchor_numbers + j;
                    const V previous = load(previous_push),
                            increase = select(previous > V{}, law_force.push - previous, V{});
                    store<T>(previous_push, select(in_contact, law_force.push, V{}));
                    const V end_push = larger(fma(splat<V>(T(0.5)), increase, law_force.push), V{});
                    const auto end = friction.radial_return(offset + remaining, s.normal, s.slip, end_push);
                    const V next_bond =
                        select(in_contact, select(end.slides, splat<V>(T(slides)), splat<V>(T(sticks))), V{});
                    // Most anchors stay: those that stick, and those out of contact, which are zero.
                    if (any((end.slides & in_contact) | (next_bond != bond))) {
                        const Vec3<V> dragged = local + posed.template inward<V>(remaining - end.stretch);
                        const auto store_anchor = [&](int c, V a, V b) CLOTH_INLINED {
                            store<T>(anchors + c * pitch_ + j, select(in_contact, select(end.slides, a, b), V{}));
                        };
                        store_anchor(0, dragged.x, anchor.x);
                        store_anchor(1, dragged.y, anchor.y);
                        store_anchor(2, dragged.z, anchor.z);
                        store<T>(anchors + 3 * pitch_ + j, next_bond);
                    }
                }
            }
            const auto chosen = [&](V a) CLOTH_INLINED { return select(in_contact, a, V{}); };
            const auto add = [&](T* to, V a) CLOTH_INLINED {
                const V before = load(to);
                store<T>(to, select(in_contact, before + a, before));
            };
            add(f + j, force.x);
            add(f + pitch_ + j, force.y);
            add(f + 2 * pitch_ + j, force.z);
            const V speed = inverse_speed * larger(s.closing, V{});
            energy = larger(chosen(fma(speed, speed, law_force.shape)), energy);
            if (jaw_load) {
                add(opening_force + j % n_partials, dot(axis, -force));
                add(contact_mass + j % n_partials, mass);
            }
            if (!sums) continue;
            if (reduced.growth_power) add(reduced.growth_power + j % n_partials, growth_power);
            const Vec3<V> torque = cross(force, jaw_load ? s.arm + splat3<V>(posed.lever) : s.arm);
            const V power = dot(force, splat3<V>(posed.velocity) + cross(splat3<V>(posed.spin), s.arm));
            V dissipation = mass * (law_force.push - law_force.elastic) * closing;
            if constexpr (Friction) dissipation = fma(mass, friction_dissipation, dissipation);
            const V record[record_numbers] = {-force.x, -force.y, -force.z, torque.x,
                                              torque.y, torque.z, power,    dissipation};
            for (int component = 0; component < record_numbers; ++component) {
                T* const sum = sums + component * n_partials + j % n_partials;
                store<T>(sum, load(sum) + chosen(record[component]));
            }
        }
        encounter.include(scan);
        encounter.energy = larger(energy, encounter.energy);
        if (jaw_load) {
            double totals[2] = {0.0, 0.0};
            for (int partial = 0; partial < n_partials; ++partial) {
                totals[0] += static_cast<double>(opening_force[partial]);
                totals[1] += static_cast<double>(contact_mass[partial]);
            }
            *jaw_load = {contacts_.obstacles[obstacle].jaw_side * totals[0], totals[1]};
        }
        return any(scan.min_gap() < thickness);
    }

    const Contacts& contacts_;
    const Run& run_;
    const Vec3<double> origin_;
    ContactLaw<V> law_;
    std::vector<T> max_surface_speeds_;  ///< upper bounds of the surface speed of each obstacle [m/s]
    std::int64_t blocks_, pitch_;
    JawRun jaws_;
    Array<T>& masses_;
    std::vector<ThreadState> threads_;
    std::vector<std::int64_t> friction_obstacles_;  ///< active obstacles with friction
    Array<T> sums_, anchors_, pushes_;              ///< by block and rank: anchors, and the last step's friction pushes
    Array<T> reduced_, rates_, growth_powers_;      ///< thickness of each contact, its rate, growth power by block
    std::vector<Index> hints_;                      ///< of meshes: a near triangle of each particle
    std::vector<std::int64_t> slots_;               ///< slot of each particle in the blocks
};

}  // namespace cloth::contact
