// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// C ABI of contact with points and edges of obstacles.
#pragma once

#include "api/guard.hpp"
#include "api/self_contact.hpp"
#include "contact/obstacle_queries.hpp"
#include "contact/surface_ccd.hpp"
#include "contact/surface_queries.hpp"

namespace cloth::api {

/// Squared frequency and damping rate of contact on the surface (self-contact, points and edges of obstacles), and the
/// number of pairs evaluated.
static void predict_surface_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                    const double* v, double* out) {
    std::fill(out, out + 3, 0.0);
    const auto add = [&](const contact::ContactBounds& r, auto&& pairs) {
        out[0] += r.omega2;
        out[1] += r.damping;
        if (r.omega2 < std::numeric_limits<double>::infinity()) out[2] += static_cast<double>(pairs());
    };
    if (plan.self)
        add(contact::predict_self_contact(plan, t, duration, expected, x, v),
            [&] { return plan.self->neighbors().size(); });
    if (!plan.features) return;
    add(contact::predict_feature_contact(plan, t, duration, expected, x, v), [&] {
        // The lists of an absent obstacle are of an earlier call.
        std::size_t pairs = 0;
        for (std::int64_t k = 0; k < plan.contacts.count(); ++k) {
            if (plan.features->has(plan.contacts, k)) pairs += plan.features->neighbors()[k].size();
        }
        return pairs;
    });
}

CLOTH_API int cloth_plan_faces(Plan* plan, std::int64_t count, const std::int64_t* triangles, double shortest) {
    return guarded(plan, [&] {
        contact::FeatureContactModel contact;
        double total = 0.0, n_free = 0.0;
        for (std::int64_t i = 0; i < plan->count; ++i) {
            if (!(plan->inverse[i] > 0.0)) continue;
            total += plan->masses[i];
            n_free += 1.0;
        }
        if (!(n_free > 0.0)) return;
        contact.mass = total / n_free;
        contact.surface = surface_of(*plan, count, triangles, shortest, true);
        if (contact.surface.triangles.empty()) return;
        plan->features = std::make_unique<contact::FeatureContactModel>(std::move(contact));
    });
}
CLOTH_API int cloth_plan_features(Plan* plan, std::int64_t obstacle, std::int64_t points, const double* positions,
                                  std::int64_t edges, const std::int64_t* ends, double radius) {
    return guarded(plan, [&] {
        if (!plan->features) return;
        contact::Features features;
        features.radius = radius;
        for (std::int64_t k = 0; k < points; ++k) {
            features.points.push_back({positions[3 * k], positions[3 * k + 1], positions[3 * k + 2]});
            features.reach = larger(root(norm2(features.points.back())), features.reach);
        }
        for (std::int64_t k = 0; k < edges; ++k)
            features.edges.push_back(
                {static_cast<contact::Index>(ends[2 * k]), static_cast<contact::Index>(ends[2 * k + 1])});
        plan->features->obstacles[obstacle] = std::move(features);
    });
}
CLOTH_API int cloth_features_culled(Plan* plan, double t, double duration, const double* x, const double* v,
                                    std::int64_t* out) {
    return guarded(plan, [&] {
        const contact::FeatureCulling culling(*plan, t, duration, x, v);
        *out = plan->is_feature_active() ? 0 : 1;
    });
}
CLOTH_API int cloth_predict_contact(Plan* plan, double t, double duration, double energy_factor, double expected,
                                    const double* x, const double* v, double* out) {
    return guarded(plan, [&] {
        contact::VisitCounts visits;
        out[0] = contact::predict_contact_energy(*plan, t, duration, x, v, &visits);
        out[1] = static_cast<double>(visits.all);
        out[2] = static_cast<double>(visits.with_friction);
        const contact::ContactBounds limits = contact::contact_limits(plan->contacts, energy_factor * out[0]);
        out[3] = limits.omega2;
        out[4] = limits.damping;
        predict_surface_contact(*plan, t, duration, expected, x, v, out + 5);
    });
}
CLOTH_API int cloth_predict_surface_contact(Plan* plan, double t, double duration, double expected, const double* x,
                                            const double* v, double* out) {
    return guarded(plan, [&] { predict_surface_contact(*plan, t, duration, expected, x, v, out); });
}
CLOTH_API int cloth_ccd_features(Plan* plan, double t, double duration, const double* x0, const double* x1,
                                 std::int64_t* out) {
    return guarded(plan, [&] { *out = plan->features && contact::ccd_features(*plan, t, duration, x0, x1) ? 1 : 0; });
}
CLOTH_API int cloth_ccd_jaws(Plan* plan, double t, const double* x, const double* half_openings, std::int64_t* out) {
    return guarded(plan, [&] {
        std::fill(out, out + plan->contacts.parallel_jaws.size(), std::int64_t{0});
        if (plan->features) contact::ccd_jaws(*plan, t, x, half_openings, out);
    });
}
CLOTH_API int cloth_feature_intersection(Plan* plan, double t, const double* x, std::int64_t* out) {
    return guarded(plan, [&] {
        std::fill(out, out + 3, std::int64_t{-1});
        if (plan->features) contact::find_feature_intersection(*plan, t, x, out);
    });
}

}  // namespace cloth::api
