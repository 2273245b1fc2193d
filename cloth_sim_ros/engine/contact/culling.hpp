// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Culling of self-contact and of features of obstacles in a frame.
#pragma once

#include "plan/plan.hpp"

namespace cloth::contact {

using plan::Plan;

struct Surface;

/// Excludes self-contact from a frame in which no part of the cloth comes near another, by one of two tests.
///
/// A regular sheet must stay separated from itself (`SelfContact::stays_separated`) after the start of the frame. At
/// the end of each run it must have been: on straight paths from the start, and backwards at the velocities there.
///
/// Where that is not clear at the start, no pair may be nearer than the thickness and the distance covered at twice the
/// largest relative speed, plus a margin. No run may end with a larger relative speed.
///
/// Otherwise all runs of the frame are repeated with self-contact. Cached pairs make no difference, so no bit depends
/// on them.
class SelfCulling {
public:
    SelfCulling(Plan& plan, double duration, const double* x0, const double* v0);
    /// Whether a run with positions x and velocities v at its end violates the assumptions. `is_next_start`: whether the
    /// next frame starts at this end.
    bool is_violated(const double* x, const double* v, bool is_next_start) const;
    void disable() { plan_.self_culled = false; }

private:
    double relative_speed(const double* v) const;
    Plan& plan_;
    const double* x0_;
    double duration_, speed_limit_ = 0.0;
    bool is_separated_ = false;
};

/// Excludes features of obstacles that stay away from the cloth from a frame. If a run ends with a larger speed than
/// assumed, all runs of the frame are repeated with all features.
class FeatureCulling {
public:
    FeatureCulling(Plan& plan, double t, double duration, const double* x0, const double* v0);
    /// Whether a run with end velocities v violates the assumptions.
    bool is_violated(const double* v) const {
        return plan_.features && !covers_all_ && !(max_particle_speed(v) <= speed_limit_);
    }
    void disable();

private:
    /// Speed that particles may gain [m/s].
    static constexpr double speed_margin = 0.25;

    double max_particle_speed(const double* v) const;
    Plan& plan_;
    double speed_limit_ = 0.0;
    bool covers_all_ = true;
};

/// Let the next runs evaluate contact of all features; of none.
void activate_features(Plan& plan);
void deactivate_features(Plan& plan);

}  // namespace cloth::contact
