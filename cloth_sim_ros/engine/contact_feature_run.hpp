// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What points and edges of obstacles do to the cloth's triangles and edges over a run.
#pragma once

#include "contact_pinch_run.hpp"

namespace cloth {

/// What contact with features has taken up and will have to, energy per mass in units of U^2/2; and by how much stiffness
/// over mass exceeds that of a single gap at a particle, at that which most acts on (Gershgorin: a gap's stiffness k g g'
/// is at most k |w_c| at a corner of weight w_c, for the weights add up to one and an obstacle gives way to nothing).
/// Pads give way: there it is at most 2 k |w_c|, and 2 k at the pads.
class FeatureDemand {
public:
    explicit FeatureDemand(double mass) : mass_(mass) {}
    double reached = 0.0, gap = 1e30;

    /// What is taken in next is of an obstacle.
    void meet(const Contacts& contacts, std::int64_t obstacle) {
        const Pinch* const pinch = contacts.pinch_of(obstacle);
        pinch_ = pinch ? contacts.obstacles[obstacle].pinch : -1;
        yields_ = pinch ? 1.0 / pinch->mass : 0.0;
        times_ = pinch ? 2.0 : 1.0;
        if (pads_.size() < contacts.pinches.size()) pads_.resize(contacts.pinches.size(), 0.0);
    }
    template <class V>
    void take(const Surface& s, const FeatureMeeting<V>& m) {
        gap = smaller(m.least(), gap);
        for (const auto& g : m.gaps) {
            double weight[3];
            for (int k = 0; k < g.corners; ++k) weight[k] = number_of(g.weight[k]);
            enter(s, g.corners, g.corner, weight, number_of(g.closing), number_of(m.shape));
            for (int k = 0; k < g.corners; ++k) {
                const Index c = g.corner[k];
                if (load_.empty()) load_.assign(s.count, 0.0);
                if (load_[c] == 0.0) touched_.push_back(c);
                load_[c] += times_ * g.sign * mass_ * weight[k] / s.masses[c];
            }
            if (pinch_ >= 0) pads_[pinch_] += times_ * g.sign * mass_ * yields_;
        }
    }
    /// A gap that closes at a speed and holds an energy already: all of its corners' m_e w^2/2 goes into M U^2/2 b, where
    /// 1/m_e = sum of w_c^2 / m_c, and the inverse of the mass of pads.
    void enter(const Surface& s, int corners, const Index* corner, const double* weight, double closing, double shape) {
        const double speed = larger(closing, 0.0) / ContactLaw<double>::speed;
        double inverse = yields_;
        crowd_ = larger(times_ * mass_ * yields_, crowd_);
        for (int k = 0; k < corners; ++k) {
            inverse += weight[k] * weight[k] / s.masses[corner[k]];
            crowd_ = larger(times_ * mass_ * weight[k] / s.masses[corner[k]], crowd_);
        }
        reached = larger(shape + speed * speed / (mass_ * inverse), reached);
    }
    /// Take in a gap that comes into contact within a duration [s]: the step has to be short enough before that. `away`
    /// [m] is what is left until then.
    void come(const Surface& s, int corners, const Index* corner, const double* weight, double away, double closing,
              double duration) {
        if (away >= 0.0 && away < duration * closing) enter(s, corners, corner, weight, closing, 0.0);
    }
    /// Look at what was added since the last time.
    void close() {
        for (const Index c : touched_) {
            crowd_ = larger(load_[c], crowd_);
            load_[c] = 0.0;
        }
        touched_.clear();
        for (double& load : pads_) {
            crowd_ = larger(load, crowd_);
            load = 0.0;
        }
    }
    SelfRates rates(const FeatureLaw<double>& law, double expected = 1.0) const {
        if (!(reached > 0.0)) return {};
        const double at = stopping_gap(expected * reached) * law.thickness();
        return {crowd_ * law.law().stiffness(at), crowd_ * law.law().damping(at)};
    }

private:
    double mass_, crowd_ = 1.0, yields_ = 0.0, times_ = 1.0;
    std::int64_t pinch_ = -1;  ///< of the obstacle whose gaps are taken in, if it is a pad
    std::vector<double> load_, pads_;
    std::vector<Index> touched_;
};

/// Call `what` with each meeting of an obstacle's features, of those that `find` found. With `demand` pairs that come into
/// contact within `duration` [s] are told to it.
template <class V, class X, class U, class F>
inline void for_each_feature_meeting(const FeatureContact& contact, const NearFeatures& near, const Pose& pose,
                                     const FeatureLaw<V>& law, X&& at, U&& moving, FeatureMeeting<V>& m, F&& what,
                                     FeatureDemand* demand = nullptr, double duration = 0.0) {
    const Surface& s = contact.surface;
    const FeaturesAt from{near.features, pose};
    const double radius = near.features.radius;
    for_each_feature(
        near,
        [&](Index k, std::size_t first, std::size_t last) {
            const Index* const triangles = near.triangles.second.data();
            law.point(s, from, k, triangles + first, triangles + last, at, moving, m);
            if (!m.gaps.empty()) what(m);
            if constexpr (std::is_same_v<V, double>) {
                for (std::size_t pair = first; demand && pair < last; ++pair) {
                    const auto& t = s.triangles[triangles[pair]];
                    const auto n = near_triangle(from.place(k), at(t[0]), at(t[1]), at(t[2]));
                    const double away = root(n.square);
                    const Vec3<double> slip = n.weight[0] * moving(t[0]) + n.weight[1] * moving(t[1]) +
                                              n.weight[2] * moving(t[2]) - from.speed(k);
                    const double gap = away - radius;
                    demand->come(s, 3, t.data(), n.weight, law.scaling().gap(gap) - law.thickness(),
                                 law.scaling().closing(gap, dot(n.away, slip) / away), duration);
                }
            }
        },
        [&](std::size_t pair) {
            const auto& own = s.edges[near.edges.second[pair]];
            law.edges(own, from, near.edges.first[pair], at, moving, m);
            if (!m.gaps.empty()) what(m);
            if constexpr (std::is_same_v<V, double>) {
                if (!demand || !m.gaps.empty()) return;
                const auto& other = near.features.edges[near.edges.first[pair]];
                const auto n = near_segments(at(own[0]), at(own[1]), from.place(other[0]), from.place(other[1]));
                const double away = root(n.square), weight[2] = {1.0 - n.first, n.first};
                const Vec3<double> u = from.speed(other[0]), w = from.speed(other[1]);
                const Vec3<double> slip = weight[0] * moving(own[0]) + weight[1] * moving(own[1]) - u - n.second * (w - u);
                const double gap = away - radius;
                demand->come(s, 2, own.data(), weight, law.scaling().gap(gap) - law.thickness(),
                             law.scaling().closing(gap, -dot(n.away, slip) / away), duration);
            }
        });
}

/// Whether the sides of a pair may have passed through each other during a step that ended at a squared distance [m^2].
/// They have not if they moved less, relative to each other, than their gap; no point of a side moves further, relative
/// to a corner of the other, than the side's own corners.
inline bool feature_may_pass(double square, double radius, const Vec3<double>* own, int corners, Vec3<double> first,
                             Vec3<double> second) {
    double most = 0.0;
    for (int k = 0; k < corners; ++k) most = larger(root(norm2(own[k] - first)), most);
    return !(most + root(norm2(second - first)) < root(square) - radius);
}

/// Features over a run, by one thread.
class FeatureRun {
public:
    FeatureRun(FeatureContact& contact, const Contacts& contacts, const Run& run)
        : contact_(contact), contacts_(contacts), run_(run), law_(contact.law(contacts)), demand_(contact.mass),
          sums_(run.books ? contacts.count() * booked_numbers : 0, 0.0) {
        poses_.resize(contact.obstacles.size());
    }

    /// Where pads are, which move with the run.
    void pinch(PinchRun& pads) { pads_ = &pads; }
    /// Add the forces at a step, positions x and velocities v, to f, all quads.
    void add(std::int64_t step, const double* x, const double* v, double* f) {
        const double t = middle_of(run_, step);
        const Quads at{x}, moving{v};
        watch(x);
        for (std::int64_t k = 0; k < contacts_.count(); ++k) {
            if (!contact_.acts[k]) continue;
            const Pose own = pose_at(contacts_.path(k), t), pose = placed(k, own);
            if (!look(k, x, pose)) return;
            const FeaturesAt from{contact_.obstacles[k].features, pose, pose.place - own.place};
            demand_.meet(contacts_, k);
            law_.reduce(contacts_.reduced.scaling(k, contact_.surface.count, contact_.surface.count + 1, t));
            PinchRun::Felt felt;
            double* const sums = run_.books && step >= 0 ? sums_.data() + k * booked_numbers : nullptr;
            for_each_feature_meeting<double>(
                contact_, contact_.obstacles[k], pose, law_, at, moving, meeting_,
                [&](const FeatureMeeting<double>& m) {
                    demand_.take(contact_.surface, m);
                    law_.forces(
                        m,
                        [&](Index c, Vec3<double> force) {
                            f[4 * c] += force.x, f[4 * c + 1] += force.y, f[4 * c + 2] += force.z;
                        },
                        [&](Index point, Vec3<double> force) {
                            felt.force += contacts_.obstacles[k].side * dot(pose.rotation[1], force);
                            if (sums) book(sums, from, point, force, 1.0);
                        });
                    if (sums) sums[booked_numbers - 1] += law_.lost(m);
                    if (sums) grown_ += run_.step * law_.grown(m);
                },
                &demand_, 2.0 * run_.step);
            if (contacts_.pinch_of(k)) pads_->feel_between(k, step, felt);
        }
        demand_.close();
        places_.assign(x, x + 4 * contact_.surface.count);
    }
    /// The end of the run: whether nothing can have passed through anything on the way there.
    bool finish(const double* x) {
        watch(x);
        for (std::int64_t k = 0; k < contacts_.count() && !passed_; ++k)
            if (contact_.acts[k])
                look(k, x, placed(k, pose_at(contacts_.path(k), run_.t + run_.step * static_cast<double>(run_.steps))));
        if (run_.books)
            for (std::size_t k = 0; k < sums_.size(); ++k) run_.touched[k] += run_.step * sums_[k];
        return !passed_;
    }
    /// Least gap in units of the whole thickness, as particles' gaps count [m].
    double gap() const { return 2.0 * demand_.gap; }
    /// What contacts gave that regained their thickness [J].
    double grown() const { return grown_; }
    SelfRates rates() const { return demand_.rates(law_); }

    /// Add what a force on a point of an obstacle makes of the booked numbers, losses aside.
    static void book(double* sums, const FeaturesAt& from, Index point, Vec3<double> force, double weight) {
        const Vec3<double> arm = from.arm(point), torque = cross(from.lever + arm, force);
        const double now[booked_numbers] = {force.x,  force.y,  force.z, torque.x, torque.y, torque.z,
                                            -dot(force, from.speed(point)), 0.0};
        for (int k = 0; k < booked_numbers; ++k) sums[k] += weight * now[k];
    }

private:
    /// Pose of an obstacle, from that of its path.
    Pose placed(std::int64_t k, const Pose& own) const { return contacts_.pinch_of(k) ? pads_->pose(0, k, own) : own; }
    /// How far the cloth has moved since the last time, and where it is.
    void watch(const double* x) {
        const std::int64_t n = contact_.surface.count;
        began_ = !places_.empty();
        cloth_ = {};
        for (std::int64_t i = 0; began_ && i < n; ++i) cloth_.take(load4(x + 4 * i) - load4(places_.data() + 4 * i));
    }
    /// Find what is near an obstacle, and look at the ways since the last time.
    bool look(std::int64_t k, const double* x, const Pose& pose) {
        if (passed_) return false;
        NearFeatures& near = contact_.obstacles[k];
        double moved = 0.0, since = std::numeric_limits<double>::infinity();
        if (began_) {
            Spread spread = cloth_;
            const Vec3<double> way = pose.place - poses_[k].place;
            spread.take(quad<double>{way.x, way.y, way.z, 0.0});
            since = moved = spread.most() + turned(pose, poses_[k], near.features.reach);
        }
        // A pair with less than twice `moved` [m] to contact may come into contact in one of the next two steps.
        passed_ = !near.follow(contact_.surface, x, pose, law_.thickness(), 2.0 * moved, since);
        if (!passed_ && moved > 0.0) check(near, x, pose, poses_[k], moved);
        poses_[k] = pose;
        return !passed_;
    }
    void check(const NearFeatures& near, const double* x, const Pose& pose, const Pose& before, double moved) {
        const Surface& s = contact_.surface;
        const FeaturesAt now{near.features, pose}, then{near.features, before};
        const Quads at{x}, was{places_.data()};
        const double radius = near.features.radius, least = (radius + moved) * (radius + moved);
        Vec3<double> own[3];
        const auto way = [&](Index c) { return at(c) - was(c); };
        const auto led = [&](Index point) { return now.place(point) - then.place(point); };
        for (std::size_t k = 0; k < near.triangles.size() && !passed_; ++k) {
            const Index point = near.triangles.first[k], triangle = near.triangles.second[k];
            const double square = NearFeatures::point_square(s, now, at, point, triangle);
            if (square > least) continue;
            for (int c = 0; c < 3; ++c) own[c] = way(s.triangles[triangle][c]);
            passed_ = feature_may_pass(square, radius, own, 3, led(point), led(point));
        }
        for (std::size_t k = 0; k < near.edges.size() && !passed_; ++k) {
            const Index edge = near.edges.first[k];
            const double square = NearFeatures::edge_square(s, now, at, edge, near.edges.second[k]);
            if (square > least) continue;
            for (int c = 0; c < 2; ++c) own[c] = way(s.edges[near.edges.second[k]][c]);
            passed_ = feature_may_pass(square, radius, own, 2, led(near.features.edges[edge][0]),
                                       led(near.features.edges[edge][1]));
        }
    }

    FeatureContact& contact_;
    const Contacts& contacts_;
    const Run& run_;
    FeatureLaw<double> law_;
    FeatureMeeting<double> meeting_;
    FeatureDemand demand_;
    std::vector<double> sums_;
    double grown_ = 0.0;
    /// Where all stood the last time.
    Array<double> places_;
    std::vector<Pose> poses_;
    Spread cloth_;
    PinchRun* pads_ = nullptr;
    bool began_ = false, passed_ = false;
};

}  // namespace cloth
