// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Which obstacles a frame's runs may meet.
#pragma once

#include "contact_extent.hpp"

namespace cloth {

/// Leaves obstacles that no particle can reach out of a frame's runs. Such an obstacle is more than four times as far
/// off as the fastest particle, with `slack` added to its speed, moves during the frame. If a particle ends a run at
/// more than twice that speed, or a skipped block was missed (see Touched), all runs of the frame are made again with
/// all obstacles.
class Approach {
public:
    Approach(Plan& plan, double duration, const double* x0, const double* v0) : plan_(plan) {
        Contacts& contacts = plan.contacts;
        contacts.active.clear();
        contacts.sleeps = true;
        if (!contacts.count()) return;
        const Extent cloth(x0, plan.count);
        const Vec3<double> middle = cloth.middle;
        const double radius = cloth.radius;
        speed_ = fastest_of(v0, plan.count) + slack;
        for (std::int64_t k = 0; k < contacts.count(); ++k) {
            if (!contacts.present(k)) continue;
            const double* const path = contacts.path(k);
            double way = 0.0, turn = 0.0, power = 1.0;
            for (int order = 0; order < 3; ++order) {
                power *= duration;
                const double *const a = path + 4 + 3 * order, *const r = path + 17 + 3 * order;
                way += power * root(norm2(Vec3<double>{a[0], a[1], a[2]}));
                turn += power * root(norm2(Vec3<double>{r[0], r[1], r[2]}));
            }
            const Obstacle& obstacle = contacts.obstacles[k];
            double away;
            if (obstacle.shape == Shape::plane) {
                const Pose pose = pose_at(path, path[0]);
                away = turn > 0.0 ? 0.0 : dot(pose.rotation[2], middle - pose.place) - radius;
            } else {
                away = root(norm2(middle - Vec3<double>{path[1], path[2], path[3]})) - radius - obstacle.radius;
            }
            if (!(away - way - contacts.thickness > 4.0 * speed_ * duration)) contacts.active.push_back(k);
        }
        std::int64_t present = 0;
        for (std::int64_t k = 0; k < contacts.count(); ++k) present += contacts.present(k);
        whole_ = static_cast<std::int64_t>(contacts.active.size()) == present;
    }
    /// Whether a run that ended with velocities v, and met what it says, has to be made again.
    bool missed(const double* v, const double* touched) const {
        if (!plan_.contacts.sleeps && whole_) return false;
        return touched[2] != 0.0 || (!whole_ && !(fastest_of(v, plan_.count) <= 2.0 * speed_));
    }
    void wake() {
        plan_.contacts.wake();
        plan_.contacts.sleeps = false;
        whole_ = true;
    }

private:
    /// Added to the fastest particle's speed at the frame's start [m/s]: a cloth at rest may be set in motion.
    static constexpr double slack = 0.5;

    Plan& plan_;
    double speed_ = 0.0;
    bool whole_ = true;
};

}  // namespace cloth
