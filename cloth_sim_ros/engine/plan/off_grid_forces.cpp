// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of contact over a run, and of the forces besides the springs of a sheet.

#include "plan/off_grid_forces.hpp"

#include <limits>

#include "contact/feature_run.hpp"
#include "contact/obstacle_run.hpp"
#include "contact/self_run.hpp"
#include "mesh/added_mass.hpp"
#include "plan/grip_force.hpp"
#include "plan/queries.hpp"
#include "plan/runs.hpp"

namespace cloth::plan {

using contact::contact_block, contact::ContactBounds, contact::ContactSummary, grid::damping_velocity;

Plan::Plan() = default;
Plan::~Plan() = default;
bool Plan::has_self_friction() const { return self && self->has_friction(); }
bool Plan::is_feature_active() const { return features && features->any(); }

template <class T>
OffGridForces<T>::OffGridForces(Plan& plan, const Run& run)
    : plan(plan), run(run), multirate(run.multirate > 1 && plan.has_hinges()),
      has_lists(multirate || plan.has_off_grid_lists()), has_fast_lists(plan.has_fast_off_grid_lists()),
      x(plan.workspace<T>(run.workspace).quads[0]), v(plan.workspace<T>(run.workspace).quads[1]) {
    if constexpr (sizeof(T) == 4)
        for (int c = 0; c < 3; ++c) origin[c] = run.x0[c * plan.count];
    grip_sums.assign(plan.grips.count() * record_numbers, 0.0);
    if constexpr (sizeof(T) == 8) {
        if (plan.is_self_active()) {
            self = std::make_unique<SelfRun>(plan.self->neighbors(run.workspace), plan.contacts.thickness,
                                             plan.contacts.damping, run.step);
            if (plan.self->has_friction())
                self->enable_friction(plan.self->friction, plan.contacts.frequency, plan.layer_anchors());
            if (plan.contacts.reduced.any()) self->reduce(plan, run);
        }
        if (plan.is_feature_active()) features = std::make_unique<FeatureRun>(*plan.features, plan.contacts, run);
    }
}
template <class T>
OffGridForces<T>::~OffGridForces() = default;

template <class T>
void OffGridForces<T>::init_contact(int threads, std::int64_t blocks, std::int64_t pitch,
                                    const ParticleSlots& slot_of) {
    if (!has_near_obstacles()) return;
    contact = std::make_unique<ObstacleRun<T>>(plan, run, origin, threads, blocks, pitch, slot_of);
    if (features) features->set_jaws(contact->jaws());
}

template <class T>
void OffGridForces<T>::init_contact_by_rows(int threads, std::int64_t pitch) {
    const std::int64_t columns = plan.grid->columns;
    init_contact(threads, plan.grid->rows, pitch, {.rank = nullptr, .columns = columns, .pitch = pitch});
}

template <class T>
void OffGridForces<T>::init_contact_by_ranks(int threads) {
    const std::int64_t blocks = (plan.count + contact_block - 1) / contact_block;
    init_contact(threads, blocks, contact_block, {.rank = plan.rank.data(), .columns = 0, .pitch = contact_block});
}

template <class T>
RunStatus OffGridForces<T>::compute_forces(std::int64_t step, int thread) {
    Partition<T>& partition = (*partitions)[thread];
    T* const f = partition.f.data();
    std::fill(f + 4 * partition.low, f + 4 * partition.high, T(0));
    std::fill(f + 4 * plan.count, f + 4 * plan.count + 4, T(0));
    const bool record = run.power_integrals && step >= 0;
    PowerSums list_powers;
    const bool has_impulses = multirate && run.evaluates_hinges(step), has_mass = plan.has_added_mass();
    if (has_mass && (plan.mass_list < 0 || has_impulses))
        std::fill(partition.mass_blocks.begin() + 8 * partition.low, partition.mass_blocks.begin() + 8 * partition.high,
                  T(0));
    const T half_step = static_cast<T>(step < 0 ? 0.0 : 0.5 * run.step);
    for (std::size_t k = 0; k < partition.lists.size(); ++k)
        if (!(multirate && plan.lists[k].slow) && static_cast<std::int64_t>(k) != plan.mass_list &&
            !(plan.omits_plastic && is_plastic(plan.lists[k].kind)))
            add_forces<T>(plan.lists[k], partition.lists[k], x.data(), v.data(), f, record ? &list_powers : nullptr,
                          partition.mass_blocks.data(), half_step);
    if (has_impulses && plan.mass_list >= 0)
        mesh::add_mass_blocks<4>(partition.lists[plan.mass_list], plan.cells_mass(), x.data(),
                                 partition.mass_blocks.data());
    if (has_impulses) add_hinge_impulses(step, partition, record ? &list_powers : nullptr);
    if constexpr (sizeof(T) == 8) {
        if (self) self->add(step, x.data(), v.data(), f, record ? list_powers.dissipation : nullptr);
        if (features) features->add(step, x.data(), v.data(), f);
    }
    return needs_full_arrays() ? add_callback_forces(step, f, record, list_powers) : RunStatus::ok;
}

template <class T>
void OffGridForces<T>::add_hinge_impulses(std::int64_t step, Partition<T>& partition, PowerSums* list_powers) {
    const std::int64_t evaluation = step < 0 ? 0 : step / run.multirate + 1;
    auto& predictions = plan.workspace<T>(run.workspace).predicted_impulses;
    const T* const prediction = predictions[(evaluation + 1) % 2].data();
    T *const next_prediction = predictions[evaluation % 2].data(), *const previous_quarter = predictions[2].data();
    for (std::int64_t i = 4 * partition.low; i < 4 * partition.high; i += 4)
        store4(partition.hinge_velocities.data() + i, quad<T>(load4(v.data() + i) + load4(prediction + i)));
    std::fill(partition.hinge_forces.begin() + 4 * partition.low, partition.hinge_forces.begin() + 4 * partition.high,
              T(0));
    PowerSums hinge_powers;
    for (std::size_t k = 0; k < partition.lists.size(); ++k)
        if (plan.lists[k].slow)
            add_forces<T>(plan.lists[k], partition.lists[k], x.data(), partition.hinge_velocities.data(),
                          partition.hinge_forces.data(), list_powers ? &hinge_powers : nullptr);
    for (int k = 0; list_powers && k < 16; ++k)
        list_powers->dissipation[k] += static_cast<double>(run.multirate) * hinge_powers.dissipation[k];
    const T weight = static_cast<T>(step < 0 ? 0 : run.multirate);
    T* const f = partition.f.data();
    const T* const mass_blocks = plan.has_added_mass() ? partition.mass_blocks.data() : nullptr;
    for (std::int64_t p = partition.first; p < partition.last; ++p) {
        const quad<T> impulse = load4(partition.hinge_forces.data() + 4 * p), weights{weight, weight, weight, weight};
        const quad<T> factor{quarter_impulse_factors[p], quarter_impulse_factors[p], quarter_impulse_factors[p],
                             quarter_impulse_factors[p]},
            quarter = factor * impulse;
        quad<T> quarter_impulse = quarter;
        if (mass_blocks) {
            const Vec3<T> carried = laws::accelerated(mesh::mass_block(mass_blocks + 8 * p), inverse[p],
                                                      {quarter[0], quarter[1], quarter[2]});
            quarter_impulse = quad<T>{carried.x, carried.y, carried.z, T(0)};
        }
        store4(f + 4 * p, fma(weights, impulse, load4(f + 4 * p)));
        store4(next_prediction + 4 * p,
               quad<T>(quarter_impulse + (step < 0 ? quarter_impulse : load4(previous_quarter + 4 * p))));
        store4(previous_quarter + 4 * p, quarter_impulse);
    }
}

template <class T>
RunStatus OffGridForces<T>::add_callback_forces(std::int64_t step, T* f, bool record, const PowerSums& list_powers) {
    const std::int64_t n = plan.count;
    for (int c = 0; c < 3; ++c)
        for (std::int64_t i = 0; i < n; ++i) {
            const std::int64_t at = 4 * plan.rank[i] + c;
            callback_x[c * n + i] = origin[c] + static_cast<double>(x[at]);
            callback_v[c * n + i] = static_cast<double>(v[at]);
        }
    double totals[2] = {list_powers.sum(list_powers.dissipation), list_powers.sum(list_powers.external)};
    if (plan.callback) {
        std::fill(callback_f.begin(), callback_f.end(), 0.0);
        double* const callback_powers = record ? totals : nullptr;
        if (plan.callback(midpoint_time(run, step), callback_x.data(), callback_v.data(), callback_f.data(),
                          callback_powers) != callback_ok)
            return RunStatus::callback_failed;
    }
    if (record) {
        grid_and_field_powers(plan, callback_x.data(), callback_v.data(), totals[0], totals[1]);
        run.power_integrals[0] += run.step * totals[0];
        run.power_integrals[1] += run.step * totals[1];
    }
    if (!plan.callback) return RunStatus::ok;
    for (int c = 0; c < 3; ++c)
        for (std::int64_t i = 0; i < n; ++i) f[4 * plan.rank[i] + c] += static_cast<T>(callback_f[c * n + i]);
    return RunStatus::ok;
}

template <class T>
void OffGridForces<T>::add_contact(int thread, std::int64_t step, T* f) {
    const Partition<T>& partition = (*partitions)[thread];
    for (std::int64_t first = partition.first; contact && first < partition.last; first += contact_block) {
        const std::int64_t count = std::min(contact_block, partition.last - first);
        contact->add_quads(thread, first / contact_block, step, x.data() + 4 * first, v.data() + 4 * first,
                           f + 4 * first, count);
    }
}

template <class T>
void OffGridForces<T>::record_row_motion(int thread, std::int64_t row, std::int64_t step, const T* at,
                                         std::int64_t pitch) {
    using V = vec<T>;
    plan::MotionRecord& motion = *run.motion;
    const std::int64_t columns = plan.grid->columns, first = row * columns;
    const T *const x = at + position * pitch, *const v = at + grid::velocity * pitch;
    if (motion.keeps_paths()) motion.include_row<T>(step, first, columns, x, v, pitch, origin);
    // Bounds of the numbers that component(c, column, read) gives.
    const auto bounds_of = [&](auto&& component) CLOTH_INLINED {
        VelocityBounds<V> bounds;
        const auto include = [&](std::int64_t column, auto&& read) CLOTH_INLINED {
            bounds.include(Vec3<V>{component(0, column, read), component(1, column, read), component(2, column, read)});
        };
        if (columns >= lanes<T>) {
            // The last vector overlaps the one before: there is no particle after the last.
            for (std::int64_t j = 0; j < columns; j += lanes<T>)
                include(std::min(j, columns - lanes<T>), [](const T* from) CLOTH_INLINED { return load(from); });
        } else {
            for (std::int64_t j = 0; j < columns; ++j)
                include(j, [](const T* from) CLOTH_INLINED { return splat<V>(*from); });
        }
        return bounds;
    };
    if (motion.keeps_velocities()) {
        const auto velocity = [&](int c, std::int64_t column, auto&& read)
                                  CLOTH_INLINED { return read(v + c * pitch + column); };
        record_block_velocities(thread, row, step, bounds_of(velocity));
    }
    if (motion.keeps_changes()) {
        const T* const v0 = motion.start_velocities<T>() + first;
        const auto change = [&](int c, std::int64_t column, auto&& read) CLOTH_INLINED {
            return read(v + c * pitch + column) - read(v0 + c * plan.count + column);
        };
        motion.include_changes<T>(thread, step, bounds_of(change));
    }
}

template <class T>
void OffGridForces<T>::record_motion(int thread, std::int64_t step, const T* v, std::int64_t first, std::int64_t last) {
    using V = vec<T>;
    plan::MotionRecord& motion = *run.motion;
    if (motion.keeps_paths()) motion.include_quads<T>(step, first, last, x.data(), v, plan.particle_of_rank, origin);
    // Bounds of the quads that quad_of(rank) gives.
    const auto bounds_of = [&](std::int64_t begin, std::int64_t end, auto&& quad_of) CLOTH_INLINED {
        quad<T> low = quad_of(begin), high = low;
        for (std::int64_t i = begin; i < end; ++i) {
            const quad<T> present = quad_of(i);
            low = smaller(present, low);
            high = larger(present, high);
        }
        VelocityBounds<V> bounds;
        bounds.include({splat<V>(low[0]), splat<V>(low[1]), splat<V>(low[2])},
                       {splat<V>(high[0]), splat<V>(high[1]), splat<V>(high[2])});
        return bounds;
    };
    for (std::int64_t begin = first; motion.keeps_velocities() && begin < last; begin += contact_block) {
        const auto velocity = [&](std::int64_t i) CLOTH_INLINED { return load4(v + 4 * i); };
        record_block_velocities(thread, begin / contact_block, step,
                                bounds_of(begin, std::min(begin + contact_block, last), velocity));
    }
    if (motion.keeps_changes() && first < last) {
        const T* const v0 = motion.start_velocities<T>();
        const auto change = [&](std::int64_t i) CLOTH_INLINED { return quad<T>(load4(v + 4 * i) - load4(v0 + 4 * i)); };
        motion.include_changes<T>(thread, step, bounds_of(first, last, change));
    }
}

template <class T>
void OffGridForces<T>::record_block_velocities(int thread, std::int64_t block, std::int64_t step,
                                               const VelocityBounds<vec<T>>& bounds) {
    run.motion->include_velocities<T>(thread, step, bounds);
    if (contact) contact->check_speed(thread, block, step, bounds.max_square());
}

template <class T>
void OffGridForces<T>::add_row_forces(int thread, std::int64_t row, std::int64_t step, const RowView<T>& at,
                                      bool record) {
    const std::int64_t columns = plan.grid->columns, first = row * columns, last = first + columns;
    T* const forces = at.force_rows[0];
    if (contact)
        contact->add(thread, row, step, at.row[0] + position * at.pitch, at.row[0] + damping_velocity * at.pitch,
                     forces, columns, record);
    const auto& particles = plan.grips.particle;
    auto grip = particles.empty() ? particles.end() : std::lower_bound(particles.begin(), particles.end(), first);
    for (; grip != particles.end() && *grip < last; ++grip) {
        if (plan.grips.prescribed[grip - particles.begin()]) continue;
        const std::int64_t j = *grip - first;
        const T *const x = at.row[0] + position * at.pitch + j, *const v = at.row[0] + damping_velocity * at.pitch + j;
        const auto three = [&](const T* from) { return to_double<T>({from[0], from[at.pitch], from[2 * at.pitch]}); };
        Motion particle{three(x), three(v)};
        if constexpr (sizeof(T) == 4) particle.x = particle.x + three(x + (grid::low_position - position) * at.pitch);
        const Vec3<T> f = grip_force(thread, grip - particles.begin(), step, particle, record);
        forces[j] += f.x, forces[at.pitch + j] += f.y, forces[2 * at.pitch + j] += f.z;
    }
    if (!is_active(step)) return;
    const T* const from = (*partitions)[thread].f.data() + 4 * first;
    std::int64_t j = 0;
    for (; j + lanes<T> <= columns; j += lanes<T>) {
        quad<T> rows[lanes<T>];
        for (int k = 0; k < lanes<T>; ++k) rows[k] = load4(from + 4 * (j + k));
        vec<T> f[3];
        deinterleave(rows, f[0], f[1], f[2]);
        for (int c = 0; c < 3; ++c) store_as(forces + c * at.pitch + j, load(forces + c * at.pitch + j) + f[c]);
    }
    for (; j < columns; ++j)
        for (int c = 0; c < 3; ++c) forces[c * at.pitch + j] += from[4 * j + c];
    if (!at.mass || plan.mass_list >= 0) return;
    const T* const blocks = (*partitions)[thread].mass_blocks.data() + 8 * first;
    for (j = 0; j < columns; ++j)
        for (int c = 0; c < grid::block_numbers; ++c) at.mass[c * at.pitch + j] = blocks[8 * j + c + (c > 2)];
}

template <class T>
Vec3<T> OffGridForces<T>::grip_force(int thread, std::int64_t grip, std::int64_t step, const Motion& particle,
                                     bool record) {
    const Grips& grips = plan.grips;
    const Vec3<double> position{origin[0] + particle.x.x, origin[1] + particle.x.y, origin[2] + particle.x.z};
    const auto point = grips.point(poses[thread].at(grips.gripper[grip], step), grip);
    const Vec3<double> force = grips.force(grip, point, position, particle.v);
    if (record && step >= 0) {
        // Each grip has its own sum: threads accumulate in any order.
        grips.accumulate(grip_sums.data() + grip * record_numbers, grip, point, force, particle.v, run.step);
    }
    return {T(force.x), T(force.y), T(force.z)};
}

template <class T>
auto OffGridForces<T>::prescribe(int thread, std::int64_t grip, std::int64_t step, Vec3<T> a, bool record) -> Motion {
    const Grips& grips = plan.grips;
    const std::int64_t path = grips.gripper[grip];
    if (record && step >= 0) {
        const Pose& pose = poses[thread].at(path, step);
        grips.accumulate_prescribed(grip_sums.data() + grip * record_numbers, pose, grips.point(pose, grip),
                                    plan.masses[grips.particle[grip]] * to_double(a), plan.masses[grips.particle[grip]],
                                    run.step);
    }
    const bool at_end = step + 1 == run.steps;
    const Grips::Point point = at_end ? grips.point_at(grip, run.t + static_cast<double>(run.steps) * run.step)
                                      : grips.point(poses[thread].at(path, step + 1), grip);
    return {{point.position.x - origin[0], point.position.y - origin[1], point.position.z - origin[2]}, point.velocity};
}

template <class T>
Vec3<T> OffGridForces<T>::air_inertia(std::int64_t grip, std::int64_t step, const Sym3<T>& block) {
    const auto point = plan.grips.point(pose_at(plan.grips.path_of(grip), Dual{midpoint_time(run, step), 1.0}), grip);
    return product(block, narrowed<T>(slope_of(point.velocity)));
}

template <class T>
void OffGridForces<T>::hold_row(std::int64_t row, std::int64_t step, const RowView<T>& at) {
    const std::int64_t columns = plan.grid->columns, first = row * columns, last = first + columns;
    const auto& particles = plan.grips.particle;
    for (auto grip = std::lower_bound(particles.begin(), particles.end(), first);
         grip != particles.end() && *grip < last; ++grip) {
        if (!plan.grips.prescribed[grip - particles.begin()]) continue;
        T *const mass = at.mass + (*grip - first), *const f = at.force_rows[0] + (*grip - first);
        const std::ptrdiff_t p = at.pitch;
        const Vec3<T> inertia = air_inertia(grip - particles.begin(), step,
                                            {mass[0], mass[p], mass[2 * p], mass[3 * p], mass[4 * p], mass[5 * p]});
        f[0] -= inertia.x, f[p] -= inertia.y, f[2 * p] -= inertia.z;
        for (int c = 0; c < grid::block_numbers; ++c) mass[c * p] = T(0);
    }
}

template <class T>
void OffGridForces<T>::prescribe_row(int thread, std::int64_t row, std::int64_t step, const RowView<T>& at,
                                     bool record) {
    const std::int64_t columns = plan.grid->columns, first = row * columns, last = first + columns;
    const auto& particles = plan.grips.particle;
    for (auto grip = std::lower_bound(particles.begin(), particles.end(), first);
         grip != particles.end() && *grip < last; ++grip) {
        if (!plan.grips.prescribed[grip - particles.begin()]) continue;
        T* const numbers = at.row[0] + (*grip - first);
        const auto slot = [&](Slot k, int c) -> T& { return numbers[(k + c) * at.pitch]; };
        const auto put = [&](Slot k, Vec3<T> p) { slot(k, 0) = p.x, slot(k, 1) = p.y, slot(k, 2) = p.z; };
        const Vec3<T> a{slot(grid::previous_acceleration, 0), slot(grid::previous_acceleration, 1),
                        slot(grid::previous_acceleration, 2)};
        const Motion end = prescribe(thread, grip - particles.begin(), step, a, record);
        const Vec3<T> x_ = narrowed<T>(end.x), v_ = narrowed<T>(end.v);
        put(grid::position, x_);
        put(grid::velocity, v_);
        put(damping_velocity, v_);
        if constexpr (sizeof(T) == 4) {
            put(grid::low_position, narrowed<T>(end.x - to_double(x_)));
            put(grid::low_velocity, narrowed<T>(end.v - to_double(v_)));
        }
    }
}

template <class T>
void OffGridForces<T>::finish_surface()
    requires(sizeof(T) == 8)
{
    const bool features_separate = !features || features->finish(x.data());
    if ((self && !self->finish(x.data())) || !features_separate) {
        std::fill(run.x, run.x + 3 * plan.count, std::numeric_limits<double>::quiet_NaN());
        std::fill(run.v, run.v + 3 * plan.count, std::numeric_limits<double>::quiet_NaN());
    }
    if (!run.contact_record) return;
    double* const summary = run.contact_record + plan.contacts.count() * record_numbers;
    const ContactBounds self_bounds = self ? self->bounds() : ContactBounds{},
                        feature_bounds = features ? features->bounds() : ContactBounds{};
    if (self) summary[1] = smaller(self->gap(), summary[1]);
    if (features) summary[1] = smaller(features->gap(), summary[1]);
    summary[ContactSummary::numbers] = self_bounds.omega2 + feature_bounds.omega2;
    summary[ContactSummary::numbers + 1] = self_bounds.damping + feature_bounds.damping;
    summary[ContactSummary::numbers + 3] +=
        (self ? self->growth_work() : 0.0) + (features ? features->growth_work() : 0.0);
    if (!self) return;
    summary[ContactSummary::numbers + 2] = self->friction_work();
    if (run.anchors)
        self->anchors(run.steps, plan.particle_of_rank.data(),
                      run.anchors + plan.contacts.obstacle_anchors(plan.count));
}

template <class T>
void OffGridForces<T>::finish() {
    if (run.plastic_lengths) store_plastic_lengths();
    // Obstacles without contact keep no anchors.
    if (run.anchors) std::copy(plan.contacts.anchors.begin(), plan.contacts.anchors.end(), run.anchors);
    if (contact)
        contact->finish();
    else
        record_no_contact();
    if constexpr (sizeof(T) == 8)
        if ((self || features) && run.steps) finish_surface();
    if (!run.gripper_record) return;
    if (has_prescribed()) {
        const double end = run.t + static_cast<double>(run.steps) * run.step;
        Array<double> blocks(plan.has_added_mass() ? 6 * plan.count : 0);
        if (!blocks.empty()) mass_blocks(plan, run.x0, blocks.data());
        plan.grips.for_each_prescribed(run.t, [&](std::int64_t grip, const Grips::Point& from) {
            if (!blocks.empty())
                plan.grips.accumulate_air_jump(grip_sums.data() + grip * record_numbers, grip, from,
                                               block_of(blocks.data(), plan.count, plan.grips.particle[grip]));
            plan.grips.accumulate_inertia(grip_sums.data() + grip * record_numbers, grip, from,
                                          plan.grips.point_at(grip, end), plan.masses[plan.grips.particle[grip]]);
        });
    }
    for (std::int64_t grip = 0; grip < plan.grips.count(); ++grip)
        for (int k = 0; k < record_numbers; ++k)
            run.gripper_record[plan.grips.gripper[grip] * record_numbers + k] += grip_sums[grip * record_numbers + k];
}

template <class T>
void OffGridForces<T>::load_plastic_lengths() {
    const List& list = plan.lists[plan.plastic_list];
    for (Partition<T>& partition : *partitions) {
        Elements<T>& elements = partition.lists[plan.plastic_list];
        for (std::size_t k = 0; k < elements.source.size(); ++k)
            elements.param[0][k] = static_cast<T>(list.params[elements.source[k] * list.numbers]);
    }
}

template <class T>
void OffGridForces<T>::store_plastic_lengths() const {
    // Elements at a border of threads have the same length on both sides.
    for (const Partition<T>& partition : *partitions) {
        const Elements<T>& elements = partition.lists[plan.plastic_list];
        for (std::size_t k = 0; k < elements.source.size(); ++k)
            run.plastic_lengths[elements.source[k]] = static_cast<double>(elements.param[0][k]);
    }
}

template <class T>
void OffGridForces<T>::record_no_contact() {
    const Contacts& contacts = plan.contacts;
    if (run.contact_record) ContactSummary().write(run.contact_record + contacts.count() * record_numbers);
}

template <class T>
void OffGridForces<T>::advance_jaws(int thread, std::int64_t step) {
    if (contact) contact->advance_jaws(thread, step);
}

template <class T>
void OffGridForces<T>::allocate(const std::vector<std::int64_t>& borders) {
    partitions = &plan.partitions<T>(borders, multirate, run.workspace);
    if (plan.plastic_list >= 0) load_plastic_lengths();
    x.assign(4 * (plan.count + 1), T(0));
    v.assign(4 * (plan.count + 1), T(0));
    if (multirate) {
        for (Array<T>& prediction : plan.workspace<T>(run.workspace).predicted_impulses)
            prediction.assign(4 * (plan.count + 1), T(0));
        quarter_impulse_factors.resize(plan.count);
        inverse.resize(plan.count);
        for (std::int64_t i = 0; i < plan.count; ++i) inverse[plan.rank[i]] = static_cast<T>(plan.inverse[i]);
        for (std::int64_t i = 0; i < plan.count; ++i)
            quarter_impulse_factors[plan.rank[i]] =
                static_cast<T>(0.25 * run.multirate * run.step * plan.free_inverse[i]);
        for (Partition<T>& partition : *partitions) {
            partition.hinge_forces.resize(4 * (plan.count + 1));
            partition.hinge_velocities.resize(4 * (plan.count + 1));
        }
    }
    if (needs_full_arrays()) {
        callback_x.resize(3 * plan.count);
        callback_v.resize(3 * plan.count);
        callback_f.resize(3 * plan.count);
    }
}

template struct OffGridForces<float>;
template struct OffGridForces<double>;

}  // namespace cloth::plan
