// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contact of the cloth with itself over a run.
#pragma once

#include <cstring>
#include <limits>
#include <optional>

#include "plan.hpp"
#include "self_contact.hpp"

namespace cloth {

/// Whether the two sides of a pair may have passed through each other during a step. `square` is their squared distance
/// at the step's end [m^2], `way(c)` the displacement of a corner [m]. They have not if they moved less, relative to
/// each other, than that distance. No point of a side moves further, relative to the first corner, than the side's
/// corners.
template <class F>
inline bool may_pass(double square, const Index* corner, bool edges, F&& way) {
    const Vec3<double> own = way(corner[0]);
    const auto away = [&](int k) { return root(norm2(way(corner[k]) - own)); };
    const double other = larger(away(2), away(3));
    const double most = edges ? away(1) + other : larger(away(1), other);
    return !(most < root(square));
}

/// The least of some numbers, 1e30 at most.
inline double least_of(const std::vector<double>& all) {
    using V = vec<double>;
    V least = splat<V>(1e30);
    std::size_t k = 0;
    for (; k + lanes<double> <= all.size(); k += lanes<double>) least = smaller(load(all.data() + k), least);
    double one = 1e30;
    for (int lane = 0; lane < lanes<double>; ++lane) one = smaller<double>(least[lane], one);
    for (; k < all.size(); ++k) one = smaller(all[k], one);
    return one;
}

/// The cloth's contact with itself over a run, by one thread.
class SelfRun {
public:
    SelfRun(SelfContact& self, double thickness, double damping, double step)
        : self_(self), law_(thickness, damping), wide_(thickness, damping), thickness_(thickness), damping_(damping), step_(step) {}

    /// Let contacts have the thickness that a plan says, over a run.
    void reduce(const Plan& plan, const Run& run) {
        plan_ = &plan;
        run_ = &run;
    }
    /// Let layers rub, from anchors at the start on; their springs have a frequency [1/s].
    void rub(double frequency, const LayerAnchors& anchors) {
        frequency_ = frequency;
        layers_.emplace(self_.surface, self_.rough, frequency, law_, step_, anchors);
    }
    /// Add the forces of a step at positions x and velocities v to f, all quads, and what damping and friction take [W] to
    /// `lost`.
    void add(std::int64_t step, const double* x, const double* v, double* f, double* lost) {
        if (!look(x)) return;
        if (plan_) {
            self_scalings(*plan_, middle_of(*run_, step), scalings_);
            law_.reduce(&scalings_);
        }
        double grown = 0.0;
        add_particles(v, f, lost, grown);
        const Surface& s = self_.surface;
        const Quads at{x}, moving{v};
        const auto push = [&](Index c, Vec3<double> force) {
            f[4 * c] += force.x, f[4 * c + 1] += force.y, f[4 * c + 2] += force.z;
        };
        for (std::size_t k = 0; k < self_.edges.size(); ++k) {
            law_.edges(s, s.edges[self_.edges.first[k]], s.edges[self_.edges.second[k]], at, moving, meeting_);
            if (meeting_.gaps.empty()) {
                demand_.come(self_.edge_corners(k), true, law_, at, moving, 2.0 * step_);
                continue;
            }
            law_.forces(meeting_, push);
            demand_.take(s, meeting_);
            if (lost) *lost += law_.lost(meeting_);
            if (lost && plan_) grown += law_.grown(meeting_);
        }
        grown_ += step_ * grown;
        demand_.close();
        if (layers_) add_layers(step, at, moving, push, lost);
    }
    /// The end of the run: whether nothing can have passed through anything on the way there.
    bool finish(const double* x) { return look(x) && !passed_; }
    double gap() const { return demand_.gap; }
    SelfRates rates() const {
        return demand_.rates(thickness_, damping_, 1.0, layers_ ? layers_->omega2() : 0.0, frequency_);
    }
    /// What friction took since the run began [J], where powers are asked for, and the anchors after so many steps.
    double rubbed() const { return rubbed_; }
    /// The same of what contacts gave that regained their thickness.
    double grown() const { return grown_; }
    void anchors(std::int64_t steps, const std::int64_t* own, double* to) const {
        if (layers_) layers_->finish(steps, own, to);
    }

private:
    /// What particles meet, by the law of SelfLaw::particle: sums over each particle's gaps, then forces.
    void add_particles(const double* v, double* f, double* lost, double& grown) {
        SelfGaps& gaps = self_.gaps;
        if (!gaps.size) return;
        gaps.evaluate(wide_, law_, v);
        sums_.begin(self_.surface.count, gaps.size);
        double coming = 0.0;
        for (std::size_t k = 0; k < gaps.size; ++k) {
            const double gap = gaps.gap(k), closing = gaps.closing(k);
            if (gap < thickness_) {
                sums_.take(k, gaps);
            } else if (gap - thickness_ < 2.0 * step_ * closing) {
                coming = larger(closing, coming);
            }
        }
        if (coming > 0.0) demand_.enter(false, coming);
        double least = root(least_of(gaps.square));
        if (law_.reduced()) {
            least = thickness_;
            for (std::size_t k = 0; k < gaps.ends[0]; ++k) least = smaller(gaps.gap(k), least);
        }
        if (least < thickness_) demand_.gap = smaller(least, demand_.gap);
        sums_.close(self_.surface, law_, lost, grown);
        if (sums_.most > 0.0) demand_.reach(false, sums_.most);
        sums_.push(self_.surface, gaps, f);
        demand_.gather(self_.surface, f);
    }
    /// Friction of the particles that something is in contact with.
    template <class F>
    void add_layers(std::int64_t step, const Quads& at, const Quads& moving, F&& push, double* lost) {
        const PairList& pairs = self_.followed();
        double rubbed = 0.0;
        for (std::size_t first = 0, last; first < pairs.size(); first = last) {
            const Index i = pairs.first[first];
            bool meets = false;
            for (last = first; last < pairs.size() && pairs.first[last] == i; ++last)
                meets = meets || self_.gaps.square[last] < thickness_ * thickness_;
            if (!meets) continue;
            const Index* const triangles = pairs.second.data();
            law_.particle(self_.surface, i, triangles + first, triangles + last, at, moving, meeting_);
            layers_->add(step, meeting_, at, moving, push, lost ? &rubbed : nullptr);
        }
        layers_->close();
        if (!lost) return;
        *lost += rubbed;
        rubbed_ += step_ * rubbed;
    }
    /// Find what is near, and look at the ways since the last time.
    bool look(const double* x) {
        if (passed_) return false;
        const std::int64_t n = self_.surface.count;
        double moved = 0.0, since = std::numeric_limits<double>::infinity();
        if (before_.empty()) {
            before_.assign(x, x + 4 * n);
        } else {
            Spread spread;
            for (std::int64_t i = 0; i < n; ++i) spread.take(load4(x + 4 * i) - load4(before_.data() + 4 * i));
            since = moved = spread.most();
        }
        // A pair with less than twice `moved` [m] to contact may come into contact in one of the next two steps.
        passed_ = !self_.follow(x, thickness_, 2.0 * moved, since);
        if (!passed_ && moved > 0.0) check(x, moved);
        std::memcpy(before_.data(), x, 4 * n * sizeof(double));
        return !passed_;
    }
    /// Whether anything may have passed through anything on the way from the last step to x; nothing has moved further than
    /// `moved` [m] relative to anything.
    void check(const double* x, double moved) {
        const Quads now{x}, earlier{before_.data()};
        const auto way = [&](Index c) { return now(c) - earlier(c); };
        const SelfGaps& gaps = self_.gaps;
        // Mostly nothing is as near as that.
        if (least_of(gaps.square) <= moved * moved)
            for (std::size_t k = 0; k < gaps.square.size(); ++k)
                if (gaps.square[k] <= moved * moved)
                    passed_ = passed_ || may_pass(gaps.square[k], gaps.corners(k).data(), false, way);
        for (std::size_t k = 0; k < self_.edges.size(); ++k)
            if (self_.edge_squares[k] <= moved * moved)
                passed_ = passed_ || may_pass(self_.edge_squares[k], self_.edge_corners(k).data(), true, way);
    }
    SelfContact& self_;
    SelfLaw<double> law_;
    ContactLaw<vec<double>> wide_;
    double thickness_, damping_, step_;
    Meeting<double> meeting_;
    Demand demand_;
    SelfSums sums_;
    std::optional<LayerRun> layers_;
    double frequency_ = 1.0, rubbed_ = 0.0, grown_ = 0.0;
    const Plan* plan_ = nullptr;  ///< of contacts with a reduced thickness
    const Run* run_ = nullptr;
    std::vector<Scaling<double>> scalings_;
    Array<double> before_;
    bool passed_ = false;
};

}  // namespace cloth
