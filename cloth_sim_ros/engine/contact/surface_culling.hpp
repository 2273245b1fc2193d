// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Culling of self-contact and of obstacles' features in a frame, by searches for near pairs. Arrays are (3, n) by
// component.
#pragma once

#include "contact/surface_contacts.hpp"

namespace cloth::contact {

/// Whether n numbers are finite.
inline bool is_finite(const double* a, std::int64_t n) {
    using V = vec<double>;
    V differences{};
    double sum = 0.0;
    std::int64_t i = 0;
    for (; i + lanes<double> <= n; i += lanes<double>) differences += load(a + i) - load(a + i);
    for (; i < n; ++i) sum += a[i] - a[i];
    for (int lane = 0; lane < lanes<double>; ++lane) sum += differences[lane];
    return sum == 0.0;
}

SelfCulling::SelfCulling(Plan& plan, double duration, const double* x0, const double* v0)
    : plan_(plan), x0_(x0), duration_(duration) {
    plan.self_culled = false;
    if (!plan.self) return;
    SelfContact& self = *plan.self;
    plan.self_culled = is_separated_ =
        !is_surely_in_contact(plan, x0) && self.stays_separated(x0, v0, plan.contacts.thickness, duration);
    if (is_separated_) return;
    const Array<double> positions = quads_of(plan, x0);
    speed_limit_ = 2.0 * max_relative_speed(plan, v0) + SelfContact::speed_margin;
    const double margin = speed_limit_ * duration;
    plan.self_culled = plan.contacts.thickness + margin < SelfVerletList::min_reach * self.surface.shortest &&
                       self.neighbors().has_no_pairs(positions.data(), plan.contacts.thickness, margin);
}

bool SelfCulling::is_violated(const double* x, const double* v, MotionRecord& motion) const {
    if (!plan_.self_culled) return false;
    if (!is_separated_) return !(larger(motion.max_relative_speed(), max_relative_speed(plan_, v)) <= speed_limit_);
    SelfContact& self = *plan_.self;
    const double thickness = plan_.contacts.thickness;
    if (motion.keeps_paths())
        return !self.stayed_separated(x0_, motion.middle(), x, motion.half_deviations(plan_.rank), thickness);
    // Bounds leave out what is not a number.
    if (!is_finite(x, 3 * plan_.count) || !is_finite(v, 3 * plan_.count)) return true;
    if (motion.max_relative_deviation() <= SelfContact::max_deviation(duration_)) return false;
    // Relative velocities differ by up to twice their largest change.
    return !self.stayed_separated(x0_, x, 0.5 * duration_ * motion.max_relative_change(), thickness);
}

bool SelfCulling::records_paths() const {
    // Velocities of prescribed particles at the steps do not bound how they move between them.
    return is_separated_ && (plan_.self->records_paths() || plan_.grips.has_prescribed);
}

bool SelfCulling::needs_other_record() const {
    return plan_.self_culled && is_separated_ && !plan_.grips.has_prescribed;
}

void SelfCulling::set_record(bool has_paths) const { plan_.self->record_paths(has_paths); }

FeatureCulling::FeatureCulling(Plan& plan, double t, double duration, const double* x0, const double* v0)
    : plan_(plan) {
    if (!plan.features) return;
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Surface& s = contact.surface;
    std::fill(contact.is_active.begin(), contact.is_active.end(), 0);
    if (s.triangles.empty() || !contact.has_any(contacts)) return;
    const double thickness = contact.law(contacts).thickness(false);
    speed_limit_ = 2.0 * max_particle_speed(v0) + speed_margin;
    Array<double> positions;
    // Ball about the cloth.
    Vec3<double> center{};
    double radius = 0.0;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        FeatureVerletList& neighbors = contact.neighbors()[k];
        const Features& features = contact.obstacles[k];
        if (!contact.has(contacts, k)) continue;
        const double* const path = contacts.path(k);
        auto [path_length, path_angle] = max_path_motion(path, t - path[0], t - path[0] + duration);
        const Pose pose = contacts.obstacle_pose(k, t);
        // Jaws rotate about their gripper. The cloth may push them back faster than they are driven.
        const double lever = root(norm2(pose.position - pose_at(path, t).position));
        if (contacts.jaw_of(k)) path_length += 2.0 * contacts.max_jaw_speed(k) * duration;
        const double margin = speed_limit_ * duration + path_length + path_angle * (lever + features.reach);
        if (positions.empty()) {
            positions = quads_of(plan, x0);
            const AxisBox box = box_of_edges(s, {positions.data()});
            center = box.center();
            radius = 0.5 * root(norm2(box.high - box.low));
        }
        // Distance between the bounding balls of cloth and obstacle.
        const double distance = root(norm2(center - pose.position)) - radius - features.reach - features.radius;
        if (distance > thickness + margin) continue;
        const bool is_valid = neighbors.find(s, positions.data(), {features, pose}, thickness, margin);
        contact.is_active[k] = !is_valid || !neighbors.empty();
    }
    for (std::int64_t k = 0; k < contacts.count(); ++k)
        covers_all_ = covers_all_ && (contact.is_active[k] || !contact.has(contacts, k));
}

double FeatureCulling::max_particle_speed(const double* v) const {
    const std::int64_t n = plan_.count;
    double square = 0.0;
    for (std::int64_t i = 0; i < n; ++i) {
        const double square_i = norm2(Vec3<double>{v[i], v[n + i], v[2 * n + i]});
        square = square_i <= square ? square : square_i;  // a speed that is NaN is kept
        if (!(square_i < std::numeric_limits<double>::infinity())) return square_i;
    }
    return root(square);
}

void activate_features(Plan& plan) {
    if (plan.features) plan.features->activate_all(plan.contacts);
}
void deactivate_features(Plan& plan) {
    if (plan.features) std::fill(plan.features->is_active.begin(), plan.features->is_active.end(), 0);
}

}  // namespace cloth::contact
