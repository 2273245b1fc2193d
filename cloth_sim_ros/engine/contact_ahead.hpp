// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What contact is about to come to. Arrays are (3, n) by component.
#pragma once

#include "contact_extent.hpp"
#include "contact_measures.hpp"

namespace cloth {

/// How often particles were looked at for being in reach of an obstacle: of any, of one with friction.
struct Visits {
    std::int64_t all = 0, rough = 0;
};

/// Energy per mass, in U^2/2, that contact may have to take up within `duration`: of particles in contact what it has taken
/// up already and that of their closing speed; of those that come into contact by then that of the speed that they come
/// with, weight and wind included.
inline double contact_ahead(const Plan& plan, double t, double duration, const double* x, const double* v,
                            Visits* visits = nullptr) {
    using V = vec<double>;
    const Contacts& contacts = plan.contacts;
    if (!contacts.count()) return 0.0;
    const auto law = contacts.law<V>();
    const double push = 2.0 * root(norm2(Vec3<double>{plan.push(0), plan.push(1), plan.push(2)}));
    const double thickness = contacts.thickness, per = 1.0 / ContactLaw<double>::speed;
    const auto reach = [&](auto speed) {
        using U = decltype(speed);
        return splat<U>(thickness) + (speed + splat<U>(0.5 * push * duration)) * splat<U>(duration);
    };
    // An obstacle that speeds up on its path is counted with the greatest speed of its middle and its end.
    // Pads are driven to the speed that they have without load.
    std::vector<Placed<double>> later;
    later.reserve(2 * contacts.count());
    const double origin[3] = {};
    for (std::int64_t obstacle = 0; obstacle < contacts.count(); ++obstacle)
        for (const double share : {0.5, 1.0}) {
            const Pose pose = pose_at(contacts.path(obstacle), t + share * duration);
            const Pinch* const pinch = contacts.pinch_of(obstacle);
            const double way = pinch ? contacts.pinched[contacts.obstacles[obstacle].pinch * pinch_numbers] : 0.0;
            const double rate = !pinch || duration == 0.0 ? 0.0 : pinch->closed ? -pinch->speed : pinch->speed;
            later.emplace_back(contacts.shifted(pose, obstacle, way, rate), origin, contacts.obstacles[obstacle]);
        }
    double fastest = 0.0, most = 0.0;
    std::vector<double> pinched(contacts.pinches.size(), 0.0), masses(contacts.pinches.size(), 0.0);
    for (const Placed<double>& one : later) fastest = larger(root(norm2(one.speed)), fastest);
    // An obstacle that is twice as far off as any particle reaches is in reach of no block: that is told at one look. A
    // pad's ball is about its gripper, and pads mostly are near.
    const Extent cloth(x, plan.count);
    const double cloth_speed = fastest_of(v, plan.count);
    const auto far = [&](std::int64_t obstacle, const Placed<double>& placed) {
        return cloth.finite && !contacts.pinch_of(obstacle) &&
               cloth.away(contacts.obstacles[obstacle], placed) - cloth.blurred(placed) >
                   2.0 * reach(cloth.seen(cloth_speed, placed) + fastest);
    };
    const auto widest = [&](double speed) { return reach(speed + fastest); };
    for_each_near_block(plan, t, x, v, far, widest, [&](std::int64_t obstacle, std::int64_t first, auto shape,
                                                        const Placed<double>& placed, const Block<double>& block) {
        const Obstacle& what = contacts.obstacles[obstacle];
        Vec3<V> more[2], spin[2];
        for (int k = 0; k < 2; ++k) {
            const Placed<double>& then = later[2 * obstacle + k];
            more[k] = splat3<V>(then.speed - placed.speed);
            spin[k] = splat3<V>(then.spin - placed.spin);
        }
        V largest{};
        std::int64_t looked = 0;
        for (std::ptrdiff_t j = 0; j < block.count; j += lanes<double>) {
            const V mass = load(block.mass + j);
            const auto s = stand<shape.value, true, V>(placed, what.size, block.place<V>(j), block.velocity<V>(j));
            V speed = s.closing;
            for (int k = 0; k < 2; ++k)
                speed = larger(s.closing + dot(more[k] + cross(spin[k], s.arm), s.normal), speed);
            V gap = s.gap, seen = speed, weight = splat<V>(2.0 * push);
            if (contacts.reduced.any()) {
                const ReducedThickness& reduced = contacts.reduced;
                const std::int64_t k = obstacle * (plan.count + 1) + first + j;
                const Scaling<V> scaling =
                    reduced.scaling<V>(load(reduced.at_start.data() + k), load(reduced.rates.data() + k), t);
                speed = fma(scaling.growth, gap, speed);
                seen = scaling.scale * speed;
                gap = scaling.gap(gap);
                weight = scaling.scale * weight;
            }
            speed = larger(speed, V{});
            seen = larger(seen, V{});
            const V way = larger(gap - splat<V>(thickness), V{});
            const V energy = splat<V>(per * per) * (seen * seen + weight * way) + law.shape(gap);
            const V comes = select(s.gap < reach(speed), mass, V{});
            largest = larger(select(comes > V{}, energy, V{}), largest);
            for (int k = 0; k < lanes<double>; ++k) looked += mass[k] > 0.0;
            for (int k = 0; what.pinch >= 0 && k < lanes<double>; ++k) masses[what.pinch] += comes[k];
        }
        if (visits) {
            visits->all += looked;
            if (what.rough.still > 0.0) visits->rough += looked;
        }
        double& of = what.pinch < 0 ? most : pinched[what.pinch];
        for (int k = 0; k < lanes<double>; ++k) of = larger<double>(largest[k], of);
    });
    const ContactLaw<double> stop(contacts.thickness, contacts.damping);
    for (std::size_t k = 0; k < contacts.pinches.size(); ++k) {
        const Pinch& pinch = contacts.pinches[k];
        if (!pinch.present) continue;
        const double way = contacts.pinched[k * pinch_numbers], now = contacts.pinched[k * pinch_numbers + 1];
        const double driven = duration == 0.0 ? now : (pinch.closed ? smaller(now, -pinch.speed) : larger(now, pinch.speed));
        const double stopped = pinch.stopped(stop, thickness, way, driven, duration);
        const double times = 2.0 + masses[k] / pinch.mass + (stopped > 0.0 ? 1.0 : 0.0);
        most = larger(stiffened(stop, thickness, larger(stopped, pinched[k]), times), most);
    }
    return most;
}

}  // namespace cloth
