// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What is asked of contact beside its forces: energy, powers, bounds, derivative product, and what is about to happen.
// Arrays are (3, n) by component; sums run obstacle by obstacle, particle by particle.
#pragma once

#include "list_measures.hpp"
#include "plan.hpp"

namespace cloth {

/// What a call of `for_each_near` tells of one particle.
struct NearOne {
    std::int64_t obstacle, particle;
    double gap, closing, mass;
    Vec3<double> normal, arm, slip;
    const Placed<double>& placed;
    Scaling<double> scaling = whole_thickness<double>();
    Stand<double> stands() const { return {arm, gap, normal, slip, closing}; }
    /// The gap in units of the whole thickness, and pushes, energy and bounds by a law of that.
    double scaled_gap() const { return scaling.gap(gap); }
    typename ContactLaw<double>::Answer answer(const ContactLaw<double>& law) const {
        const auto a = law.answer(scaled_gap(), scaling.closing(gap, closing));
        return {a.push / scaling.scale, a.elastic / scaling.scale, a.shape};
    }
    double elastic(const ContactLaw<double>& law) const { return law.elastic(scaled_gap()) / scaling.scale; }
    double energy(const ContactLaw<double>& law) const {
        return law.energy(scaled_gap()) / (scaling.scale * scaling.scale);
    }
};

/// Blocks of particles one after the other. They lie where they are, but for the last one: whole vectors of it may be read.
class Blocks {
public:
    Blocks(const Plan& plan, const double* x, const double* v) : plan_(plan), x_(x), v_(v) {}
    /// Those from `first` on; they hold until the next call.
    Block<double> at(std::int64_t first) {
        const std::int64_t n = plan_.count, count = std::min(contact_block, n - first);
        for (std::int64_t i = 0; i < count; ++i)
            mass_[i] = plan_.inverse[first + i] > 0.0 ? plan_.masses[first + i] : 0.0;
        if (v_ && count == contact_block) return {x_ + first, v_ + first, n, mass_, count};
        if (count < contact_block) {
            std::fill(room_, room_ + 6 * contact_block, 0.0);
            std::fill(mass_ + count, mass_ + contact_block, 0.0);
        }
        for (int c = 0; c < 3; ++c) {
            std::copy_n(x_ + c * n + first, count, room_ + c * contact_block);
            if (v_) std::copy_n(v_ + c * n + first, count, room_ + (3 + c) * contact_block);
        }
        return {room_, room_ + 3 * contact_block, contact_block, mass_, count};
    }

private:
    const Plan& plan_;
    const double *x_, *v_;
    alignas(64) double room_[6 * contact_block] = {}, mass_[contact_block];
};

/// Call `what(obstacle, first, shape, placed, block)` for each block of particles that is near an obstacle, if not
/// `skips(obstacle, placed)`. A block is near if its least gap is below `widest(speed)` [m], where `speed` is that of its
/// fastest particle as seen from the obstacle [m/s].
template <class S, class W, class F>
inline void for_each_near_block(const Plan& plan, double t, const double* x, const double* v, S&& skips, W&& widest,
                                F&& what) {
    const Contacts& contacts = plan.contacts;
    const double origin[3] = {};
    Blocks blocks(plan, x, v);
    for (std::int64_t obstacle = 0; obstacle < contacts.count(); ++obstacle) {
        if (!contacts.present(obstacle)) continue;
        Placed<double> placed(contacts.pose(obstacle, t), origin, contacts.obstacles[obstacle]);
        if (contacts.pinch_of(obstacle)) placed.lever = placed.place - pose_at(contacts.path(obstacle), t).place;
        if (skips(obstacle, placed)) continue;
        const Vec3<double>& size = contacts.obstacles[obstacle].size;
        with_shape(contacts.obstacles[obstacle].shape, [&](auto shape) {
            for (std::int64_t first = 0; first < plan.count; first += contact_block) {
                const Block<double> block = blocks.at(first);
                const auto found = look<shape.value, true, double>(placed, size, block, contacts.thickness, 0.0).found();
                if (found.gap < widest(found.speed)) what(obstacle, first, shape, placed, block);
            }
        });
    }
}
/// Call `what` for each free particle of those blocks.
template <class W, class F>
inline void for_each_near(const Plan& plan, double t, const double* x, const double* v, W&& widest, F&& what) {
    const auto none = [](std::int64_t, const Placed<double>&) { return false; };
    for_each_near_block(plan, t, x, v, none, widest, [&](std::int64_t obstacle, std::int64_t first, auto shape,
                                                         const Placed<double>& placed, const Block<double>& block) {
        const Vec3<double>& size = plan.contacts.obstacles[obstacle].size;
        for (std::int64_t i = 0; i < block.count; ++i) {
            if (!(block.mass[i] > 0.0)) continue;
            const auto s = stand<shape.value, true, double>(placed, size, block.place<double>(i), block.velocity<double>(i));
            what(NearOne{obstacle, first + i, s.gap, s.closing, block.mass[i], s.normal, s.arm, s.slip, placed,
                         plan.contacts.reduced.scaling(obstacle, first + i, plan.count + 1, t)});
        }
    });
}
/// The same for particles in contact.
template <class F>
inline void for_each_contact(const Plan& plan, double t, const double* x, const double* v, F&& what) {
    const double thickness = plan.contacts.thickness;
    for_each_near(plan, t, x, v, [&](double) { return thickness; }, [&](const NearOne& one) {
        if (one.scaled_gap() < thickness) what(one);
    });
}

/// What friction does at one contact, with the plan's anchors. Those of the caller's own are handed over in `anchor`.
template <class V>
inline auto rubbing(const Plan& plan, std::int64_t obstacle, std::int64_t particle, const Placed<double>& placed,
                    const Stand<V>& s, V push, const double* anchors) {
    const std::int64_t n = plan.count;
    const double* const a = anchors + obstacle * anchor_numbers * n + particle;
    const FrictionLaw<V> law(plan.contacts.obstacles[obstacle].rough, plan.contacts.frequency);
    const double bond = a[3 * n];
    const Vec3<V> here = placed.template inward<V>(s.arm);
    const Vec3<V> anchor = bond > 0.0 ? splat3<V>(Vec3<double>{a[0], a[n], a[2 * n]}) : here;
    return law.rub(placed.template outward<V>(here - anchor), s.normal, s.slip, push);
}

/// Anchors after runs that ended with some of their own, each (obstacles, anchor_numbers, n), at the state x and v that
/// the runs' weights make: what no run moved stays as it is; the rest is combined too, and dragged back onto the cone.
inline void settle_anchors(const Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                           const double* weights, const double* ends, double* out) {
    const Contacts& contacts = plan.contacts;
    const std::int64_t n = plan.count, size = plan.anchor_count();
    std::fill(out, out + size, 0.0);
    const auto law = contacts.law<double>();
    for_each_contact(plan, t, x, v, [&](const NearOne& one) {
        if (!(contacts.obstacles[one.obstacle].rough.still > 0.0)) return;
        const std::int64_t place = one.obstacle * anchor_numbers * n + one.particle;
        double* const to = out + place;
        const double* const last = ends + (runs - 1) * size + place;
        bool all = true, same = true;
        for (std::int64_t run = 0; run < runs; ++run) {
            const double* const from = ends + run * size + place;
            all = all && from[3 * n] > 0.0;
            for (int c = 0; c < anchor_numbers; ++c) same = same && from[c * n] == last[c * n];
        }
        for (int c = 0; c < anchor_numbers; ++c) to[c * n] = last[c * n];
        for (int c = 0; all && !same && c < 3; ++c) {
            double sum = 0.0;
            for (std::int64_t run = 0; run < runs; ++run) sum = fma(weights[run], ends[run * size + place + c * n], sum);
            to[c * n] = sum;
        }
        const Stand<double> s = one.stands();
        const auto rubbed =
            rubbing<double>(plan, one.obstacle, one.particle, one.placed, s, one.answer(law).push, out);
        const Vec3<double> here = one.placed.inward<double>(s.arm);
        const Vec3<double> dragged = here - one.placed.inward<double>(rubbed.stretch);
        if (rubbed.slides || !(to[3 * n] > 0.0)) {
            const Vec3<double> anchor = rubbed.slides ? dragged : here;
            to[0] = anchor.x, to[n] = anchor.y, to[2 * n] = anchor.z;
        }
        to[3 * n] = rubbed.slides ? double(slides) : double(sticks);
    });
}

inline double contact_energy(const Plan& plan, double t, const double* x) {
    const auto law = plan.contacts.law<double>();
    double total = 0.0;
    for_each_contact(plan, t, x, nullptr, [&](const NearOne& one) {
        total += one.mass * one.energy(law);
        if (plan.contacts.obstacles[one.obstacle].rough.still > 0.0)
            total += one.mass * rubbing<double>(plan, one.obstacle, one.particle, one.placed, one.stands(),
                                                one.elastic(law), plan.contacts.anchors.data())
                                    .energy;
    });
    return total;
}

/// Wrench on each obstacle about its place, work on the cloth and loss, as rates: added to (obstacles, booked_numbers).
inline void contact_rates(const Plan& plan, double t, const double* x, const double* v, double weight, double* rates) {
    const auto law = plan.contacts.law<double>();
    for_each_contact(plan, t, x, v, [&](const NearOne& one) {
        const auto answer = one.answer(law);
        Vec3<double> force = (one.mass * answer.push) * one.normal;
        const double closing = fma(one.scaling.growth, one.gap, one.closing);
        double lost = one.mass * (answer.push - answer.elastic) * closing;
        if (plan.contacts.obstacles[one.obstacle].rough.still > 0.0) {
            const auto rubbed = rubbing<double>(plan, one.obstacle, one.particle, one.placed, one.stands(), answer.push,
                                                plan.contacts.anchors.data());
            force = force + one.mass * rubbed.push;
            lost += one.mass * rubbed.lost;
        }
        const Vec3<double> torque = cross(force, one.arm + one.placed.lever);
        const Vec3<double> moving = one.placed.speed + cross(one.placed.spin, one.arm);
        const double now[booked_numbers] = {-force.x, -force.y, -force.z, torque.x, torque.y, torque.z,
                                            dot(force, moving), lost};
        for (int k = 0; k < booked_numbers; ++k) rates[one.obstacle * booked_numbers + k] += weight * now[k];
    });
}

/// Power of the growth of contacts with a reduced thickness [W].
inline double contact_grown(const Plan& plan, double t, const double* x, const double* v) {
    const auto law = plan.contacts.law<double>();
    double grown = 0.0;
    for_each_contact(plan, t, x, v, [&](const NearOne& one) {
        const double push = one.answer(law).push, energy = one.energy(law);
        grown += one.mass * one.scaling.growth * fma(push, one.gap, 2.0 * energy);
    });
    return grown;
}

/// Add blocks of stiffness and damping across the gap. What a curved surface adds along itself only softens.
inline void add_contact_bounds(const Plan& plan, double t, const double* x, double* stiff, double* damp) {
    const auto law = plan.contacts.law<double>();
    for_each_contact(plan, t, x, nullptr, [&](const NearOne& one) {
        // Along the surface an anchor's spring.
        const bool rough = plan.contacts.obstacles[one.obstacle].rough.still > 0.0;
        const double w = rough ? plan.contacts.frequency : 0.0, along = one.mass * w * w;
        const double rubs = one.mass * FrictionLaw<double>::damping_share * w;
        if (stiff)
            add_block(stiff, plan.count, one.particle,
                      outer(one.mass * law.stiffness(one.scaled_gap()) - along, one.normal, along));
        if (damp)
            add_block(damp, plan.count, one.particle,
                      outer(one.mass * law.damping(one.scaled_gap()) - rubs, one.normal, rubs));
    });
}

/// Squared frequency [1/s^2] and damping rate [1/s] of contact that has taken up so much energy per mass, in U^2/2.
struct ContactLimits {
    double omega2 = 0.0, damping = 0.0;
    ContactLimits(const Contacts& contacts, double reached) {
        for (const Pinch& pinch : contacts.pinches)
            if (pinch.present) damping = larger(2.0 * pinch.force / (pinch.speed * pinch.mass), damping);
        if (!(reached > 0.0)) return;
        const auto law = contacts.law<double>();
        const double gap = stopping_gap(reached) * contacts.thickness;
        omega2 = law.stiffness(gap);
        damping = larger(law.damping(gap), damping);
        if (!contacts.rough()) return;
        omega2 = larger(contacts.frequency * contacts.frequency, omega2);
        damping = larger(FrictionLaw<double>::damping_share * contacts.frequency, damping);
    }
};

/// Accelerations [m/s^2] of half the ways between pads at time t, by the cloth and their drives; `felt` [N] is what else
/// moves them outward, by the pinch.
inline void pinch_accelerations(const Plan& plan, double t, const double* x, const double* v, std::vector<double> felt,
                                double* out) {
    const Contacts& contacts = plan.contacts;
    const auto law = contacts.law<double>();
    for_each_contact(plan, t, x, v, [&](const NearOne& one) {
        const Obstacle& obstacle = contacts.obstacles[one.obstacle];
        if (obstacle.pinch < 0) return;
        const double push = one.answer(law).push;
        Vec3<double> force = push * one.normal;
        if (obstacle.rough.still > 0.0)
            force = force + rubbing<double>(plan, one.obstacle, one.particle, one.placed, one.stands(), push,
                                            contacts.anchors.data()).push;
        felt[obstacle.pinch] -= one.mass * obstacle.side * dot(one.placed.rotation[1], force);
    });
    for (std::size_t k = 0; k < contacts.pinches.size(); ++k) {
        const double* const at = contacts.pinched.data() + k * pinch_numbers;
        const Pinch& pinch = contacts.pinches[k];
        out[k] = pinch.present ? pinch.acceleration(law, contacts.thickness, at[0], at[1], felt[k]) : 0.0;
    }
}

/// Add (df/dx) dx + (df/dv) dv to out, by the law itself on numbers with derivatives.
inline void add_contact_product(const Plan& plan, double t, const double* x, const double* v, const double* dx,
                                const double* dv, double* out) {
    const std::int64_t n = plan.count;
    const ContactLaw<Dual> law(plan.contacts.thickness, plan.contacts.damping);
    for_each_contact(plan, t, x, v, [&](const NearOne& one) {
        const Obstacle& obstacle = plan.contacts.obstacles[one.obstacle];
        const auto at = [&](const double* a, const double* slope) {
            const std::int64_t i = one.particle;
            return Vec3<Dual>{{a[i], slope[i]}, {a[n + i], slope[n + i]}, {a[2 * n + i], slope[2 * n + i]}};
        };
        with_shape(obstacle.shape, [&](auto shape) {
            const auto s = stand<shape.value, true, Dual>(one.placed, obstacle.size, at(x, dx), at(v, dv));
            const Scaling<Dual> scaling{{one.scaling.scale, 0.0}, {one.scaling.growth, 0.0}};
            const Dual push = law.push(scaling.gap(s.gap), scaling.closing(s.gap, s.closing)) / scaling.scale;
            Vec3<Dual> force = push * s.normal;
            if (obstacle.rough.still > 0.0)
                force = force + rubbing<Dual>(plan, one.obstacle, one.particle, one.placed, s, push,
                                              plan.contacts.anchors.data()).push;
            force = Dual{one.mass, 0.0} * force;
            out[one.particle] += force.x.slope;
            out[n + one.particle] += force.y.slope;
            out[2 * n + one.particle] += force.z.slope;
        });
    });
}

/// How many particles are in contact with each obstacle, and the least gap to each, in contact or not: (obstacles, 2).
inline void contact_gaps(const Plan& plan, double t, const double* x, double* out) {
    for (std::int64_t obstacle = 0; obstacle < plan.contacts.count(); ++obstacle) {
        out[2 * obstacle] = 0.0;
        out[2 * obstacle + 1] = std::numeric_limits<double>::infinity();
    }
    const auto anyone = [](double) { return no_gap<double>; };
    for_each_near(plan, t, x, nullptr, anyone, [&](const NearOne& one) {
        double* const to = out + 2 * one.obstacle;
        to[0] += one.scaled_gap() < plan.contacts.thickness ? 1.0 : 0.0;
        to[1] = smaller(one.gap, to[1]);
    });
}
/// The gap of each contact [m], as `ReducedThickness` has them: rows of obstacles and particles.
inline void contact_gap_rows(const Plan& plan, double t, const double* x, double* out) {
    const auto anyone = [](double) { return no_gap<double>; };
    for_each_near(plan, t, x, nullptr, anyone,
                  [&](const NearOne& one) { out[one.obstacle * (plan.count + 1) + one.particle] = one.gap; });
}

/// Whether any particle meets an obstacle's surface on its straight way from x0 at time t to x1, `duration` [s] later.
/// Conservative advancement: a particle cannot meet the surface before it has moved, relative to the obstacle, as far
/// as its gap. So each step along the way is one gap long, and the gap is then measured anew.
inline bool contact_crosses(const Plan& plan, double t, double duration, const double* x0, const double* x1) {
    const std::int64_t n = plan.count;
    const double origin[3] = {}, least = 1e-3 * plan.contacts.thickness;
    bool crosses = false;
    const auto anyone = [](double) { return no_gap<double>; };
    for_each_near(plan, t, x0, nullptr, anyone, [&](const NearOne& one) {
        if (crosses) return;
        const double* const path = plan.contacts.path(one.obstacle);
        const Obstacle& obstacle = plan.contacts.obstacles[one.obstacle];
        const std::int64_t i = one.particle;
        const Vec3<double> from{x0[i], x0[n + i], x0[2 * n + i]}, to{x1[i], x1[n + i], x1[2 * n + i]};
        // An upper bound of how far the particle moves relative to the obstacle, whose place is a cubic of time: by the
        // velocities halfway, and by how much the obstacle's may differ from that. What goes along with it hardly moves.
        const auto order = [&](int k) { return Vec3<double>{path[4 + 3 * k], path[5 + 3 * k], path[6 + 3 * k]}; };
        const double half = 0.5 * duration, middle = t + half - path[0], end = t + duration - path[0];
        const Vec3<double> velocity = order(0) + (2.0 * middle) * order(1) + (3.0 * middle * middle) * order(2);
        const double differs = half * root(norm2(2.0 * order(1) + (6.0 * middle) * order(2))) +
                               3.0 * half * half * root(norm2(order(2)));
        double way = root(norm2(to - from - duration * velocity)) + duration * differs, turn = 0.0;
        for (int k = 0; k < 3; ++k) {
            const double power = (k == 0 ? 1.0 : k == 1 ? 2.0 * end : 3.0 * end * end) * duration;
            const double* const r = path + 17 + 3 * k;
            turn += power * root(norm2(Vec3<double>{r[0], r[1], r[2]}));
        }
        // A pad turns about its gripper.
        way += turn * (root(norm2(one.arm)) + root(norm2(one.placed.lever)) + way);
        if (one.gap > way) return;
        for (double part = 0.0, gap = one.gap; part < 1.0 && !crosses;) {
            part = smaller(part + larger(gap, least) / way, 1.0);
            const Placed<double> placed(plan.contacts.pose(one.obstacle, t + part * duration), origin, obstacle);
            gap = with_shape(obstacle.shape, [&](auto shape) {
                return stand<shape.value, true, double>(placed, obstacle.size, from + part * (to - from), {}).gap;
            });
            crosses = !(gap > 0.0);
        }
    });
    return crosses;
}

}  // namespace cloth
