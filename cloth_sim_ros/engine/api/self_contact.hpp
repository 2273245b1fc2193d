// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// C ABI of self-contact.
#pragma once

#include "api/guard.hpp"
#include "contact/surface_ccd.hpp"
#include "contact/surface_queries.hpp"

namespace cloth::api {

/// Surface of a plan: triangles, or those without anchored corners.
static contact::Surface surface_of(const Plan& plan, std::int64_t count, const std::int64_t* triangles, double shortest,
                                   bool without_anchored) {
    contact::Surface s;
    s.count = plan.count;
    s.shortest = shortest;
    for (const std::int64_t i : plan.particle_of_rank) {
        s.masses.push_back(plan.masses[i]);
        s.inverse.push_back(plan.inverse[i]);
        s.is_free.push_back(plan.inverse[i] > 0.0);
    }
    for (const std::int64_t* c = triangles; c != triangles + 3 * count; c += 3) {
        const auto corner = [&](int k) { return static_cast<contact::Index>(plan.rank[c[k]]); };
        if (without_anchored && !(s.is_free[corner(0)] && s.is_free[corner(1)] && s.is_free[corner(2)])) continue;
        s.triangles.push_back({corner(0), corner(1), corner(2)});
    }
    s.build_topology();
    return s;
}
CLOTH_API int cloth_plan_self(Plan* plan, std::int64_t count, const std::int64_t* triangles, double shortest) {
    return guarded(plan, [&] {
        auto self = std::make_unique<contact::SelfContact>();
        self->surface = surface_of(*plan, count, triangles, shortest, false);
        // Particles of a grid are numbered row by row.
        if (const auto& sheet = plan->grid) {
            const auto spacing = [&](grid::Family k) {
                return sheet->families[k].present ? sheet->families[k].rest_length : shortest;
            };
            self->set_sheet(sheet->rows, sheet->columns, spacing(grid::right), spacing(grid::down));
        }
        plan->self = std::move(self);
    });
}
CLOTH_API int cloth_self_joints(Plan* plan, const std::int64_t* lowest) {
    return guarded(plan, [&] {
        contact::Surface& s = plan->self->surface;
        for (std::int64_t i = 0; i < plan->count; ++i) {
            s.joined[plan->rank[i]] = static_cast<contact::Index>(plan->rank[lowest[i]]);
            s.has_joints = s.has_joints || lowest[i] != i;
        }
    });
}
CLOTH_API int cloth_self_friction(Plan* plan, double at_rest, double sliding) {
    return guarded(plan, [&] { plan->self->friction = {at_rest, sliding}; });
}
CLOTH_API int cloth_self_friction_power(Plan* plan, double t, const double* x, const double* v, double* out) {
    return guarded(plan, [&] { *out = contact::self_friction_power(*plan, t, x, v); });
}
CLOTH_API int cloth_self_cache_pairs(Plan* plan, std::int64_t caches) {
    return guarded(plan, [&] { plan->self->set_caches(caches != 0); });
}
CLOTH_API int cloth_self_bounds(Plan* plan, double t, const double* x, double* stiff, double* damp) {
    return guarded(plan, [&] { contact::add_self_bounds(*plan, t, x, stiff, damp); });
}
CLOTH_API int cloth_self_gaps(Plan* plan, const double* x, double* out) {
    return guarded(plan, [&] { contact::self_gaps(*plan, x, out); });
}
CLOTH_API int cloth_self_intersection(Plan* plan, const double* x, std::int64_t* out) {
    return guarded(plan, [&] { contact::find_self_intersection(*plan, x, out); });
}
CLOTH_API int cloth_self_culled(Plan* plan, double duration, const double* x, const double* v, std::int64_t* out) {
    return guarded(plan, [&] {
        const contact::SelfCulling culling(*plan, duration, x, v);
        *out = plan->self_culled ? 1 : 0;
    });
}
CLOTH_API int cloth_ccd_self(Plan* plan, const double* x0, const double* x1, std::int64_t* out) {
    return guarded(plan, [&] { *out = contact::ccd_self(*plan, x0, x1) ? 1 : 0; });
}

}  // namespace cloth::api
