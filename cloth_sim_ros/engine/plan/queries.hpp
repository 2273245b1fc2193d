// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of a whole scene: energy, power, derivative product. Arrays are (3, n).
#pragma once

#include "contact/feature_queries.hpp"
#include "contact/obstacle_queries.hpp"
#include "contact/self_queries.hpp"
#include "plan/spectral_bounds.hpp"

namespace cloth {

inline Vec3<double> particle(const double* a, std::int64_t n, std::int64_t i) { return {a[i], a[n + i], a[2 * n + i]}; }

struct Energy {
    double kinetic = 0.0, potential = 0.0;
};
inline Energy energy_of(Plan& plan, double t, const double* x, const double* v) {
    const std::int64_t n = plan.count;
    Energy e;
    if (plan.grid) e.potential += grid_energy(*plan.grid, plan.tables, x);
    for (const List& list : plan.lists) e.potential += list_energy(list, x, n);
    const Vec3<double> gravity{plan.gravity[0], plan.gravity[1], plan.gravity[2]};
    double weight = 0.0;
    for (std::int64_t i = 0; i < n; ++i) {
        if (v) e.kinetic += 0.5 * plan.masses[i] * norm2(particle(v, n, i));
        weight += plan.masses[i] * dot(gravity, particle(x, n, i));
    }
    e.potential -= weight;
    const Grips& grips = plan.grips;
    for (std::int64_t grip = 0; grip < grips.count(); ++grip) {
        const Pose pose = pose_at(grips.paths.data() + grips.gripper[grip] * path_numbers, t);
        const Vec3<double> d = particle(x, n, grips.particle[grip]) - grips.point(pose, grip).position;
        const typename Joint::Params<double> params{grips.stiffness[grip], grips.damping[grip]};
        e.potential += Joint::energy(params, &d);
    }
    if (plan.contacts.count()) e.potential += contact_energy(plan, t, x);
    if (plan.self) e.potential += self_energy(plan, t, x);
    if (plan.features) e.potential += feature_energy(plan, t, x);
    return e;
}

inline void grid_and_field_powers(const Plan& plan, const double* x, const double* v, double& dissipation,
                                  double& external) {
    const std::int64_t n = plan.count;
    if (plan.grid) dissipation += grid_dissipation(*plan.grid, plan.tables, x, v);
    const Vec3<double> wind{plan.wind[0], plan.wind[1], plan.wind[2]};
    const bool has_wind = norm2(wind) > 0.0;
    if (plan.drag == 0.0 && !has_wind) return;
    double drag_sum = 0.0, wind_power = 0.0;
    for (std::int64_t i = 0; i < n; ++i) {
        const Vec3<double> u = particle(v, n, i);
        drag_sum += plan.masses[i] * norm2(u);
        if (has_wind) wind_power += plan.masses[i] * dot(wind, u);
    }
    dissipation += plan.drag * drag_sum;
    external += wind_power;
}

inline void total_powers(Plan& plan, double t, const double* x, const double* v, double& dissipation,
                         double& external) {
    if (plan.self) dissipation += self_dissipation(plan, t, x, v);
    for (const List& list : plan.lists) list_power(list, x, v, plan.count, dissipation, external);
    grid_and_field_powers(plan, x, v, dissipation, external);
}

/// Add the wrench, power and dissipation of the joints at time t, (grippers, record_numbers).
inline void add_grip_wrenches(const Plan& plan, double t, const double* x, const double* v, double* wrenches) {
    const Grips& grips = plan.grips;
    for (std::int64_t grip = 0; grip < grips.count(); ++grip) {
        const Pose pose = pose_at(grips.paths.data() + grips.gripper[grip] * path_numbers, t);
        const auto point = grips.point(pose, grip);
        const Vec3<double> position = particle(x, plan.count, grips.particle[grip]);
        const Vec3<double> velocity = particle(v, plan.count, grips.particle[grip]);
        grips.accumulate(wrenches + grips.gripper[grip] * record_numbers, grip, point,
                         grips.force(grip, point, position, velocity), velocity, 1.0);
    }
}

/// Add (df/dx) dx + (df/dv) dv [N] to out.
inline void add_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                        double* out) {
    const std::int64_t n = plan.count;
    if (plan.grid) add_grid_product(*plan.grid, x, v, dx, dv, out);
    for (const List& list : plan.lists) add_list_product(list, x, v, dx, dv, n, out);
    if (plan.contacts.count()) add_contact_product(plan, t, x, v, dx, dv, out);
    if (plan.self) add_self_product(plan, t, x, v, dx, dv, out);
    if (plan.features) add_feature_product(plan, t, x, v, dx, dv, out);
    for (int axis = 0; axis < 3; ++axis) {
        if (plan.drag > 0.0)
            for (std::int64_t i = 0; i < n; ++i) out[axis * n + i] -= plan.drag * plan.masses[i] * dv[axis * n + i];
        for (std::int64_t grip = 0; grip < plan.grips.count(); ++grip) {
            const std::int64_t at = axis * n + plan.grips.particle[grip];
            out[at] -= plan.grips.stiffness[grip] * dx[at] + plan.grips.damping[grip] * dv[at];
        }
    }
}

}  // namespace cloth
