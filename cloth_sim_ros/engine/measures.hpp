// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What is asked of a whole scene beside its motion: energy, power, bounds, derivative product. Arrays are (3, n).
#pragma once

#include "contact_feature_measures.hpp"
#include "contact_measures.hpp"
#include "grid_bounds.hpp"
#include "plan.hpp"
#include "self_measures.hpp"

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
    const Held& held = plan.held;
    for (std::int64_t grip = 0; grip < held.count(); ++grip) {
        const Pose pose = pose_at(held.paths.data() + held.gripper[grip] * path_numbers, t);
        const Vec3<double> d = particle(x, n, held.particle[grip]) - held.point(pose, grip).place;
        const typename Joint::Params<double> params{held.stiffness[grip], held.damping[grip]};
        e.potential += Joint::energy(params, &d);
    }
    if (plan.contacts.count()) e.potential += contact_energy(plan, t, x);
    if (plan.self) e.potential += self_energy(plan, x);
    if (plan.features) e.potential += feature_energy(plan, t, x);
    return e;
}

inline void other_powers(const Plan& plan, const double* x, const double* v, double& lost, double& given) {
    const std::int64_t n = plan.count;
    if (plan.grid) lost += grid_lost(*plan.grid, plan.tables, x, v);
    const Vec3<double> wind{plan.wind[0], plan.wind[1], plan.wind[2]};
    const bool blows = norm2(wind) > 0.0;
    if (plan.drag == 0.0 && !blows) return;
    double slowed = 0.0, pushed = 0.0;
    for (std::int64_t i = 0; i < n; ++i) {
        const Vec3<double> u = particle(v, n, i);
        slowed += plan.masses[i] * norm2(u);
        if (blows) pushed += plan.masses[i] * dot(wind, u);
    }
    lost += plan.drag * slowed;
    given += pushed;
}

inline void powers(Plan& plan, const double* x, const double* v, double& lost, double& given) {
    if (plan.self) lost += self_lost(plan, x, v);
    for (const List& list : plan.lists) list_power(list, x, v, plan.count, lost, given);
    other_powers(plan, x, v, lost, given);
}

/// Wrench, work and loss rates of the joints at time t: (grippers, booked_numbers), summed up.
inline void grip_rates(const Plan& plan, double t, const double* x, const double* v, double* rates) {
    const Held& held = plan.held;
    for (std::int64_t grip = 0; grip < held.count(); ++grip) {
        const Pose pose = pose_at(held.paths.data() + held.gripper[grip] * path_numbers, t);
        const auto point = held.point(pose, grip);
        const Vec3<double> at = particle(x, plan.count, held.particle[grip]);
        const Vec3<double> moving = particle(v, plan.count, held.particle[grip]);
        held.book(rates + held.gripper[grip] * booked_numbers, grip, point, held.force(grip, point, at, moving), moving,
                  1.0);
    }
}

/// Largest number of an array, and whether all were numbers.
inline double largest_or_nan(const double* numbers, std::int64_t count) {
    double most = 0.0;
    bool bad = false;
    for (std::int64_t i = 0; i < count; ++i) {
        most = numbers[i] > most ? numbers[i] : most;
        bad = bad || !(numbers[i] == numbers[i]);
    }
    return bad ? __builtin_nan("") : most;
}

/// Add to (6, n) what all parts but grippers, contact and drag bound stiffness and damping by.
inline void add_bounds(const Plan& plan, const double* x, double* stiff, double* damp) {
    if (plan.grid) add_grid_bounds(*plan.grid, plan.tables, x, stiff, damp);
    for (const List& list : plan.lists) add_list_bounds(list, x, plan.count, stiff, damp);
}

inline void eigenvalues(const double* blocks, std::int64_t n, double* to) {
    for (std::int64_t i = 0; i < n; i += lanes<double>) {
        Array<double> rest(6 * lanes<double>, 0.0);
        const bool whole = i + lanes<double> <= n;
        if (!whole)
            for (int c = 0; c < 6; ++c)
                for (std::int64_t k = i; k < n; ++k) rest[c * lanes<double> + k - i] = blocks[c * n + k];
        const auto at = [&](int c) { return whole ? load(blocks + c * n + i) : load(rest.data() + c * lanes<double>); };
        const vec<double> found = largest_eigenvalue(Sym3<vec<double>>{at(0), at(1), at(2), at(3), at(4), at(5)});
        if (whole)
            store(to + i, found);
        else
            for (std::int64_t k = i; k < n; ++k) to[k] = found[k - i];
    }
}

struct Rates {
    double omega2, damping;
};
/// Bounds of the squared highest frequency [1/s^2] and the highest damping rate [1/s], contact aside. `stiff` [N/m] and
/// `damp` [N s/m], (6, n) or null, hold the blocks of the caller's own forces.
inline Rates rates_of(Plan& plan, const double* x, const double* stiff, const double* damp) {
    const std::int64_t n = plan.count;
    Array<double> k(n), c(n, 0.0);
    if (plan.lists.empty() && plan.grid && !stiff) {
        // Single precision takes half the time. Its rounding is far below the safety margin of a step.
        const Grid& grid = *plan.grid;
        GridBounds<float> bounds(grid, plan.grid_tables<float>(), x);
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            bounds.take_row(row);
            for (std::int64_t j = 0; j < grid.columns; j += lanes<float>) {
                Sym3<vec<float>> stiffness, damping;
                bounds.of(row, j, stiffness, damping);
                const vec<float> a = largest_eigenvalue(stiffness);
                const vec<float> b = bounds.damped ? largest_eigenvalue(damping) : vec<float>{};
                const std::int64_t most = std::min<std::int64_t>(lanes<float>, grid.columns - j);
                for (std::int64_t lane = 0; lane < most; ++lane) {
                    k[row * grid.columns + j + lane] = bounds.unit_stiffness * static_cast<double>(a[lane]);
                    c[row * grid.columns + j + lane] = bounds.unit_damping * static_cast<double>(b[lane]);
                }
            }
        }
    } else {
        Array<double> blocks(12 * n, 0.0);
        if (stiff) std::copy(stiff, stiff + 6 * n, blocks.begin());
        if (damp) std::copy(damp, damp + 6 * n, blocks.begin() + 6 * n);
        add_bounds(plan, x, blocks.data(), blocks.data() + 6 * n);
        eigenvalues(blocks.data(), n, k.data());
        eigenvalues(blocks.data() + 6 * n, n, c.data());
    }
    // A grip pulls on one particle only: its point moves as commanded. So its blocks are k I, not 2 k I.
    for (std::int64_t grip = 0; grip < plan.held.count(); ++grip) {
        k[plan.held.particle[grip]] += plan.held.stiffness[grip];
        c[plan.held.particle[grip]] += plan.held.damping[grip];
    }
    bool free = false;
    for (std::int64_t i = 0; i < n; ++i) {
        k[i] *= plan.inverse[i];
        c[i] *= plan.inverse[i];
        free = free || plan.inverse[i] > 0.0;
    }
    return {largest_or_nan(k.data(), n), largest_or_nan(c.data(), n) + (free ? plan.drag : 0.0)};
}

/// Add (df/dx) dx + (df/dv) dv [N] to out.
inline void add_product(Plan& plan, double t, const double* x, const double* v, const double* dx,
                        const double* dv, double* out) {
    const std::int64_t n = plan.count;
    if (plan.grid) add_grid_product(*plan.grid, x, v, dx, dv, out);
    for (const List& list : plan.lists) add_list_product(list, x, v, dx, dv, n, out);
    if (plan.contacts.count()) add_contact_product(plan, t, x, v, dx, dv, out);
    if (plan.self) add_self_product(plan, x, v, dx, dv, out);
    if (plan.features) add_feature_product(plan, t, x, v, dx, dv, out);
    for (int axis = 0; axis < 3; ++axis) {
        if (plan.drag > 0.0)
            for (std::int64_t i = 0; i < n; ++i) out[axis * n + i] -= plan.drag * plan.masses[i] * dv[axis * n + i];
        for (std::int64_t grip = 0; grip < plan.held.count(); ++grip) {
            const std::int64_t at = axis * n + plan.held.particle[grip];
            out[at] -= plan.held.stiffness[grip] * dx[at] + plan.held.damping[grip] * dv[at];
        }
    }
}

}  // namespace cloth
