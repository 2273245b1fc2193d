// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Execution of a frame in one call: several runs over the same interval, their combination, and the summary for step
// control.
#pragma once

#include <limits>
#include <span>
#include <utility>

#include "contact/culling.hpp"
#include "contact/queries.hpp"
#include "core/thread_pool.hpp"
#include "plan/frame_request.hpp"
#include "plan/queries.hpp"
#include "plan/runs.hpp"

namespace cloth::plan {

template <class T>
inline RunStatus execute_run(Plan& plan, const Run& run) {
    return plan.grid ? run_grid<T>(plan, run) : run_lists<T>(plan, run);
}
/// Whether runs that request single precision use it. It resolves no plastic length.
inline bool allows_single_precision(const Plan& plan) { return !plan.is_surface_active() && plan.plastic_list < 0; }
inline RunStatus execute_run(Plan& plan, const Run& run) {
    return run.single_precision && allows_single_precision(plan) ? execute_run<float>(plan, run)
                                                                 : execute_run<double>(plan, run);
}

inline void combine(std::int64_t arrays, const double* const* from, const double* weights, std::int64_t size,
                    double* out) {
    for (std::int64_t i = 0; i < size; ++i) {
        double sum = weights[0] * from[0][i];
        for (std::int64_t k = 1; k < arrays; ++k) sum = fma(weights[k], from[k][i], sum);
        out[i] = sum;
    }
}

/// Largest distance of n particles at positions x from y, (3, n); infinite if one is not finite.
inline double largest_distance(const double* x, const double* y, std::int64_t n) {
    using V = vec<double>;
    const auto square_of = [&](std::int64_t i, auto&& read) CLOTH_INLINED {
        const auto a = read(x + i) - read(y + i), b = read(x + n + i) - read(y + n + i),
                   c = read(x + 2 * n + i) - read(y + 2 * n + i);
        return fma(c, c, fma(b, b, a * a));
    };
    constexpr double infinity = std::numeric_limits<double>::infinity();
    V squares{}, n_not_finite{};
    std::int64_t i = 0;
    for (; i + lanes<double> <= n; i += lanes<double>) {
        const V square = square_of(i, [](const double* from) CLOTH_INLINED { return load(from); });
        squares = larger(square, squares);
        n_not_finite += select(square < splat<V>(infinity), V{}, splat<V>(1.0));
    }
    double max_square = 0.0;
    bool not_finite = false;
    for (int lane = 0; lane < lanes<double>; ++lane) {
        max_square = larger<double>(squares[lane], max_square);
        not_finite |= n_not_finite[lane] != 0.0;
    }
    for (; i < n; ++i) {
        const double square = square_of(i, [](const double* from) { return *from; });
        max_square = square > max_square ? square : max_square;
        not_finite |= !(square < infinity);
    }
    return not_finite ? infinity : root(max_square);
}

/// A quarter of the largest difference of a particle's velocity change from v0 to v and `ratio` times that from v1 to v0.
/// In a smooth motion it equals the difference of both halves of the interval.
inline double change_from_before(const Plan& plan, const double* v, const double* v0, const double* v1, double ratio) {
    const std::int64_t n = plan.count;
    double max_square = 0.0;
    for (std::int64_t i = 0; i < n; ++i) {
        if (plan.grips.has_prescribed && !(plan.free_inverse[i] > 0.0)) continue;
        double square = 0.0;
        for (std::int64_t k = i; k < 3 * n; k += n) {
            const double difference = fma(-ratio, v0[k] - v1[k], v[k] - v0[k]);
            square = fma(difference, difference, square);
        }
        max_square = square > max_square ? square : max_square;
    }
    return 0.25 * root(max_square);
}

/// Size of a run's record of contact, see FrameRequest::records.
inline std::int64_t contact_record_size(const Plan& plan) {
    return plan.has_contact() ? plan.contacts.count() * record_numbers + contact::ContactSummary::numbers + 4 : 0;
}

/// Runs of a frame.
inline std::vector<Run> runs_of(const Plan& plan, const FrameRequest& frame) {
    const std::int64_t n = plan.count, size = plan.grips.grippers * record_numbers;
    const std::int64_t contact_size = contact_record_size(plan), size_of_record = size + 2 + contact_size;
    const auto n_jaws = static_cast<std::int64_t>(plan.contacts.parallel_jaws.size());
    std::vector<Run> runs;
    for (std::int64_t k = 0; k < frame.runs; ++k) {
        double* const record = frame.records ? frame.records + k * size_of_record : nullptr;
        double* const out = frame.out + k * 6 * n;
        runs.push_back({
            .t = frame.t,
            .step = frame.duration / static_cast<double>(frame.steps[k]),
            .steps = frame.steps[k],
            .single_precision = frame.single_precision != 0,
            .bands = static_cast<int>(frame.bands),
            .x0 = frame.x0,
            .v0 = frame.v0,
            .x = out,
            .v = out + 3 * n,
            .gripper_record = record,
            .power_integrals = frame.record_powers ? record + size : nullptr,
            .contact_record = contact_size ? record + size + 2 : nullptr,
            .record_obstacles = contact_size && frame.record_obstacles,
            .anchors = frame.anchors ? frame.anchors + k * plan.anchor_count() : nullptr,
            .jaw_states = frame.jaw_states ? frame.jaw_states + k * n_jaws * contact::jaw_state_size : nullptr,
            .multirate = frame.multirate,
            .activity = frame.activities ? frame.activities + 2 * k : nullptr,
            .previous_v0 = frame.previous_v0,
            .previous_ratio = frame.previous_ratio,
            .plastic_lengths = frame.plastic_lengths ? frame.plastic_lengths + k * plan.plastic_count() : nullptr,
        });
    }
    return runs;
}

/// Execute some runs concurrently, each on one thread. They share read-only data and write into workspaces of their own.
inline void execute_concurrently(Plan& plan, const FrameRequest& frame, std::span<const Run> runs) {
    if (frame.single_precision && allows_single_precision(plan))
        plan.prepare_tables<float>();
    else
        plan.prepare_tables<double>();
    const int threads = static_cast<int>(std::min<std::int64_t>(frame.concurrency, max_concurrency));
    ThreadPool::shared().for_each_job(static_cast<int>(runs.size()), threads, [&](int index, int workspace) {
        Run run = runs[index];
        run.bands = 1;
        run.workspace = workspace;
        execute_run(plan, run);
    });
}

/// Contact that the runs of a frame leave out: the three classes together.
class FrameCulling {
public:
    FrameCulling(Plan& plan, const FrameRequest& frame)
        : plan_(plan), obstacles_(plan, frame.t, frame.duration, frame.x0, frame.v0),
          self_(plan, frame.duration, frame.x0, frame.v0),
          features_(plan, frame.t, frame.duration, frame.x0, frame.v0) {}
    /// Whether runs leave anything out.
    bool is_active() const { return obstacles_.is_active() || self_.is_active() || features_.is_active(); }
    /// What a run must record for the assumptions; `with_paths`: rather the path of each particle than bounds of all.
    MotionNeeds needs(bool with_paths) const {
        const bool is_separated = self_.is_active() && self_.is_separated();
        return {
            .velocities = obstacles_.is_active() || features_.is_active() || (self_.is_active() && !is_separated),
            .changes = is_separated && !with_paths,
            .paths = is_separated && with_paths,
        };
    }
    /// Whether runs record the path of each particle; call it once a frame.
    bool records_paths() const { return self_.records_paths(); }
    /// Whether a run, which records its motion, violates the assumptions.
    bool is_violated(const Run& run) const {
        if (!run.motion) return false;
        return violates_obstacles(run) || self_.is_violated(run.x, run.v, *run.motion) ||
               features_.is_violated(run.v, *run.motion);
    }
    /// Whether another record may show that a run does not violate them.
    bool needs_other_record(const Run& run) const {
        const bool violates_others = violates_obstacles(run) || features_.is_violated(run.v, *run.motion);
        return !violates_others && self_.needs_other_record();
    }
    /// Let the next frames record the path of each particle, or bounds of all.
    void set_record(bool has_paths) const { self_.set_record(has_paths); }
    /// Leave out no contact that the run concerns.
    void disable_for(const Run& run) {
        if (violates_obstacles(run)) obstacles_.disable();
        self_.disable();
        features_.disable();
    }

private:
    bool violates_obstacles(const Run& run) const {
        return run.contact_record && obstacles_.is_violated(run.v, run.contact_summary(plan_), *run.motion);
    }
    const Plan& plan_;
    contact::ObstacleCulling obstacles_;
    contact::SelfCulling self_;
    contact::FeatureCulling features_;
};

/// Execute the runs of a frame. If a requested one violates the culling, all requested ones are repeated, so that their
/// bits do not depend on their order. No bit of them depends on the others.
inline RunStatus execute_runs(Plan& plan, const FrameRequest& frame) {
    std::vector<Run> runs = runs_of(plan, frame);
    const auto requested = static_cast<std::size_t>(frame.combined);
    FrameCulling culling(plan, frame);
    const bool records_paths = culling.is_active() && culling.records_paths();
    if (plan.motions.size() < runs.size()) plan.motions.resize(runs.size());
    for (std::size_t k = 0; culling.is_active() && k < runs.size(); ++k) {
        runs[k].motion = &plan.motions[k];
        runs[k].motion->record(culling.needs(records_paths));
    }
    const std::int64_t size_of_record = plan.grips.grippers * record_numbers + 2 + contact_record_size(plan);
    // Prescribed particles are at their points at the end, exactly.
    const auto is_violated = [&](const Run& run) {
        plan.grips.prescribe(frame.t + frame.duration, plan.count, run.x, run.v);
        return culling.is_violated(run);
    };
    bool is_repeated = false, drops = false;
    for (std::size_t count = runs.size();; count = requested) {
        const bool is_concurrent = frame.concurrency > 1 && count > 1 && plan.has_independent_runs();
        if (is_concurrent) execute_concurrently(plan, frame, {runs.data(), count});
        std::size_t k = 0;
        for (; k < count; ++k) {
            const RunStatus done = is_concurrent ? RunStatus::ok : execute_run(plan, runs[k]);
            if (done != RunStatus::ok) return done;
            if (!is_violated(runs[k])) continue;
            if (!culling.needs_other_record(runs[k])) break;
            runs[k].motion->record(culling.needs(!records_paths));
            std::fill_n(runs[k].gripper_record, size_of_record, 0.0);
            const RunStatus repeated = execute_run(plan, runs[k]);
            if (repeated != RunStatus::ok) return repeated;
            if (is_violated(runs[k])) break;
            culling.set_record(!records_paths);
        }
        drops = drops || k < count;
        if (k >= requested) break;
        culling.disable_for(runs[k]);
        std::fill_n(frame.records, frame.runs * size_of_record, 0.0);
        is_repeated = true;
    }
    for (std::size_t k = 0; drops && k < runs.size(); ++k)
        runs[k].contact_summary(plan)[contact::ContactSummary::violation] = k >= requested || is_repeated ? 1.0 : 0.0;
    return RunStatus::ok;
}

/// Copy a state (3, n) with prescribed particles at their points at a time, and store the velocities before.
inline void prescribe_start(Plan& plan, double t, const double* x, const double* v) {
    const std::int64_t n = plan.count;
    plan.prescribed_start.resize(6 * n);
    double* const start = plan.prescribed_start.data();
    std::copy_n(x, 3 * n, start);
    std::copy_n(v, 3 * n, start + 3 * n);
    for (std::int64_t grip = 0; grip < plan.grips.count(); ++grip)
        plan.grips.velocity_before[grip] = particle(v, n, plan.grips.particle[grip]);
    plan.grips.prescribe(t, n, start, start + 3 * n);
}

inline RunStatus execute_frame(Plan& plan, const FrameRequest& request) {
    const std::int64_t n = plan.count;
    FrameRequest frame = request;
    if (plan.grips.has_prescribed) {
        prescribe_start(plan, frame.t, frame.x0, frame.v0);
        frame.x0 = plan.prescribed_start.data();
        frame.v0 = frame.x0 + 3 * n;
    }
    const RunStatus done = execute_runs(plan, frame);
    if (done != RunStatus::ok) return done;
    const double* x = frame.out;
    if (frame.result) {
        const double* from[max_runs];
        for (std::int64_t k = 0; k < frame.combined; ++k) from[k] = frame.out + k * 6 * n;
        combine(frame.combined, from, frame.weights, 6 * n, frame.result);
        x = frame.result;
    }
    if (!frame.summary) return RunStatus::ok;
    // The motion of prescribed particles has no error. Its changes do not count; those of their neighbours do.
    for (std::int64_t grip = 0; plan.grips.has_prescribed && grip < plan.grips.count(); ++grip)
        for (int c = 0; plan.grips.prescribed[grip] && c < 3; ++c) {
            const std::int64_t at = c * n + plan.grips.particle[grip];
            plan.prescribed_start[3 * n + at] = x[3 * n + at];
        }
    frame.summary[0] = largest_distance(x + 3 * n, frame.v0, n);
    frame.summary[9] = turn_in_step(plan, frame.x0, x, frame.steps[0], frame.combined);
    frame.summary[10] = 0.0;
    if (frame.previous_v0)
        frame.summary[10] = change_from_before(plan, x + 3 * n, frame.v0, frame.previous_v0, frame.previous_ratio);
    const double max_displacement = largest_distance(x, frame.x0, n);
    if (!(max_displacement < std::numeric_limits<double>::infinity())) frame.summary[0] = max_displacement;
    if (plan.contacts.count()) {
        // Drifts of half a step and combinations of runs may pass a surface that no run touched.
        const std::vector<double> start = plan.contacts.jaw_states;
        const auto size = static_cast<std::int64_t>(start.size());
        if (frame.jaw_states && frame.result) {
            const double* from[max_runs];
            for (std::int64_t k = 0; k < frame.combined; ++k) from[k] = frame.jaw_states + k * size;
            combine(frame.combined, from, frame.weights, size, plan.contacts.jaw_states.data());
        } else if (frame.jaw_states) {
            plan.contacts.jaw_states.assign(frame.jaw_states, frame.jaw_states + size);
        }
        frame.summary[3] = contact::predict_contact_energy(plan, frame.t + frame.duration, 0.0, x, x + 3 * n);
        plan.contacts.jaw_states = start;
        if (!(frame.summary[3] < std::numeric_limits<double>::infinity())) frame.summary[0] = frame.summary[3];
    }
    const double* const finest = frame.out + (frame.combined - 1) * 6 * n;
    const auto include_bounds = [&](contact::ContactBounds r, auto&& intersects) {
        frame.summary[4] += r.omega2;
        frame.summary[5] += r.damping;
        const bool unbounded = !(r.omega2 < std::numeric_limits<double>::infinity());
        if (unbounded || (x != finest && intersects())) frame.summary[0] = std::numeric_limits<double>::infinity();
    };
    frame.summary[4] = frame.summary[5] = 0.0;
    const double end = frame.t + frame.duration;
    if (plan.is_self_active())
        include_bounds(contact::predict_self_contact(plan, end, 0.0, 1.0, x, x + 3 * n),
                       [&] { return contact::ccd_self(plan, finest, x); });
    if (plan.is_feature_active())
        include_bounds(contact::predict_feature_contact(plan, end, 0.0, 1.0, x, x + 3 * n),
                       [&] { return contact::ccd_features(plan, end, 0.0, finest, x); });
    if (frame.bounds_level) {
        const SpectralBounds r = spectral_bounds(plan, x, nullptr, nullptr, frame.bounds_level > 1);
        frame.summary[1] = r.omega2;
        frame.summary[2] = r.damping;
        frame.summary[6] = r.hinge_omega2;
        frame.summary[7] = r.hinge_damping;
        frame.summary[8] = r.transverse_omega2;
    }
    return RunStatus::ok;
}

/// Evaluate forces once; accelerations, zero for anchored particles.
inline RunStatus evaluate(Plan& plan, double t, const double* x, const double* v, double* out) {
    const Run run{.t = t,
                  .step = 1.0,
                  .steps = 0,
                  .single_precision = false,
                  .bands = 1,
                  .x0 = x,
                  .v0 = v,
                  .x = nullptr,
                  .v = out,
                  .gripper_record = nullptr,
                  .power_integrals = nullptr};
    return plan.grid ? evaluate_grid(plan, run) : evaluate_lists(plan, run);
}
inline RunStatus accelerations(Plan& plan, double t, const double* x, const double* v, double* out) {
    plan.contacts.activate_all();
    plan.self_culled = false;
    contact::activate_features(plan);
    return evaluate(plan, t, x, v, out);
}
/// The same, zero for prescribed particles.
inline RunStatus free_accelerations(Plan& plan, double t, const double* x, const double* v, double* out) {
    const RunStatus done = accelerations(plan, t, x, v, out);
    for (std::int64_t grip = 0; plan.grips.has_prescribed && grip < plan.grips.count(); ++grip)
        for (int c = 0; plan.grips.prescribed[grip] && c < 3; ++c)
            out[c * plan.count + plan.grips.particle[grip]] = 0.0;
    return done;
}
/// Add the wrench and the power of grippers with prescribed particles at time t, (grippers, record_numbers).
inline RunStatus add_prescribed_wrenches(Plan& plan, double t, const double* x, const double* v, double* wrenches) {
    const Grips& grips = plan.grips;
    if (!grips.has_prescribed) return RunStatus::ok;
    const std::int64_t n = plan.count;
    Array<double> a(3 * n);
    const RunStatus done = accelerations(plan, t, x, v, a.data());
    for (std::int64_t grip = 0; done == RunStatus::ok && grip < grips.count(); ++grip) {
        if (!grips.prescribed[grip]) continue;
        const auto point = grips.point(pose_at(grips.path_of(grip), Dual{t, 1.0}), grip);
        const auto value = [](Vec3<Dual> p) { return Vec3<double>{p.x.value, p.y.value, p.z.value}; };
        const std::int64_t i = grips.particle[grip];
        const Vec3<double> f = plan.masses[i] * (particle(a.data(), n, i) - slope_of(point.velocity)),
                           torque = cross(value(point.arm), f);
        const double rates[record_numbers] = {
            f.x, f.y, f.z, torque.x, torque.y, torque.z, -dot(f, value(point.velocity)), 0.0};
        for (int k = 0; k < record_numbers; ++k) wrenches[grips.gripper[grip] * record_numbers + k] += rates[k];
    }
    return done;
}
/// Set positions and velocities (3, n) of prescribed particles at time t, and add the records of the impulses that
/// change their velocities, (grippers, record_numbers).
inline void prescribe(Plan& plan, double t, double* x, double* v, double* wrenches) {
    Grips& grips = plan.grips;
    const std::int64_t n = plan.count;
    for (std::int64_t grip = 0; grips.has_prescribed && grip < grips.count(); ++grip)
        grips.velocity_before[grip] = particle(v, n, grips.particle[grip]);
    grips.prescribe(t, n, x, v);
    Array<double> blocks(grips.has_prescribed && plan.has_added_mass() ? 6 * n : 0);
    if (!blocks.empty()) mass_blocks(plan, x, blocks.data());
    grips.for_each_prescribed(t, [&](std::int64_t grip, const Grips::Point& point) {
        double* const sums = wrenches + grips.gripper[grip] * record_numbers;
        grips.accumulate_inertia(sums, grip, point, point, plan.masses[grips.particle[grip]]);
        if (!blocks.empty())
            grips.accumulate_air_jump(sums, grip, point, block_of(blocks.data(), n, grips.particle[grip]));
    });
}
/// The same without contact, friction of bending, grips and forces in Python. The next runs choose again which contacts
/// they evaluate.
inline void elastic_accelerations(Plan& plan, double t, const double* x, const double* v, double* out) {
    plan.contacts.active.clear();
    plan.self_culled = true;
    contact::deactivate_features(plan);
    plan.omits_plastic = true;
    // Restored even if memory is exhausted: neither grips nor forces in Python may vanish.
    struct Guard {
        Plan& plan;
        Callback callback = std::exchange(plan.callback, nullptr);
        Grips grips = std::exchange(plan.grips, Grips{});
        ~Guard() {
            plan.callback = callback;
            plan.grips = std::move(grips);
            plan.omits_plastic = false;
        }
    } guard{plan};
    evaluate(plan, t, x, v, out);
}

}  // namespace cloth::plan
