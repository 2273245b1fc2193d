// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of the queries of a scene: laws of springs, joints, membranes, hinges and panels.

#include "plan/queries.hpp"

#include "contact/queries.hpp"
#include "grid/queries.hpp"
#include "mesh/queries.hpp"
#include "plan/grip_force.hpp"
#include "plan/spectral_bounds.hpp"
#include "plan/turn.hpp"

namespace cloth::plan {

using laws::Altitude, laws::BendingFriction, laws::Crossed, laws::EdgeEdge, laws::Membrane, laws::PointFace,
    laws::Spring, laws::StiffeningMembrane, mesh::Kind;

Energy energy_of(Plan& plan, double t, const double* x, const double* v) {
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
    for (const List& list : plan.lists)
        if (v && is_mass(list.kind)) e.kinetic += mesh::list_air_energy(list, x, v, n);
    const Grips& grips = plan.grips;
    for (std::int64_t grip = 0; grip < grips.count(); ++grip) {
        const Pose pose = pose_at(grips.paths.data() + grips.gripper[grip] * path_numbers, t);
        const Vec3<double> d = particle(x, n, grips.particle[grip]) - grips.point(pose, grip).position;
        const typename Joint::Params<double> params{grips.stiffness[grip], grips.damping[grip]};
        e.potential += Joint::energy(params, &d);
    }
    if (plan.contacts.count()) e.potential += contact::contact_energy(plan, t, x);
    if (plan.self || plan.features) contact::add_surface_energy(plan, t, x, e.potential);
    return e;
}

double turn_in_step(const Plan& plan, const double* x0, const double* x, std::int64_t steps, std::int64_t runs) {
    double square = 0.0;
    if (plan.grid) square = grid_turn2(*plan.grid, plan.tables, x0, x, steps);
    for (const List& list : plan.lists) {
        if (list.kind == Kind::spring) square = std::max(square, list_turn2(list, x0, x, plan.count, steps));
        if (runs > 1 && has_divisor(list.kind))
            square = std::max(square, vanishing_turn2(list, x0, x, plan.count, static_cast<double>(steps)));
    }
    return root(square);
}

void grid_and_field_powers(const Plan& plan, const double* x, const double* v, double& dissipation, double& external) {
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

void mass_blocks(const Plan& plan, const double* x, double* blocks) {
    std::fill_n(blocks, 6 * plan.count, 0.0);
    for (const List& list : plan.lists)
        if (is_mass(list.kind)) mesh::add_list_mass(list, x, plan.count, blocks);
}

void total_powers(Plan& plan, double t, const double* x, const double* v, double& dissipation, double& external) {
    if (plan.self) dissipation += contact::self_dissipation(plan, t, x, v);
    for (const List& list : plan.lists) list_power(list, x, v, plan.count, dissipation, external);
    grid_and_field_powers(plan, x, v, dissipation, external);
}

void add_grip_wrenches(const Plan& plan, double t, const double* x, const double* v, double* wrenches) {
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

void add_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                 double* out) {
    const std::int64_t n = plan.count;
    if (plan.grid) add_grid_product(*plan.grid, x, v, dx, dv, out);
    for (const List& list : plan.lists) add_list_product(list, x, v, dx, dv, n, out);
    if (plan.contacts.count()) contact::add_contact_product(plan, t, x, v, dx, dv, out);
    contact::add_surface_product(plan, t, x, v, dx, dv, out);
    for (int axis = 0; axis < 3; ++axis) {
        if (plan.drag > 0.0)
            for (std::int64_t i = 0; i < n; ++i) out[axis * n + i] -= plan.drag * plan.masses[i] * dv[axis * n + i];
        for (std::int64_t grip = 0; grip < plan.grips.count(); ++grip) {
            const std::int64_t at = axis * n + plan.grips.particle[grip];
            out[at] -= plan.grips.stiffness[grip] * dx[at] + plan.grips.damping[grip] * dv[at];
        }
    }
}

void hinge_jerk(const Plan& plan, const double* x, const double* v, double* out) {
    const std::int64_t n = plan.count;
    const std::vector<double> no_change(3 * n, 0.0);
    std::fill_n(out, 3 * n, 0.0);
    for (const List& list : plan.lists)
        if (list.slow) add_list_product(list, x, v, v, no_change.data(), n, out);
    for (int axis = 0; axis < 3; ++axis)
        for (std::int64_t i = 0; i < n; ++i) out[axis * n + i] *= plan.inverse[i];
}

namespace {
/// Add a velocity change of a particle [m/s] to its sum, with the sign that does not reduce the sum.
void add_larger(double* out, std::int64_t n, std::int64_t i, Vec3<double> part) {
    const Vec3<double> sum = particle(out, n, i), next = dot(sum, part) < 0.0 ? sum - part : sum + part;
    out[i] = next.x, out[n + i] = next.y, out[2 * n + i] = next.z;
}

/// Add the kinks of membranes whose strains meet a limit of stiffening.
void add_stiffening_kinks(const Plan& plan, const List& list, const Interval& interval, double* out) {
    const std::int64_t n = plan.count;
    const double step = interval.step, snap_time = step * step * step / 48.0;
    for (std::int64_t e = 0; e < list.count; ++e) {
        const ElementState<StiffeningMembrane> start(list, e, interval.x0, interval.v0, n),
            end(list, e, interval.x1, interval.v1, n);
        double strain[2][3], rate[2][3];
        StiffeningMembrane::strains(start.params, start.d, start.u, strain[0], rate[0]);
        StiffeningMembrane::strains(end.params, end.d, end.u, strain[1], rate[1]);
        for (int k = 0; k < 3; ++k) {
            const double strains[2] = {strain[0][k], strain[1][k]}, rates[2] = {rate[0][k], rate[1][k]};
            const double jump = StiffeningMembrane::limit_jump(end.params, k, strains, rates, interval.duration, step);
            if (!(jump > 0.0)) continue;
            Vec3<double> gradient[3];
            StiffeningMembrane::gradients(end.params, end.d, k, gradient);
            for (int c = 0; c < 3; ++c) {
                const std::int64_t i = list.corners[3 * e + c];
                add_larger(out, n, i, jump * snap_time * plan.free_inverse[i] * gradient[c]);
            }
        }
    }
}

/// Add the kinks of hinges with friction that begin or cease to yield.
void add_yield_kinks(const Plan& plan, const List& list, const Interval& interval, double* out) {
    const std::int64_t n = plan.count;
    // A constant force displaces by a/6 in the mean over a second's errors, as a velocity of a/3 does in half a second.
    const double step = interval.step, jerk_time = step * step / 8.0, offset_time = 1.0 / 3.0;
    for (std::int64_t e = 0; e < list.count; ++e) {
        const ElementState<BendingFriction> ends[2] = {{list, e, interval.x0, interval.v0, n},
                                                       {list, e, interval.x1, interval.v1, n}};
        const laws::Crossed::Length<double> lengths[2] = {laws::Crossed::length(ends[0].d),
                                                          laws::Crossed::length(ends[1].d)};
        const double h[2] = {lengths[0].h, lengths[1].h}, plastic[2] = {interval.plastic0[e], interval.plastic1[e]};
        double rates[2] = {};
        for (int k = 0; k < 2; ++k)
            for (int c = 0; c < 3; ++c) rates[k] += dot(lengths[k].gradient[c], ends[k].u[c]);
        BendingFriction::Kink kinks[2];
        BendingFriction::kinks(ends[0].params, h, rates, plastic, interval.duration, step, kinks);
        for (int k = 0; k < 2; ++k) {
            const double impulse = fma(jerk_time, kinks[k].jump, offset_time * kinks[k].tension);
            if (!(impulse > 0.0)) continue;
            const Vec3<double>* const g = lengths[k].gradient;
            const Vec3<double> gradient[4] = {-(g[0] + g[1] + g[2]), g[0], g[1], g[2]};
            for (int c = 0; c < 4; ++c) {
                const std::int64_t i = list.corners[4 * e + c];
                add_larger(out, n, i, impulse * plan.free_inverse[i] * gradient[c]);
            }
        }
    }
}
}  // namespace

void kink_velocities(const Plan& plan, const Interval& interval, double* out) {
    std::fill_n(out, 3 * plan.count, 0.0);
    for (std::int64_t index = 0; index < std::int64_t(plan.lists.size()); ++index) {
        const List& list = plan.lists[index];
        if (list.kind == Kind::stiffening_membrane) add_stiffening_kinks(plan, list, interval, out);
        if (index == plan.plastic_list) add_yield_kinks(plan, list, interval, out);
    }
}

void pair_blocks(const List& list, const double* x, std::int64_t n, double stiffness, double damping, double* blocks) {
    for (std::int64_t e = 0; e < list.count; ++e) {
        Sym3<double> b;
        if (list.kind == Kind::spring) {
            const ElementState<Spring> s(list, e, x, nullptr, n);
            b = Spring::matrix(s.params, s.d, stiffness, damping);
        } else {
            const ElementState<Joint> s(list, e, x, nullptr, n);
            b = outer(0.0, Vec3<double>{}, stiffness * s.params.k + damping * s.params.c);
        }
        const double numbers[6] = {b.xx, b.yy, b.zz, b.xy, b.xz, b.yz};
        std::copy(numbers, numbers + 6, blocks + 6 * e);
    }
}

void membrane_blocks(const List& list, const double* x, std::int64_t n, double stiffness, double damping,
                     double* blocks) {
    const auto evaluate = [&](auto law) {
        using Law = decltype(law);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, nullptr, n);
            Law::couplings(s.params, s.d, stiffness, damping, reinterpret_cast<double (*)[9]>(blocks + 27 * e));
        }
    };
    if (list.kind == Kind::stiffening_membrane)
        evaluate(StiffeningMembrane{});
    else
        evaluate(Membrane{});
}

double combine_plastic_lengths(const Plan& plan, const double* x, std::int64_t runs, const double* weights,
                               const double* ends, double* out) {
    if (plan.plastic_list < 0) return 0.0;
    const List& list = plan.lists[plan.plastic_list];
    double work = 0.0;
    for (std::int64_t e = 0; e < list.count; ++e) {
        const double last = ends[(runs - 1) * list.count + e];
        double sum = 0.0;
        bool same = true;
        for (std::int64_t run = 0; run < runs; ++run) {
            const double end = ends[run * list.count + e];
            same = same && end == last;
            sum = fma(weights[run], end, sum);
        }
        ElementState<BendingFriction> s(list, e, x, nullptr, plan.count);
        s.params.plastic_length = same ? last : sum;
        out[e] = BendingFriction::returned(s.params, laws::Crossed::length(s.d).h);
        work += BendingFriction::plastic_work(s.params, out[e]);
    }
    return work;
}

void hinge_lengths(const List& list, const double* x, std::int64_t n, double* lengths, double* squares) {
    const auto evaluate = [&](auto law) {
        using Law = decltype(law);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, nullptr, n);
            double square, limit;
            Vec3<double> area[3];
            Law::areas(s.d, square, limit, area);
            const auto l = Law::length(s.d);
            lengths[e] = square > limit ? l.h : __builtin_nan("");
            if (!squares) continue;
            squares[4 * e] = norm2(-(l.gradient[0] + l.gradient[1] + l.gradient[2]));
            for (int i = 0; i < 3; ++i) squares[4 * e + 1 + i] = norm2(l.gradient[i]);
        }
    };
    switch (list.kind) {
        case Kind::crossed: return evaluate(Crossed{});
        case Kind::edge_edge: return evaluate(EdgeEdge{});
        case Kind::point_face: return evaluate(PointFace{});
        default: return evaluate(Altitude{});
    }
}

}  // namespace cloth::plan
