// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of the C ABI of contact, and of its queries.

#include "api/features.hpp"
#include "api/guard.hpp"
#include "api/self_contact.hpp"
#include "contact/obstacle_queries.hpp"
#include "contact/surface_culling.hpp"
#include "contact/surface_queries.hpp"

namespace cloth::api {

CLOTH_API int cloth_plan_contact(Plan* plan, std::int64_t count, const std::int64_t* shapes, const double* sizes,
                                 const double* radii, const double* frictions, const double* paths, double thickness,
                                 double damping, double frequency) {
    return guarded(plan, [&] {
        contact::Contacts contacts;
        for (std::int64_t k = 0; k < count; ++k)
            contacts.obstacles.push_back({.shape = static_cast<contact::Shape>(shapes[k]),
                                          .size = {sizes[3 * k], sizes[3 * k + 1], sizes[3 * k + 2]},
                                          .radius = radii[k],
                                          .friction = {.at_rest = frictions[2 * k], .sliding = frictions[2 * k + 1]}});
        contacts.paths.assign(paths, paths + count * plan::path_numbers);
        contacts.thickness = thickness;
        contacts.damping = damping;
        contacts.frequency = frequency;
        plan->contacts = std::move(contacts);
        plan->contacts.anchors.assign(plan->anchor_count(), 0.0);
        if (!plan->features) return;
        plan->features->resize(count);
    });
}
CLOTH_API int cloth_plan_mesh(Plan* plan, std::int64_t obstacle, std::int64_t vertices, const double* positions,
                              std::int64_t triangles, const std::int64_t* corners) {
    return guarded(plan, [&] {
        plan->contacts.obstacles[obstacle].mesh =
            std::make_shared<contact::Mesh>(vertices, positions, triangles, corners);
    });
}
CLOTH_API int cloth_plan_contact_paths(Plan* plan, const double* paths) {
    return guarded(plan,
                   [&] { plan->contacts.paths.assign(paths, paths + plan->contacts.count() * plan::path_numbers); });
}

CLOTH_API int cloth_plan_jaws(Plan* plan, std::int64_t count, const std::int64_t* pads, const double* numbers) {
    return guarded(plan, [&] {
        contact::Contacts& contacts = plan->contacts;
        contacts.parallel_jaws.clear();
        for (std::int64_t k = 0; k < count; ++k) {
            const double* const a = numbers + 8 * k;
            contacts.parallel_jaws.push_back({.present = a[0] != 0.0,
                                              .closed = a[1] != 0.0,
                                              .mass = a[2],
                                              .force = a[3],
                                              .speed = a[4],
                                              .max_half_opening = a[5],
                                              .half_thickness = a[6],
                                              .min_half_opening = a[7]});
            for (int k_jaw = 0; k_jaw < 2; ++k_jaw) {
                contact::Obstacle& pad = contacts.obstacles[pads[2 * k + k_jaw]];
                pad.parallel_jaw = k;
                pad.jaw_side = k_jaw ? -1.0 : 1.0;
            }
        }
        if (contacts.jaw_states.size() == contacts.parallel_jaws.size() * contact::jaw_state_size) return;
        contacts.jaw_states.clear();
        for (const contact::ParallelJaw& jaw : contacts.parallel_jaws)
            contacts.jaw_states.insert(contacts.jaw_states.end(), {jaw.max_half_opening, 0.0});
    });
}
CLOTH_API int cloth_plan_jaw_states(Plan* plan, const double* jaw_states) {
    return guarded(
        plan, [&] { std::copy_n(jaw_states, plan->contacts.jaw_states.size(), plan->contacts.jaw_states.data()); });
}
CLOTH_API int cloth_jaw_accelerations(Plan* plan, double t, const double* x, const double* v, double* out) {
    return guarded(plan, [&] {
        std::vector<double> jaw_forces(plan->contacts.parallel_jaws.size(), 0.0);
        contact::add_feature_jaw_forces(*plan, t, x, v, jaw_forces);
        contact::jaw_accelerations(*plan, t, x, v, jaw_forces, out);
    });
}

CLOTH_API int cloth_contact_wrenches(Plan* plan, double t, const double* x, const double* v, double weight,
                                     double* out) {
    return guarded(plan, [&] {
        contact::add_contact_wrenches(*plan, t, x, v, weight, out);
        contact::add_feature_wrenches(*plan, t, x, v, weight, out);
    });
}
CLOTH_API int cloth_contact_gaps(Plan* plan, double t, const double* x, double* out) {
    return guarded(plan, [&] {
        contact::contact_gaps(*plan, t, x, out);
        contact::feature_gaps(*plan, t, x, out);
    });
}
CLOTH_API int cloth_contact_bounds(Plan* plan, double t, const double* x, double* stiff, double* damp) {
    return guarded(plan, [&] {
        contact::add_contact_bounds(*plan, t, x, stiff, damp);
        contact::add_feature_bounds(*plan, t, x, stiff, damp);
    });
}
CLOTH_API int cloth_predict_obstacle_contact(const Plan* plan, double t, double duration, const double* x,
                                             const double* v, double* out) {
    return guarded(plan, [&] {
        contact::VisitCounts visits;
        out[0] = contact::predict_contact_energy(*plan, t, duration, x, v, &visits);
        out[1] = static_cast<double>(visits.all);
        out[2] = static_cast<double>(visits.with_friction);
    });
}
CLOTH_API int cloth_contact_anchors(Plan* plan, const double* anchors) {
    return guarded(plan, [&] { plan->contacts.anchors.assign(anchors, anchors + plan->contacts.anchors.size()); });
}
CLOTH_API int cloth_combine_anchors(Plan* plan, double t, const double* x, const double* v, std::int64_t runs,
                                    const double* weights, const double* ends, double* out) {
    return guarded(plan, [&] {
        contact::combine_anchors(*plan, t, x, v, runs, weights, ends, out);
        contact::combine_self_anchors(*plan, t, x, v, runs, weights, ends, out);
    });
}
CLOTH_API int cloth_ccd_obstacles(const Plan* plan, double t, double duration, const double* x0, const double* x1,
                                  std::int64_t* out) {
    return guarded(plan, [&] { *out = contact::ccd_obstacles(*plan, t, duration, x0, x1) ? 1 : 0; });
}
CLOTH_API int cloth_contact_thickness(Plan* plan, const double* at_start, const double* rates, double start) {
    return guarded(plan, [&] {
        contact::Contacts& contacts = plan->contacts;
        contacts.reduced = {};
        if (!at_start) return;
        const std::int64_t size = (contacts.count() + 1) * (plan->count + 1);
        contacts.reduced.at_start.assign(at_start, at_start + size);
        contacts.reduced.at_start.resize(size + lanes<double>, contacts.thickness);
        contacts.reduced.rates.assign(rates, rates + size);
        contacts.reduced.rates.resize(size + lanes<double>, 0.0);
        contacts.reduced.full = contacts.thickness;
        contacts.reduced.start = start;
    });
}
CLOTH_API int cloth_contact_gap_rows(Plan* plan, double t, const double* x, double* out) {
    return guarded(plan, [&] {
        const std::int64_t columns = plan->count + 1, rows = plan->contacts.count() + 1;
        std::fill(out, out + rows * columns, std::numeric_limits<double>::infinity());
        contact::contact_gap_rows(*plan, t, x, out);
        contact::surface_gap_rows(*plan, t, x, out);
    });
}
CLOTH_API int cloth_contact_growth_power(Plan* plan, double t, const double* x, const double* v, double* out) {
    return guarded(plan, [&] {
        *out = contact::contact_growth_power(*plan, t, x, v);
        contact::add_surface_growth_power(*plan, t, x, v, *out);
    });
}
CLOTH_API int cloth_friction_change(Plan* plan, double t, double duration, const double* x0, const double* x1,
                                    const double* v1, const double* ends, double* out) {
    return guarded(plan, [&] {
        const contact::AnchoredState start{t, x0, nullptr, plan->contacts.anchors.data()},
            end{t + duration, x1, v1, ends};
        std::fill(out, out + 6 * plan->count, 0.0);
        contact::add_friction_change(*plan, start, end, out);
        contact::add_layer_friction_change(*plan, start, end, out);
    });
}
CLOTH_API int cloth_stretch_difference(Plan* plan, double t, const double* x, const double* y, const double* anchors,
                                       double* out) {
    return guarded(plan, [&] {
        const contact::AnchoredState a{t, x, nullptr, plan->contacts.anchors.data()}, b{t, y, nullptr, anchors};
        std::fill(out, out + 3 * plan->count, 0.0);
        contact::add_stretch_difference(*plan, a, b, out);
        contact::add_layer_stretch_difference(*plan, a, b, out);
    });
}
CLOTH_API int cloth_contact_jerk_change(Plan* plan, double t, double duration, const double* x0, const double* v0,
                                        const double* x1, const double* v1, double* out) {
    return guarded(plan, [&] {
        std::fill(out, out + 3 * plan->count, 0.0);
        const contact::Moment start{t, x0, v0}, end{t + duration, x1, v1};
        contact::add_contact_jerk(*plan, start, -1.0, duration, out);
        contact::add_contact_jerk(*plan, end, 1.0, duration, out);
        contact::add_surface_jerk(*plan, start, -1.0, duration, out);
        contact::add_surface_jerk(*plan, end, 1.0, duration, out);
    });
}
CLOTH_API int cloth_contact_limits(const Plan* plan, double energy, double* out) {
    return guarded(plan, [&] {
        const contact::ContactBounds limits = contact::contact_limits(plan->contacts, energy);
        out[0] = limits.omega2;
        out[1] = limits.damping;
    });
}

}  // namespace cloth::api
