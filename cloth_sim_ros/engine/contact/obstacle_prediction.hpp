// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Prediction of the energy that contact with obstacles has to absorb. Arrays are (3, n) by component.
#pragma once

#include "contact/obstacle_culling.hpp"
#include "contact/obstacle_queries.hpp"

namespace cloth::contact {

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
    const double origin[3] = {};
    for (std::int64_t obstacle = 0; obstacle < contacts.count(); ++obstacle)
        for (const double fraction : {0.5, 1.0}) {
            const Pose pose = pose_at(contacts.path(obstacle), t + fraction * duration);
            const ParallelJaw* const jaw = contacts.jaw_of(obstacle);
            const double half_opening =
                jaw ? contacts.jaw_states[contacts.obstacles[obstacle].parallel_jaw * jaw_state_size] : 0.0;
            const double jaw_speed = !jaw || duration == 0.0 ? 0.0 : jaw->closed ? -jaw->speed : jaw->speed;
            future.emplace_back(contacts.shifted_pose(pose, obstacle, half_opening, jaw_speed), origin,
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
            V largest{};
            std::int64_t n_visited = 0;
            for (std::ptrdiff_t j = 0; j < block.count; j += lanes<double>) {
                const V mass = load(block.mass + j);
                const auto s = contact_kinematics<shape.value, true, V>(posed, properties.size, block.position<V>(j),
                                                                        block.velocity<V>(j));
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
