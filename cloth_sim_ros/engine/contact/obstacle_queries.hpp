// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of contact with obstacles: energy, powers, bounds, derivative product, prediction, continuous collision
// detection. Arrays are (3, n) by component; sums run obstacle by obstacle, particle by particle.
#pragma once

#include <optional>

#include "contact/culling.hpp"
#include "contact/queries.hpp"
#include "laws/friction.hpp"
#include "plan/plan.hpp"

namespace cloth::contact {

using laws::FrictionLaw, plan::record_numbers;

/// A particle near an obstacle.
struct ObstacleContact : ContactKinematics<double> {
    std::int64_t obstacle, particle;
    double mass;
    const PosedObstacle<double>& posed;
    Scaling<double> scaling = full_thickness<double>();
    /// Gap in units of the full thickness; forces, energies and bounds follow from it.
    double scaled_gap() const { return scaling.gap(gap); }
    typename ContactLaw<double>::ContactForce force(const ContactLaw<double>& law) const {
        const auto a = law.force(scaled_gap(), scaling.closing(gap, closing));
        return {a.push / scaling.scale, a.elastic / scaling.scale, a.shape};
    }
    double elastic(const ContactLaw<double>& law) const { return law.elastic(scaled_gap()) / scaling.scale; }
    double energy(const ContactLaw<double>& law) const {
        return law.energy(scaled_gap()) / (scaling.scale * scaling.scale);
    }
};

/// Reads blocks of particles. Only the last block is copied, because whole vectors of it may be read.
class BlockReader {
public:
    BlockReader(const Plan& plan, const double* x, const double* v) : plan_(plan), x_(x), v_(v) {}
    /// Block from particle `first` on; valid until the next call.
    Block<double> at(std::int64_t first) {
        const std::int64_t n = plan_.count, count = std::min(contact_block, n - first);
        for (std::int64_t i = 0; i < count; ++i)
            mass_[i] = plan_.inverse[first + i] > 0.0 ? plan_.masses[first + i] : 0.0;
        if (v_ && count == contact_block) return {x_ + first, v_ + first, n, mass_, count};
        if (count < contact_block) {
            std::fill(buffer_, buffer_ + 6 * contact_block, 0.0);
            std::fill(mass_ + count, mass_ + contact_block, 0.0);
        }
        for (int c = 0; c < 3; ++c) {
            std::copy_n(x_ + c * n + first, count, buffer_ + c * contact_block);
            if (v_) std::copy_n(v_ + c * n + first, count, buffer_ + (3 + c) * contact_block);
        }
        return {buffer_, buffer_ + 3 * contact_block, contact_block, mass_, count};
    }

private:
    const Plan& plan_;
    const double *x_, *v_;
    alignas(64) double buffer_[6 * contact_block] = {}, mass_[contact_block];
};

/// Call visit(obstacle, first, shape, posed, block) for each block of particles near an obstacle, unless
/// skips(obstacle, posed) or, before the pose is computed, skips(obstacle). A block is near if its least gap is below
/// widest(speed) [m], where `speed` is the largest relative speed in the block [m/s].
template <class S, class W, class F>
inline void for_each_near_block(const Plan& plan, double t, const double* x, const double* v, S&& skips, W&& widest,
                                F&& visit) {
    const Contacts& contacts = plan.contacts;
    BlockReader blocks(plan, x, v);
    for (std::int64_t obstacle = 0; obstacle < contacts.count(); ++obstacle) {
        if (!contacts.present(obstacle)) continue;
        if constexpr (std::is_invocable_v<S, std::int64_t>)
            if (skips(obstacle)) continue;
        PosedObstacle<double> posed(contacts.obstacle_pose(obstacle, t), contacts.obstacles[obstacle]);
        if (contacts.jaw_of(obstacle)) posed.lever = posed.position - pose_at(contacts.path(obstacle), t).position;
        if constexpr (std::is_invocable_v<S, std::int64_t, const PosedObstacle<double>&>)
            if (skips(obstacle, posed)) continue;
        const Vec3<double>& size = contacts.obstacles[obstacle].size;
        with_shape(contacts.obstacles[obstacle].shape, [&](auto shape) {
            for (std::int64_t first = 0; first < plan.count; first += contact_block) {
                const Block<double> block = blocks.at(first);
                double limit = no_gap<double>;
                if constexpr (shape.value == Shape::mesh) {
                    const auto bound = bound_block(posed, contacts.obstacles[obstacle], block);
                    limit = widest(bound.speed);
                    if (bound.gap > limit) continue;
                }
                const auto result =
                    scan_block<shape.value, true, double>(posed, size, block, contacts.thickness, 0.0, limit).result();
                if (result.gap < widest(result.speed)) visit(obstacle, first, shape, posed, block);
            }
        });
    }
}
/// Call `visit` for each free particle of those blocks. Gaps of a mesh above widest(0) [m] may be lower bounds.
template <class S, class W, class F>
inline void for_each_near(const Plan& plan, double t, const double* x, const double* v, S&& skips, W&& widest,
                          F&& visit) {
    for_each_near_block(
        plan, t, x, v, skips, widest,
        [&](std::int64_t obstacle, std::int64_t first, auto shape, const PosedObstacle<double>& posed,
            const Block<double>& block) {
            const Vec3<double>& size = plan.contacts.obstacles[obstacle].size;
            for (std::int64_t i = 0; i < block.count; ++i) {
                if (!(block.mass[i] > 0.0)) continue;
                const auto s = contact_kinematics<shape.value, true, double>(posed, size, block.position<double>(i),
                                                                             block.velocity<double>(i), widest(0.0));
                visit(ObstacleContact{s, obstacle, first + i, block.mass[i], posed,
                                      plan.contacts.reduced.scaling(obstacle, first + i, plan.count + 1, t)});
            }
        });
}
/// Limit of the gap for all blocks, and a test that skips no obstacle.
inline constexpr auto any_distance = [](double) { return no_gap<double>; };
inline constexpr auto none = [](std::int64_t) { return false; };
/// Call `visit` for each particle in contact. An obstacle whose bounding sphere stays away from all particles on its
/// path is skipped.
template <class F>
inline void for_each_contact(const Plan& plan, double t, const double* x, const double* v, F&& visit) {
    const double thickness = plan.contacts.thickness;
    const BoundingBall cloth(x, plan.count);
    const auto is_far = [&](std::int64_t obstacle) { return cloth.is_away(plan.contacts, obstacle, t, thickness); };
    for_each_near(
        plan, t, x, v, is_far, [&](double) { return thickness; },
        [&](const ObstacleContact& contact) {
            if (contact.scaled_gap() < thickness) visit(contact);
        });
}

/// Friction at one contact, with the given anchors; those of the plan by default.
template <class V>
inline auto friction_force(const Plan& plan, const ObstacleContact& contact, const ContactKinematics<V>& s, V push,
                           const double* anchors = nullptr) {
    const std::int64_t n = plan.count;
    const double* const a =
        (anchors ? anchors : plan.contacts.anchors.data()) + contact.obstacle * anchor_numbers * n + contact.particle;
    const FrictionLaw<V> law(plan.contacts.obstacles[contact.obstacle].friction, plan.contacts.frequency);
    const double bond = a[3 * n];
    const Vec3<V> local = contact.posed.template inward<V>(s.arm);
    const Vec3<V> anchor = bond > 0.0 ? splat3<V>(Vec3<double>{a[0], a[n], a[2 * n]}) : local;
    return law.force(contact.posed.template outward<V>(local - anchor), s.normal, s.slip, push);
}

/// Combine the anchors after runs, each (obstacles, anchor_numbers, n), at the combined state x and v. Anchors that no
/// run moved are kept. The others are combined with the weights of the runs, and returned to the cone.
void combine_anchors(const Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                     const double* weights, const double* ends, double* out) {
    using V = vec<double>;
    const Contacts& contacts = plan.contacts;
    const std::int64_t n = plan.count, size = plan.anchor_count();
    std::fill(out, out + size, 0.0);
    const auto law = contacts.law<V>();
    const auto combine_anchor = [&](std::int64_t index, double* to) {
        const double* const last_anchor = ends + (runs - 1) * size + index;
        bool all_bonded = true, same = true;
        for (std::int64_t run = 0; run < runs; ++run) {
            const double* const from = ends + run * size + index;
            all_bonded = all_bonded && from[3 * n] > 0.0;
            for (int c = 0; c < anchor_numbers; ++c) same = same && from[c * n] == last_anchor[c * n];
        }
        for (int c = 0; c < anchor_numbers; ++c) to[c] = last_anchor[c * n];
        for (int c = 0; all_bonded && !same && c < 3; ++c) {
            double sum = 0.0;
            for (std::int64_t run = 0; run < runs; ++run)
                sum = fma(weights[run], ends[run * size + index + c * n], sum);
            to[c] = sum;
        }
    };
    for_each_near_block(
        plan, t, x, v, none, [&](double) { return contacts.thickness; },
        [&](std::int64_t obstacle, std::int64_t first, auto shape, const PosedObstacle<double>& posed,
            const Block<double>& block) {
            const Obstacle& properties = contacts.obstacles[obstacle];
            if (!properties.has_friction()) return;
            const FrictionLaw<V> friction(properties.friction, contacts.frequency);
            for (std::ptrdiff_t j = 0; j < block.count; j += lanes<double>) {
                const auto s = contact_kinematics<shape.value, true, V>(posed, properties.size, block.position<V>(j),
                                                                        block.velocity<V>(j), contacts.thickness);
                const Scaling<V> scaling = contacts.reduced.lane_scaling(obstacle * (n + 1) + first + j, t);
                const V gap = scaling.gap(s.gap);
                const auto in_contact = (load(block.mass + j) > V{}) & (gap < splat<V>(contacts.thickness));
                const unsigned lanes_in_contact = bits_of(in_contact);
                if (!lanes_in_contact) continue;
                const auto for_each_lane = [&](auto&& visit) {
                    for (int lane = 0; lane < lanes<double>; ++lane)
                        if (lanes_in_contact >> lane & 1u)
                            visit(lane, obstacle * anchor_numbers * n + first + j + lane);
                };
                V numbers[anchor_numbers] = {};
                for_each_lane([&](int lane, std::int64_t index) {
                    double combined[anchor_numbers];
                    combine_anchor(index, combined);
                    for (int c = 0; c < anchor_numbers; ++c) numbers[c][lane] = combined[c];
                });
                const Vec3<V> local = posed.inward<V>(s.arm);
                const auto bonded = numbers[3] > V{};
                const Vec3<V> anchor{select(bonded, numbers[0], local.x), select(bonded, numbers[1], local.y),
                                     select(bonded, numbers[2], local.z)};
                const V push = law.force(gap, scaling.closing(s.gap, s.closing)).push / scaling.scale;
                const auto force = friction.force(posed.outward<V>(local - anchor), s.normal, s.slip, push);
                const Vec3<V> dragged = local - posed.inward<V>(force.stretch);
                const V moved[anchor_numbers] = {
                    select(force.slides, dragged.x, anchor.x), select(force.slides, dragged.y, anchor.y),
                    select(force.slides, dragged.z, anchor.z),
                    select(force.slides, splat<V>(double(slides)), splat<V>(double(sticks)))};
                for_each_lane([&](int lane, std::int64_t index) {
                    for (int c = 0; c < anchor_numbers; ++c) out[index + c * n] = moved[c][lane];
                });
            }
        });
}

double contact_energy(const Plan& plan, double t, const double* x) {
    const auto law = plan.contacts.law<double>();
    double total = 0.0;
    for_each_contact(plan, t, x, nullptr, [&](const ObstacleContact& contact) {
        total += contact.mass * contact.energy(law);
        if (plan.contacts.obstacles[contact.obstacle].has_friction())
            total += contact.mass * friction_force<double>(plan, contact, contact, contact.elastic(law)).energy;
    });
    return total;
}

/// Add the wrench on each obstacle about its position, the power on the cloth and the dissipation, (obstacles,
/// record_numbers).
void add_contact_wrenches(const Plan& plan, double t, const double* x, const double* v, double weight,
                          double* wrenches) {
    const auto law = plan.contacts.law<double>();
    for_each_contact(plan, t, x, v, [&](const ObstacleContact& contact) {
        const auto push = contact.force(law);
        Vec3<double> force = (contact.mass * push.push) * contact.normal;
        const double closing = fma(contact.scaling.growth, contact.gap, contact.closing);
        double dissipation = contact.mass * (push.push - push.elastic) * closing;
        if (plan.contacts.obstacles[contact.obstacle].has_friction()) {
            const auto friction = friction_force<double>(plan, contact, contact, push.push);
            force = force + contact.mass * friction.push;
            dissipation += contact.mass * friction.dissipation;
        }
        const Vec3<double> torque = cross(force, contact.arm + contact.posed.lever);
        const Vec3<double> surface_velocity = contact.posed.velocity + cross(contact.posed.spin, contact.arm);
        const double rates[record_numbers] = {
            -force.x, -force.y, -force.z, torque.x, torque.y, torque.z, dot(force, surface_velocity), dissipation};
        for (int k = 0; k < record_numbers; ++k) wrenches[contact.obstacle * record_numbers + k] += weight * rates[k];
    });
}

/// Call visit(contact, same, bonds, before, stretch) for each particle with anchor springs in two states: its contact in
/// the second one, whether both have one anchor, both bonds, and both stretches [m] in the second frame of the obstacle.
template <class F>
inline void for_each_anchor_spring(const Plan& plan, const AnchoredState& start, const AnchoredState& end, F&& visit) {
    const std::int64_t n = plan.count;
    Array<double> stretches(3 * n * plan.contacts.count());
    const auto visit_state = [&](const AnchoredState& state, auto&& visit_contact) {
        for_each_contact(plan, state.t, state.x, state.v, [&](const ObstacleContact& contact) {
            const std::int64_t at = contact.obstacle * anchor_numbers * n + contact.particle;
            const double *const a = start.anchors + at, *const b = end.anchors + at, *const c = state.anchors + at;
            if (!(a[3 * n] > 0.0) || !(b[3 * n] > 0.0)) return;
            const auto& posed = contact.posed;
            const Vec3<double> offset = posed.outward(posed.inward(contact.arm) - Vec3<double>{c[0], c[n], c[2 * n]});
            visit_contact(contact, a, b, stretches.data() + 3 * n * contact.obstacle + contact.particle,
                          offset - dot(offset, contact.normal) * contact.normal);
        });
    };
    visit_state(start, [&](const ObstacleContact& contact, const double*, const double*, double* local_stretch,
                           const Vec3<double>& stretch) {
        const Vec3<double> local = contact.posed.inward(stretch);
        local_stretch[0] = local.x, local_stretch[n] = local.y, local_stretch[2 * n] = local.z;
    });
    visit_state(end, [&](const ObstacleContact& contact, const double* a, const double* b, const double* local,
                         const Vec3<double>& stretch) {
        const bool same = a[0] == b[0] && a[n] == b[n] && a[2 * n] == b[2 * n];
        const Vec3<double> before = contact.posed.outward(Vec3<double>{local[0], local[n], local[2 * n]});
        visit(contact, same, std::pair{a[3 * n], b[3 * n]}, before, stretch);
    });
}

void add_friction_change(const Plan& plan, const AnchoredState& start, const AnchoredState& end, double* out) {
    const std::int64_t n = plan.count;
    const double frequency = plan.contacts.frequency, rate = 1.0 / (end.t - start.t);
    for_each_anchor_spring(
        plan, start, end,
        [&](const ObstacleContact& contact, bool same, const auto& bonds, const auto& before, const auto& stretch) {
            double *const change = out + contact.particle, *const velocity = change + 3 * n;
            const auto slip = [&] { return contact.slip - dot(contact.slip, contact.normal) * contact.normal; };
            if (same) add_to(velocity, n, slip() - rate * (stretch - before));
            if (!same) add_to(change, n, frequency * frequency * (before - stretch));
            if (!same && bonds.second == double(sticks)) add_to(velocity, n, frequency * stretch);
        });
}

void add_stretch_difference(const Plan& plan, const AnchoredState& a, const AnchoredState& b, double* out) {
    for_each_anchor_spring(
        plan, a, b,
        [&](const ObstacleContact& contact, bool, const auto& bonds, const auto& before, const auto& stretch) {
            const bool slide = bonds.first == double(slides) && bonds.second == double(slides);
            if (!slide) add_to(out + contact.particle, plan.count, stretch - before);
        });
}

void add_contact_jerk(const Plan& plan, const Moment& moment, double factor, double duration, double* out) {
    const auto law = plan.contacts.law<double>();
    const Contacts& contacts = plan.contacts;
    const double thickness = contacts.thickness, fastest = max_speed(moment.v, plan.count);
    const BoundingBall cloth(moment.x, plan.count);
    const auto reach = [&](double speed) { return fma(speed, duration, thickness); };
    const auto is_far = [&](std::int64_t obstacle, const PosedObstacle<double>& posed) {
        return cloth.finite && !contacts.jaw_of(obstacle) &&
               cloth.distance_to(contacts.obstacles[obstacle], posed) - cloth.rounding_margin(posed) >
                   reach(1.001 * cloth.max_relative_speed(fastest, posed));
    };
    for_each_near(plan, moment.t, moment.x, moment.v, is_far, reach, [&](const ObstacleContact& contact) {
        const std::int64_t n = plan.count;
        const double closing = contact.scaling.closing(contact.gap, contact.closing), gap = contact.scaled_gap();
        if (!(plan.free_inverse[contact.particle] > 0.0)) return;
        if (!(gap < thickness) && !(gap < thickness - factor * closing * duration)) return;
        // Out of contact, the surface stops the particle within the interval, or has stopped it.
        const double speed = closing / ContactLaw<double>::speed,
                     nearest = gap < thickness ? gap : stopping_gap(speed * speed) * thickness,
                     jerk = factor * law.stiffness(nearest) * closing / contact.scaling.scale;
        double* const to = out + contact.particle;
        to[0] += jerk * contact.normal.x, to[n] += jerk * contact.normal.y, to[2 * n] += jerk * contact.normal.z;
    });
}

/// Power of contacts that recover their thickness [W].
double contact_growth_power(const Plan& plan, double t, const double* x, const double* v) {
    const auto law = plan.contacts.law<double>();
    double power = 0.0;
    for_each_contact(plan, t, x, v, [&](const ObstacleContact& contact) {
        const double push = contact.force(law).push, energy = contact.energy(law);
        power += contact.mass * contact.scaling.growth * fma(push, contact.gap, 2.0 * energy);
    });
    return power;
}

/// Add blocks of stiffness and damping across the gap. The curvature of a surface only softens.
void add_contact_bounds(const Plan& plan, double t, const double* x, double* stiff, double* damp) {
    const auto law = plan.contacts.law<double>();
    for_each_contact(plan, t, x, nullptr, [&](const ObstacleContact& contact) {
        // The anchor spring acts along the surface.
        const bool has_friction = plan.contacts.obstacles[contact.obstacle].has_friction();
        const double w = has_friction ? plan.contacts.frequency : 0.0, along = contact.mass * w * w;
        const double friction_damping = contact.mass * FrictionLaw<double>::damping_per_frequency * w;
        if (stiff)
            add_block(stiff, plan.count, contact.particle,
                      outer(contact.mass * law.stiffness(contact.scaled_gap()) - along, contact.normal, along));
        if (damp)
            add_block(damp, plan.count, contact.particle,
                      outer(contact.mass * law.damping(contact.scaled_gap()) - friction_damping, contact.normal,
                            friction_damping));
    });
}

/// Squared frequency [1/s^2] and damping rate [1/s] of contact that has absorbed an energy per mass, in U^2/2.
ContactBounds contact_limits(const Contacts& contacts, double energy) {
    ContactBounds r;
    for (const ParallelJaw& jaw : contacts.parallel_jaws)
        if (jaw.present) r.damping = larger(2.0 * jaw.force / (jaw.speed * jaw.mass), r.damping);
    if (!(energy > 0.0)) return r;
    const auto law = contacts.law<double>();
    const double gap = stopping_gap(energy) * contacts.thickness;
    r.omega2 = law.stiffness(gap);
    r.damping = larger(laws::damping_at_energy(law, energy), r.damping);
    if (!contacts.has_friction()) return r;
    r.omega2 = larger(contacts.frequency * contacts.frequency, r.omega2);
    r.damping = larger(FrictionLaw<double>::damping_per_frequency * contacts.frequency, r.damping);
    return r;
}

/// Accelerations [m/s^2] of the half openings at time t, by the cloth and the drives; `jaw_forces` [N] are other
/// opening forces by gripper.
void jaw_accelerations(const Plan& plan, double t, const double* x, const double* v, std::vector<double> jaw_forces,
                       double* out) {
    const Contacts& contacts = plan.contacts;
    const auto law = contacts.law<double>();
    for_each_contact(plan, t, x, v, [&](const ObstacleContact& contact) {
        const Obstacle& obstacle = contacts.obstacles[contact.obstacle];
        if (obstacle.parallel_jaw < 0) return;
        const double push = contact.force(law).push;
        Vec3<double> force = push * contact.normal;
        if (obstacle.has_friction()) force = force + friction_force<double>(plan, contact, contact, push).push;
        jaw_forces[obstacle.parallel_jaw] -= contact.mass * obstacle.jaw_side * dot(contact.posed.rotation[1], force);
    });
    for (std::size_t k = 0; k < contacts.parallel_jaws.size(); ++k) {
        const double* const at = contacts.jaw_states.data() + k * jaw_state_size;
        const ParallelJaw& jaw = contacts.parallel_jaws[k];
        out[k] = jaw.present ? jaw.acceleration(law, contacts.thickness, at[0], at[1], jaw_forces[k]) : 0.0;
    }
}

void add_contact_product(const Plan& plan, double t, const double* x, const double* v, const double* dx,
                         const double* dv, double* out) {
    const std::int64_t n = plan.count;
    const ContactLaw<Dual> law(plan.contacts.thickness, plan.contacts.damping);
    for_each_contact(plan, t, x, v, [&](const ObstacleContact& contact) {
        const Obstacle& obstacle = plan.contacts.obstacles[contact.obstacle];
        const auto at = [&](const double* a, const double* slope) {
            const std::int64_t i = contact.particle;
            return Vec3<Dual>{{a[i], slope[i]}, {a[n + i], slope[n + i]}, {a[2 * n + i], slope[2 * n + i]}};
        };
        with_shape(obstacle.shape, [&](auto shape) {
            const auto s =
                contact_kinematics<shape.value, true, Dual>(contact.posed, obstacle.size, at(x, dx), at(v, dv));
            const Scaling<Dual> scaling{{contact.scaling.scale, 0.0}, {contact.scaling.growth, 0.0}};
            const Dual push = law.push(scaling.gap(s.gap), scaling.closing(s.gap, s.closing)) / scaling.scale;
            Vec3<Dual> force = push * s.normal;
            if (obstacle.has_friction()) force = force + friction_force(plan, contact, s, push).push;
            force = Dual{contact.mass, 0.0} * force;
            out[contact.particle] += force.x.slope;
            out[n + contact.particle] += force.y.slope;
            out[2 * n + contact.particle] += force.z.slope;
        });
    });
}

/// Number of particles in contact with each obstacle, and the least gap to any particle: (obstacles, 2).
void contact_gaps(const Plan& plan, double t, const double* x, double* out) {
    for (std::int64_t obstacle = 0; obstacle < plan.contacts.count(); ++obstacle) {
        out[2 * obstacle] = 0.0;
        out[2 * obstacle + 1] = std::numeric_limits<double>::infinity();
    }
    // Gaps above the least one found so far, and above the thickness, change nothing.
    double limit = no_gap<double>;
    const auto begin = [&](std::int64_t) { return limit = no_gap<double>, false; };
    for_each_near(
        plan, t, x, nullptr, begin, [&](double) { return limit; },
        [&](const ObstacleContact& contact) {
            double* const to = out + 2 * contact.obstacle;
            to[0] += contact.scaled_gap() < plan.contacts.thickness ? 1.0 : 0.0;
            to[1] = smaller(contact.gap, to[1]);
            limit = larger(to[1], plan.contacts.thickness);
        });
}
/// Gap of each contact [m] in the rows and columns of `ReducedThickness`: obstacles and particles.
void contact_gap_rows(const Plan& plan, double t, const double* x, double* out) {
    for_each_near(plan, t, x, nullptr, none, any_distance, [&](const ObstacleContact& contact) {
        out[contact.obstacle * (plan.count + 1) + contact.particle] = contact.gap;
    });
}

/// Upper bound of the motion of particles relative to an obstacle, on straight paths of a duration from time t on.
class RelativeMotion {
public:
    RelativeMotion(const double* path, double t, double duration) {
        // The position of an obstacle is a cubic in time. Its motion is the velocity halfway and the variation of that.
        const auto order = [&](int k) { return Vec3<double>{path[4 + 3 * k], path[5 + 3 * k], path[6 + 3 * k]}; };
        const double half = 0.5 * duration, middle = t + half - path[0], end = t + duration - path[0];
        const Vec3<double> velocity = order(0) + (2.0 * middle) * order(1) + (3.0 * middle * middle) * order(2);
        const double speed_variation =
            half * root(norm2(2.0 * order(1) + (6.0 * middle) * order(2))) + 3.0 * half * half * root(norm2(order(2)));
        displacement_ = duration * velocity;
        variation_ = duration * speed_variation;
        for (int k = 0; k < 3; ++k) {
            const double power = (k == 0 ? 1.0 : k == 1 ? 2.0 * end : 3.0 * end * end) * duration;
            const double* const r = path + 17 + 3 * k;
            angle_ += power * root(norm2(Vec3<double>{r[0], r[1], r[2]}));
        }
    }
    /// Length of a particle's path [m]. One that moves along with the obstacle hardly moves. `arm` is the vector from the
    /// obstacle to the particle. A jaw rotates about its gripper, whose distance is the lever.
    double length(Vec3<double> from, Vec3<double> to, Vec3<double> arm, Vec3<double> lever) const {
        const double translation = root(norm2(to - from - displacement_)) + variation_;
        return translation + angle_ * (root(norm2(arm)) + root(norm2(lever)) + translation);
    }

private:
    Vec3<double> displacement_;
    double variation_, angle_ = 0.0;
};

/// Whether a particle intersects an obstacle on its straight path from x0 at time t to x1, `duration` [s] later.
/// Conservative advancement: a particle cannot reach the surface before its relative motion equals its gap. Each step
/// along the path is one gap long; then the gap is measured again.
bool ccd_obstacles(const Plan& plan, double t, double duration, const double* x0, const double* x1) {
    const std::int64_t n = plan.count;
    const double min_step = 1e-3 * plan.contacts.thickness;
    const auto at = [n](const double* x, std::int64_t i) { return Vec3<double>{x[i], x[n + i], x[2 * n + i]}; };
    bool intersects = false;
    // Only a particle whose path is longer than its gap can hit. The longest path saves the search of far meshes.
    double longest = 0.0;
    std::optional<RelativeMotion> motion;
    const auto measure_paths = [&](std::int64_t obstacle, const PosedObstacle<double>& posed) {
        motion.emplace(plan.contacts.path(obstacle), t, duration);
        longest = 0.0;
        for (std::int64_t i = 0; i < n; ++i) {
            const Vec3<double> from = at(x0, i);
            const double length = motion->length(from, at(x1, i), from - posed.position, posed.lever);
            if (!(length <= longest)) longest = length < no_gap<double> ? length : no_gap<double>;
        }
        return intersects;
    };
    const auto reach = [&](double) { return 1.001 * longest + min_step; };
    for_each_near(plan, t, x0, nullptr, measure_paths, reach, [&](const ObstacleContact& contact) {
        if (intersects) return;
        const Obstacle& obstacle = plan.contacts.obstacles[contact.obstacle];
        const Vec3<double> from = at(x0, contact.particle), to = at(x1, contact.particle);
        const double path_length = motion->length(from, to, contact.arm, contact.posed.lever);
        if (contact.gap > path_length) return;
        for (double fraction = 0.0, gap = contact.gap; fraction < 1.0 && !intersects;) {
            fraction = smaller(fraction + larger(gap, min_step) / path_length, 1.0);
            const Pose pose = plan.contacts.obstacle_pose(contact.obstacle, t + fraction * duration);
            gap = gap_of({pose, obstacle}, obstacle, from + fraction * (to - from));
            intersects = !(gap > 0.0);
        }
    });
    return intersects;
}

double predict_contact_energy(const Plan& plan, double t, double duration, const double* x, const double* v,
                              VisitCounts* visits) {
    using V = vec<double>;
    const Contacts& contacts = plan.contacts;
    if (!contacts.count()) return 0.0;
    const auto law = contacts.law<V>();
    const double field_acceleration =
        2.0 *
        root(norm2(Vec3<double>{plan.body_acceleration(0), plan.body_acceleration(1), plan.body_acceleration(2)}));
    const double thickness = contacts.thickness, inverse_speed = 1.0 / ContactLaw<double>::speed;
    const auto reach_distance = [&](auto speed) {
        using U = decltype(speed);
        return splat<U>(thickness) + (speed + splat<U>(0.5 * field_acceleration * duration)) * splat<U>(duration);
    };
    // An obstacle that accelerates on its path counts with the largest speed at the middle and the end. Jaws count with
    // their speed without load.
    std::vector<PosedObstacle<double>> future;
    future.reserve(2 * contacts.count());
    for (std::int64_t obstacle = 0; obstacle < contacts.count(); ++obstacle)
        for (const double fraction : {0.5, 1.0}) {
            const Pose pose = pose_at(contacts.path(obstacle), t + fraction * duration);
            const ParallelJaw* const jaw = contacts.jaw_of(obstacle);
            const double half_opening =
                jaw ? contacts.jaw_states[contacts.obstacles[obstacle].parallel_jaw * jaw_state_size] : 0.0;
            const double jaw_speed = !jaw || duration == 0.0 ? 0.0 : jaw->closed ? -jaw->speed : jaw->speed;
            future.emplace_back(contacts.shifted_pose(pose, obstacle, half_opening, jaw_speed),
                                contacts.obstacles[obstacle]);
        }
    double fastest = 0.0, max_energy = 0.0;
    std::vector<double> jaw_energy(contacts.parallel_jaws.size(), 0.0), masses(contacts.parallel_jaws.size(), 0.0);
    for (const PosedObstacle<double>& posed : future) fastest = larger(root(norm2(posed.velocity)), fastest);
    // An obstacle further away than twice the reach of any particle is skipped as a whole. The bounding sphere of a jaw
    // is about its gripper, and jaws mostly are near.
    const BoundingBall cloth(x, plan.count);
    const double cloth_speed = max_speed(v, plan.count);
    const auto is_far = [&](std::int64_t obstacle, const PosedObstacle<double>& posed) {
        return cloth.finite && !contacts.jaw_of(obstacle) &&
               cloth.distance_to(contacts.obstacles[obstacle], posed) - cloth.rounding_margin(posed) >
                   2.0 * reach_distance(cloth.max_relative_speed(cloth_speed, posed) + fastest);
    };
    const auto widest = [&](double speed) { return reach_distance(speed + fastest); };
    for_each_near_block(
        plan, t, x, v, is_far, widest,
        [&](std::int64_t obstacle, std::int64_t first, auto shape, const PosedObstacle<double>& posed,
            const Block<double>& block) {
            const Obstacle& properties = contacts.obstacles[obstacle];
            Vec3<V> speed_change[2], spin[2];
            for (int k = 0; k < 2; ++k) {
                const PosedObstacle<double>& future_pose = future[2 * obstacle + k];
                speed_change[k] = splat3<V>(future_pose.velocity - posed.velocity);
                spin[k] = splat3<V>(future_pose.spin - posed.spin);
            }
            // No particle counts whose gap is above the reach at its largest speed, now or later.
            double limit = no_gap<double>;
            if constexpr (shape.value == Shape::mesh) {
                double speed = bound_block(posed, properties, block).speed;
                for (int k = 0; k < 2; ++k) {
                    PosedObstacle<double> later = posed;
                    later.velocity = future[2 * obstacle + k].velocity;
                    later.spin = future[2 * obstacle + k].spin;
                    speed = larger(bound_block(later, properties, block).speed, speed);
                }
                limit = reach_distance(speed);
            }
            V largest{};
            std::int64_t n_visited = 0;
            for (std::ptrdiff_t j = 0; j < block.count; j += lanes<double>) {
                const V mass = load(block.mass + j);
                const auto s = contact_kinematics<shape.value, true, V>(posed, properties.size, block.position<V>(j),
                                                                        block.velocity<V>(j), limit);
                V speed = s.closing;
                for (int k = 0; k < 2; ++k)
                    speed = larger(s.closing + dot(speed_change[k] + cross(spin[k], s.arm), s.normal), speed);
                V gap = s.gap, scaled_speed = speed, weight = splat<V>(2.0 * field_acceleration);
                if (contacts.reduced.any()) {
                    const Scaling<V> scaling =
                        contacts.reduced.lane_scaling(obstacle * (plan.count + 1) + first + j, t);
                    speed = fma(scaling.growth, gap, speed);
                    scaled_speed = scaling.scale * speed;
                    gap = scaling.gap(gap);
                    weight = scaling.scale * weight;
                }
                speed = larger(speed, V{});
                scaled_speed = larger(scaled_speed, V{});
                const V free_path = larger(gap - splat<V>(thickness), V{});
                const V energy =
                    splat<V>(inverse_speed * inverse_speed) * (scaled_speed * scaled_speed + weight * free_path) +
                    law.shape(gap);
                const V contact_mass = select(s.gap < reach_distance(speed), mass, V{});
                largest = larger(select(contact_mass > V{}, energy, V{}), largest);
                for (int k = 0; k < lanes<double>; ++k) n_visited += mass[k] > 0.0;
                for (int k = 0; properties.parallel_jaw >= 0 && k < lanes<double>; ++k)
                    masses[properties.parallel_jaw] += contact_mass[k];
            }
            if (visits) {
                visits->all += n_visited;
                if (properties.has_friction()) visits->with_friction += n_visited;
            }
            double& largest_energy = properties.parallel_jaw < 0 ? max_energy : jaw_energy[properties.parallel_jaw];
            for (int k = 0; k < lanes<double>; ++k) largest_energy = larger<double>(largest[k], largest_energy);
        });
    const ContactLaw<double> stop_law(contacts.thickness, contacts.damping);
    for (std::size_t k = 0; k < contacts.parallel_jaws.size(); ++k) {
        const ParallelJaw& jaw = contacts.parallel_jaws[k];
        if (!jaw.present) continue;
        const double half_opening = contacts.jaw_states[k * jaw_state_size],
                     speed = contacts.jaw_states[k * jaw_state_size + 1];
        const double stop_energy =
            jaw.stop_energy(stop_law, thickness, half_opening, jaw.driven_speed(speed, duration), duration);
        max_energy =
            larger(stiffened_energy(stop_law, thickness, jaw_energy[k], stop_energy, masses[k] / jaw.mass), max_energy);
    }
    return max_energy;
}

}  // namespace cloth::contact
