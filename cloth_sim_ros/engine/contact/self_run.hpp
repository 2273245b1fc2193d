// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Self-contact over a run.
#pragma once

#include <cstring>
#include <limits>
#include <optional>

#include "contact/self_contact.hpp"
#include "plan/plan.hpp"

namespace cloth::contact {

using plan::midpoint_time, plan::Plan, plan::Run, plan::self_scalings;

/// Self-contact over a run, on one thread.
class SelfRun {
public:
    SelfRun(SelfVerletList& neighbors, double thickness, double damping, double step)
        : neighbors_(neighbors), law_(thickness, damping), vector_law_(thickness, damping), thickness_(thickness),
          damping_(damping), step_(step) {}

    /// Use the reduced thickness of a plan over a run.
    void reduce(const Plan& plan, const Run& run) {
        plan_ = &plan;
        run_ = &run;
    }
    /// Enable friction between layers, with initial anchors and the frequency of their springs [1/s].
    void enable_friction(const FrictionCoefficients& coefficients, double frequency, const LayerAnchors& anchors) {
        frequency_ = frequency;
        friction_.emplace(neighbors_.surface, coefficients, frequency, law_, step_, anchors);
    }
    /// Add the forces of a step at positions x and velocities v to f, all quads, and the power of damping and friction
    /// [W] to `dissipation`.
    void add(std::int64_t step, const double* x, const double* v, double* f, double* dissipation) {
        if (!update_neighbors(x)) return;
        if (plan_) {
            self_scalings(*plan_, midpoint_time(*run_, step), scalings_);
            law_.reduce(&scalings_);
        }
        double growth_power = 0.0;
        add_particles(v, f, dissipation, growth_power);
        const Surface& s = neighbors_.surface;
        const Quads at{x}, velocity{v};
        const auto add_force = [&](Index c, Vec3<double> force) {
            f[4 * c] += force.x, f[4 * c + 1] += force.y, f[4 * c + 2] += force.z;
        };
        bound_.add_approaching<true>(s, neighbors_.edges, law_, x, v, 2.0 * step_);
        for (std::size_t k = 0; k < neighbors_.edges.size(); ++k) {
            if (!(neighbors_.edges.square[k] < 0.25 * thickness_ * thickness_)) continue;
            const auto c = pair_corners<true>(s, neighbors_.edges, k);
            law_.edges(s, {c[0], c[1]}, {c[2], c[3]}, at, velocity, contact_);
            if (contact_.gaps.empty()) continue;
            law_.forces(contact_, add_force);
            bound_.include(s, contact_);
            if (dissipation) *dissipation += law_.dissipation(contact_);
            if (dissipation && plan_) growth_power += law_.growth_power(contact_);
        }
        growth_work_ += step_ * growth_power;
        bound_.flush();
        if (friction_) add_friction(step, at, velocity, add_force, dissipation);
    }
    /// Finish the run. Return false if something may have intersected in the last step.
    bool finish(const double* x) { return update_neighbors(x) && !intersected_; }
    double gap() const { return bound_.gap; }
    ContactBounds bounds() const {
        return bound_.bounds(thickness_, damping_, 1.0, friction_ ? friction_->omega2() : 0.0, frequency_);
    }
    /// Friction work since the start of the run [J], if powers are recorded, and anchors after a number of steps.
    double friction_work() const { return friction_work_; }
    /// Work of contacts that recover their thickness, likewise.
    double growth_work() const { return growth_work_; }
    void anchors(std::int64_t steps, const std::int64_t* particle_of_rank, double* to) const {
        if (friction_) friction_->finish(steps, particle_of_rank, to);
    }

private:
    /// Contacts of particles, by the law of SurfaceLaw::particle: sums over each particle's gaps, then forces.
    void add_particles(const double* v, double* f, double* dissipation, double& growth_power) {
        SelfGaps& gaps = neighbors_.gaps;
        if (!gaps.size) return;
        gaps.evaluate(vector_law_, law_, v);
        const double approach_speed = sums_.include(gaps, neighbors_.surface.count, thickness_, 2.0 * step_);
        if (approach_speed > 0.0) bound_.add_contact(false, approach_speed);
        double min_gap = root(gaps.min_square);
        if (law_.reduced()) {
            min_gap = thickness_;
            for (std::size_t k = 0; k < gaps.ends[0]; ++k) min_gap = smaller(gaps.terms(k)[2], min_gap);
        }
        if (min_gap < thickness_) bound_.gap = smaller(min_gap, bound_.gap);
        sums_.finalize(neighbors_.surface, law_, dissipation, growth_power);
        if (sums_.max_energy > 0.0) bound_.include_energy(false, sums_.max_energy);
        sums_.add_forces(gaps, f);
        bound_.gather_row_sums(neighbors_.surface, f);
    }
    /// Friction of the particles in contact.
    template <class F>
    void add_friction(std::int64_t step, const Quads& at, const Quads& velocity, F&& add_force, double* dissipation) {
        double friction_power = 0.0;
        const auto add = [&](Index i, const Index* begin, const Index* end, double) {
            law_.particle(neighbors_.surface, i, begin, end, at, velocity, contact_);
            friction_->add(step, contact_, at, velocity, add_force, dissipation ? &friction_power : nullptr);
        };
        for_each_particle(neighbors_.inner_pairs(), neighbors_.gaps.square, thickness_, add);
        friction_->flush();
        if (!dissipation) return;
        *dissipation += friction_power;
        friction_work_ += step_ * friction_power;
    }
    /// Update the Verlet list, and check the motion since the last step for intersections.
    bool update_neighbors(const double* x) {
        if (intersected_) return false;
        const std::int64_t n = neighbors_.surface.count;
        double motion = 0.0, since = std::numeric_limits<double>::infinity();
        if (previous_.empty()) {
            previous_.assign(x, x + 4 * n);
        } else {
            MotionBound bound;
            bound.include(x, previous_.data(), n);
            since = motion = bound.diameter();
        }
        // A pair within twice `motion` [m] of contact may come into contact in one of the next two steps.
        intersected_ = !neighbors_.update(x, thickness_, 2.0 * motion, since);
        if (!intersected_ && motion > 0.0) check_intersections(x, motion);
        std::memcpy(previous_.data(), x, 4 * n * sizeof(double));
        return !intersected_;
    }
    /// Check whether something may have intersected since the last step; nothing has moved further than `motion` [m]
    /// relative to anything.
    void check_intersections(const double* x, double motion) {
        const Quads current{x}, previous{previous_.data()};
        const auto displacement = [&](Index c) { return current(c) - previous(c); };
        const SelfGaps& gaps = neighbors_.gaps;
        const PairList& edges = neighbors_.edges;
        const double limit = motion * motion;
        // Usually nothing is that near.
        for (std::size_t k = 0; gaps.min_square <= limit && k < neighbors_.inner_pairs().size(); ++k)
            if (gaps.square[k] <= limit)
                intersected_ =
                    intersected_ || may_intersect<false>(gaps.candidate(k), gaps.square[k], 0.0, displacement);
        for (std::size_t k = 0; k < edges.size(); ++k)
            if (edges.square[k] <= limit)
                intersected_ = intersected_ || may_intersect<true>(pair_corners<true>(neighbors_.surface, edges, k),
                                                                   edges.square[k], 0.0, displacement);
    }
    SelfVerletList& neighbors_;
    SurfaceLaw<double> law_;
    ContactLaw<vec<double>> vector_law_;
    double thickness_, damping_, step_;
    Contact<double> contact_;
    StiffnessBound bound_;
    SelfSums sums_;
    std::optional<SelfFrictionRun> friction_;
    double frequency_ = 1.0, friction_work_ = 0.0, growth_work_ = 0.0;
    const Plan* plan_ = nullptr;  ///< of contacts with a reduced thickness
    const Run* run_ = nullptr;
    std::vector<Scaling<double>> scalings_;
    Array<double> previous_;
    bool intersected_ = false;
};

}  // namespace cloth::contact
