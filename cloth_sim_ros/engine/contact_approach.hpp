// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Which obstacles a frame's runs may meet.
#pragma once

#include "contact_extent.hpp"

namespace cloth {

/// Leaves obstacles that no particle can reach out of a frame's runs. Such an obstacle is more than four times as far
/// off as the fastest particle, with `slack` added to its speed, moves during the frame. If a particle ends a run at
/// more than twice that speed, or a skipped block was missed (see ContactSummary), all runs of the frame are made again with
/// all obstacles.
class ObstacleCulling {
public:
    ObstacleCulling(Plan& plan, double duration, const double* x0, const double* v0) : plan_(plan) {
        Contacts& contacts = plan.contacts;
        contacts.active.clear();
        contacts.may_skip_blocks = true;
        if (!contacts.count()) return;
        const BoundingBall cloth(x0, plan.count);
        const Vec3<double> center = cloth.center;
        const double radius = cloth.radius;
        speed_limit_ = max_speed(v0, plan.count) + speed_margin;
        for (std::int64_t k = 0; k < contacts.count(); ++k) {
            if (!contacts.present(k)) continue;
            const double* const path = contacts.path(k);
            double path_length = 0.0, path_angle = 0.0, power = 1.0;
            for (int order = 0; order < 3; ++order) {
                power *= duration;
                const double *const a = path + 4 + 3 * order, *const r = path + 17 + 3 * order;
                path_length += power * root(norm2(Vec3<double>{a[0], a[1], a[2]}));
                path_angle += power * root(norm2(Vec3<double>{r[0], r[1], r[2]}));
            }
            const Obstacle& obstacle = contacts.obstacles[k];
            double distance;
            if (obstacle.shape == Shape::plane) {
                const Pose pose = pose_at(path, path[0]);
                distance = path_angle > 0.0 ? 0.0 : dot(pose.rotation[2], center - pose.position) - radius;
            } else {
                distance = root(norm2(center - Vec3<double>{path[1], path[2], path[3]})) - radius - obstacle.radius;
            }
            if (!(distance - path_length - contacts.thickness > 4.0 * speed_limit_ * duration)) contacts.active.push_back(k);
        }
        std::int64_t present = 0;
        for (std::int64_t k = 0; k < contacts.count(); ++k) present += contacts.present(k);
        covers_all_ = static_cast<std::int64_t>(contacts.active.size()) == present;
    }
    /// Whether a run that ended with velocities v, and met what it says, has to be made again.
    bool is_violated(const double* v, const double* summary) const {
        if (!plan_.contacts.may_skip_blocks && covers_all_) return false;
        return summary[2] != 0.0 || (!covers_all_ && !(max_speed(v, plan_.count) <= 2.0 * speed_limit_));
    }
    void disable() {
        plan_.contacts.activate_all();
        plan_.contacts.may_skip_blocks = false;
        covers_all_ = true;
    }

private:
    /// Added to the fastest particle's speed at the frame's start [m/s]: a cloth at rest may be set in motion.
    static constexpr double speed_margin = 0.5;

    Plan& plan_;
    double speed_limit_ = 0.0;
    bool covers_all_ = true;
};

}  // namespace cloth
