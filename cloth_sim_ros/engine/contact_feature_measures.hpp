// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What is asked of obstacles' points and edges beside their forces: energy, powers, bounds, derivative product, what is
// about to happen, and what would pass through what. Arrays are (3, n) by component.
#pragma once

#include "contact_feature_run.hpp"
#include "self_measures.hpp"

namespace cloth {

/// Call `what` with each meeting at time t, positions x and velocities v, and with derivatives dx and dv where V has them,
/// as `what(law, obstacle, from, meeting)`. Nothing meets where particles have no place. With `whole` contacts have the
/// whole thickness.
template <class V, class F>
inline void for_each_feature_meeting(Plan& plan, double t, const double* const (&x)[2], const double* const (&v)[2],
                                     F&& what, bool whole = false) {
    FeatureContact& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    FeatureLaw<V> law(contacts.thickness, contacts.damping, contact.mass);
    Array<double> room[4];
    FeatureMeeting<V> m;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        NearFeatures& near = contact.obstacles[k];
        if (!contact.has(contacts, k)) continue;
        if (room[0].empty())
            for (int a = 0; a < 4; ++a) room[a] = quads_of(plan, a < 2 ? x[a] : v[a - 2]);
        const Pose pose = contacts.pose(k, t);
        if (!near.find(contact.surface, room[0].data(), pose, law.thickness(), 0.0)) continue;
        law.reduce(whole ? whole_thickness<double>() : contacts.reduced.scaling(k, plan.count, plan.count + 1, t));
        const auto of = [&](int a) {
            return [value = Quads{room[a].data()}, slope = Quads{room[a + 1].data()}](Index c) {
                if constexpr (std::is_same_v<V, double>)
                    return value(c);
                else
                    return with_slope(value(c), slope(c));
            };
        };
        const FeaturesAt from{near.features, pose, pose.place - pose_at(contacts.path(k), t).place};
        for_each_feature_meeting<V>(contact, near, pose, law, of(0), of(2), m,
                                    [&](const FeatureMeeting<V>& one) { what(law, k, from, one); });
    }
}

inline double feature_energy(Plan& plan, double t, const double* x) {
    double total = 0.0;
    for_each_feature_meeting<double>(plan, t, {x, nullptr}, {nullptr, nullptr},
                                     [&](const auto& law, auto, const auto&, const auto& m) { total += law.energy(m); });
    return total;
}
/// Wrench on each obstacle about its place, work on the cloth and loss, as rates: added to (obstacles, booked_numbers).
inline void feature_rates(Plan& plan, double t, const double* x, const double* v, double weight, double* rates) {
    for_each_feature_meeting<double>(
        plan, t, {x, nullptr}, {v, nullptr}, [&](const auto& law, std::int64_t k, const FeaturesAt& from, const auto& m) {
            double* const to = rates + k * booked_numbers;
            law.forces(m, [](Index, Vec3<double>) {},
                       [&](Index point, Vec3<double> force) { FeatureRun::book(to, from, point, force, weight); });
            to[booked_numbers - 1] += weight * law.lost(m);
        });
}
/// Power of the growth of contacts with a reduced thickness [W].
inline double feature_grown(Plan& plan, double t, const double* x, const double* v) {
    double grown = 0.0;
    for_each_feature_meeting<double>(plan, t, {x, nullptr}, {v, nullptr},
                                     [&](const auto& law, auto, const auto&, const auto& m) { grown += law.grown(m); });
    return grown;
}
/// Add what moves pads outward [N], by the pinch.
inline void feature_openings(Plan& plan, double t, const double* x, const double* v, std::vector<double>& felt) {
    const Contacts& contacts = plan.contacts;
    for_each_feature_meeting<double>(
        plan, t, {x, nullptr}, {v, nullptr}, [&](const auto& law, std::int64_t k, const FeaturesAt& from, const auto& m) {
            if (!contacts.pinch_of(k)) return;
            law.forces(m, [](Index, Vec3<double>) {}, [&](Index, Vec3<double> force) {
                felt[contacts.obstacles[k].pinch] += contacts.obstacles[k].side * dot(from.pose.rotation[1], force);
            });
        });
}
/// Add blocks that bound stiffness and damping: of a gap k |w_c| n n' at corner c. What counts with the other sign, and
/// what fades, only softens.
inline void add_feature_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp) {
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    for_each_feature_meeting<double>(
        plan, t, {x, nullptr}, {nullptr, nullptr}, [&](const auto& law, auto, const auto&, const auto& m) {
            for (const auto& g : m.gaps) {
                if (g.sign < 0.0) continue;
                const double share = law.mass() * (m.edges ? m.faded : 1.0);
                const double k = share * law.law().stiffness(g.gap), c = share * law.law().damping(g.gap);
                for (int corner = 0; corner < g.corners; ++corner) {
                    const std::int64_t i = own[g.corner[corner]];
                    if (stiff) add_block(stiff, plan.count, i, outer(k * g.weight[corner], g.normal, 0.0));
                    if (damp) add_block(damp, plan.count, i, outer(c * g.weight[corner], g.normal, 0.0));
                }
            }
        });
}
/// Add (df/dx) dx + (df/dv) dv to out, by the law itself on numbers with derivatives.
inline void add_feature_product(Plan& plan, double t, const double* x, const double* v, const double* dx,
                                const double* dv, double* out) {
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    for_each_feature_meeting<Dual>(
        plan, t, {x, dx}, {v, dv}, [&](const auto& law, auto, const auto&, const auto& m) {
            law.forces(m,
                       [&](Index c, Vec3<Dual> force) {
                           out[own[c]] += force.x.slope;
                           out[plan.count + own[c]] += force.y.slope;
                           out[2 * plan.count + own[c]] += force.z.slope;
                       },
                       [](Index, Vec3<Dual>) {});
        });
}
/// Least gap to each obstacle's features, where it is below that of particles, into column 1 of (obstacles, 2).
inline void feature_gaps(Plan& plan, double t, const double* x, double* out) {
    for_each_feature_meeting<double>(plan, t, {x, nullptr}, {nullptr, nullptr},
                                     [&](const auto&, std::int64_t k, const auto&, const auto& m) {
                                         out[2 * k + 1] = smaller(m.least(), out[2 * k + 1]);
                                     },
                                     true);
}
/// The least gap of each obstacle's points and edges within half the thickness, in units of the whole one, into the last
/// column of (obstacles + 1, n + 1).
inline void feature_gap_column(Plan& plan, double t, const double* x, double* out) {
    for_each_feature_meeting<double>(plan, t, {x, nullptr}, {nullptr, nullptr},
                                     [&](const auto&, std::int64_t k, const auto&, const auto& m) {
                                         double& to = out[k * (plan.count + 1) + plan.count];
                                         to = smaller(2.0 * m.least(), to);
                                     },
                                     true);
}

/// Squared frequency and damping rate that contact with features comes to where it takes up what it holds, and what comes
/// into contact within a duration [s] as it moves at time t, times `expected`. Infinite where a ball or an edge with a
/// radius is within the cloth, and where particles have no place.
inline SelfRates feature_ahead(Plan& plan, double t, double duration, double expected, const double* x, const double* v) {
    FeatureContact& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    // Mostly particles keep everything out.
    if (!contact.has_any(contacts)) return {};
    FeatureLaw<double> law = contact.law(contacts);
    const double endless = std::numeric_limits<double>::infinity();
    const Array<double> places = quads_of(plan, x), speeds = quads_of(plan, v);
    const Quads at{places.data()}, moving{speeds.data()};
    FeatureDemand demand(contact.mass);
    FeatureMeeting<double> m;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        NearFeatures& near = contact.obstacles[k];
        if (!contact.has(contacts, k)) continue;
        const Pose pose = contacts.driven(k, t, duration);
        demand.meet(contacts, k);
        law.reduce(contacts.reduced.scaling(k, plan.count, plan.count + 1, t));
        Spread spread;
        for (std::int64_t i = 0; i < plan.count; ++i) spread.take(load4(speeds.data() + 4 * i));
        spread.take(quad<double>{pose.speed.x, pose.speed.y, pose.speed.z, 0.0});
        const double speed = spread.most() + root(norm2(pose.spin)) * near.features.reach;
        // A later call sees farther pairs.
        const double beyond = smaller(speed * duration, 2.0 * contact.surface.shortest);
        if (!near.find(contact.surface, places.data(), pose, law.thickness(), beyond)) return {endless, endless};
        for_each_feature_meeting<double>(contact, near, pose, law, at, moving, m,
                                         [&](const auto& one) { demand.take(contact.surface, one); }, &demand, duration);
    }
    demand.close();
    if (demand.gap <= 0.0) return {endless, endless};
    return demand.rates(law, expected);
}

/// Whether features of an obstacle that moves from a pose to another one pass through the cloth, or it through them, on
/// straight ways of its particles meanwhile, quads: each pair is followed by its gap, which no way is shorter than.
inline bool feature_crosses(FeatureContact& contact, std::int64_t k, double thickness, const Pose& first, const Pose& last,
                            const double* from, const double* to) {
    const Surface& s = contact.surface;
    const Quads start{from}, end{to};
    NearFeatures& near = contact.obstacles[k];
    const Features& features = near.features;
    const FeaturesAt begin{features, first}, finish{features, last};
    Spread spread;
    for (std::int64_t i = 0; i < s.count; ++i) spread.take(load4(to + 4 * i) - load4(from + 4 * i));
    const Vec3<double> way = last.place - first.place;
    spread.take(quad<double>{way.x, way.y, way.z, 0.0});
    const double most = spread.most() + turned(first, last, features.reach);
    if (!near.find(s, from, first, thickness, most)) return true;
    // Positions along the way, and by how much the sides approach at most from its start to its end.
    const auto meets = [&](int corners, const Index* own, Index a, Index b, auto&& square) {
        Vec3<double> ways[3];
        for (int c = 0; c < corners; ++c) ways[c] = end(own[c]) - start(own[c]);
        const Vec3<double> pa = begin.place(a), pb = begin.place(b), wa = finish.place(a) - pa, wb = finish.place(b) - pb;
        double length = 0.0;
        for (int c = 0; c < corners; ++c) length = larger(root(norm2(ways[c] - wa)), length);
        length += root(norm2(wb - wa));
        double part = 0.0;
        for (int tries = 0; part < 1.0; ++tries) {
            Vec3<double> at[3];
            for (int c = 0; c < corners; ++c) at[c] = start(own[c]) + part * ways[c];
            const double gap = root(square(at, pa + part * wa, pb + part * wb)) - features.radius;
            if (!(gap > 1e-3 * thickness) || tries > 1000) return true;
            if (!(length > 0.0)) return false;
            part += gap / length;
        }
        return false;
    };
    for (std::size_t pair = 0; pair < near.triangles.size(); ++pair) {
        const Index point = near.triangles.first[pair];
        const auto square = [](const Vec3<double>* at, Vec3<double> p, Vec3<double>) {
            return near_triangle(p, at[0], at[1], at[2]).square;
        };
        if (meets(3, s.triangles[near.triangles.second[pair]].data(), point, point, square)) return true;
    }
    for (std::size_t pair = 0; pair < near.edges.size(); ++pair) {
        const auto& side = features.edges[near.edges.first[pair]];
        const auto square = [](const Vec3<double>* at, Vec3<double> p, Vec3<double> q) {
            return near_segments(at[0], at[1], p, q).square;
        };
        if (meets(2, s.edges[near.edges.second[pair]].data(), side[0], side[1], square)) return true;
    }
    return false;
}
/// Whether any does on the way from x0 at time t to x1, `duration` [s] later.
inline bool features_cross(Plan& plan, double t, double duration, const double* x0, const double* x1) {
    FeatureContact& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Array<double> from = quads_of(plan, x0), to = quads_of(plan, x1);
    const double thickness = contact.law(contacts).thickness();
    for (std::int64_t k = 0; k < contacts.count(); ++k)
        if (contact.has(contacts, k) && feature_crosses(contact, k, thickness, contacts.pose(k, t),
                                                        contacts.pose(k, t + duration), from.data(), to.data()))
            return true;
    return false;
}
/// Of each pinch, whether a pad does that moves at time t from half a way between the faces [m] to where it is, the cloth
/// being at x.
inline void pads_cross(Plan& plan, double t, const double* x, const double* ways, std::int64_t* out) {
    FeatureContact& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Array<double> at = quads_of(plan, x);
    const double thickness = contact.law(contacts).thickness();
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        const std::int64_t pinch = contacts.obstacles[k].pinch;
        if (pinch < 0 || !contact.has(contacts, k)) continue;
        const Pose before = contacts.shifted(pose_at(contacts.path(k), t), k, ways[pinch], 0.0);
        if (feature_crosses(contact, k, thickness, before, contacts.pose(k, t), at.data(), at.data())) out[pinch] = 1;
    }
}

/// Leaves the features of obstacles that don't get near the cloth out of a frame. If a run ends with a larger speed than was
/// counted with, all runs of the frame are made again with all of them.
class FeatureRest {
public:
    FeatureRest(Plan& plan, double t, double duration, const double* x0, const double* v0) : plan_(plan) {
        if (!plan.features) return;
        FeatureContact& contact = *plan.features;
        const Contacts& contacts = plan.contacts;
        const Surface& s = contact.surface;
        std::fill(contact.acts.begin(), contact.acts.end(), 0);
        if (s.triangles.empty() || !contact.has_any(contacts)) return;
        const double thickness = contact.law(contacts).thickness();
        speed_ = 2.0 * fastest(v0) + slack;
        Array<double> places;
        for (std::int64_t k = 0; k < contacts.count(); ++k) {
            NearFeatures& near = contact.obstacles[k];
            const Features& features = near.features;
            if (!contact.has(contacts, k)) continue;
            const double* const path = contacts.path(k);
            double way = 0.0, turn = 0.0, power = 1.0;
            for (int order = 0; order < 3; ++order) {
                power *= duration;
                const double *const a = path + 4 + 3 * order, *const r = path + 17 + 3 * order;
                way += power * root(norm2(Vec3<double>{a[0], a[1], a[2]}));
                turn += power * root(norm2(Vec3<double>{r[0], r[1], r[2]}));
            }
            const Pose pose = contacts.pose(k, t);
            // Pads turn about their gripper. The cloth may push them back faster than they are driven.
            const double lever = root(norm2(pose.place - pose_at(path, t).place));
            if (contacts.pinch_of(k)) way += 2.0 * contacts.pad_speed(k) * duration;
            const double beyond = speed_ * duration + way + turn * (lever + features.reach);
            if (places.empty()) {
                places = quads_of(plan, x0);
                measure(s, places.data());
            }
            // No point of the obstacle's ball is nearer to the cloth's.
            const double apart = root(norm2(middle_ - pose.place)) - radius_ - features.reach - features.radius;
            if (apart > thickness + beyond) continue;
            const bool found = near.find(s, places.data(), pose, thickness, beyond);
            contact.acts[k] = !found || near.triangles.size() || near.edges.size();
        }
        for (std::int64_t k = 0; k < contacts.count(); ++k)
            whole_ = whole_ && (contact.acts[k] || !contact.has(contacts, k));
    }
    /// Whether a run that ended with velocities v has to be made again.
    bool missed(const double* v) const { return plan_.features && !whole_ && !(fastest(v) <= speed_); }
    void wake() {
        if (!plan_.features) return;
        plan_.features->wake(plan_.contacts);
        whole_ = true;
    }

private:
    /// Speed that particles may gain [m/s].
    static constexpr double slack = 0.25;

    /// A ball about all of the cloth's edges.
    void measure(const Surface& s, const double* x) {
        const Quads at{x};
        Bounds box(at(s.edges[0][0]));
        for (const auto& e : s.edges) {
            box.take(at(e[0]));
            box.take(at(e[1]));
        }
        middle_ = box.middle();
        radius_ = 0.5 * root(norm2(box.high - box.low));
    }
    double fastest(const double* v) const {
        const std::int64_t n = plan_.count;
        double square = 0.0;
        for (std::int64_t i = 0; i < n; ++i) {
            const double now = norm2(Vec3<double>{v[i], v[n + i], v[2 * n + i]});
            square = now <= square ? square : now;  // a speed that is no number stays
            if (!(now < std::numeric_limits<double>::infinity())) return now;
        }
        return root(square);
    }
    Plan& plan_;
    Vec3<double> middle_{};
    double speed_ = 0.0, radius_ = 0.0;
    bool whole_ = true;
};

/// What passes through the cloth at time t, three numbers: the obstacle, and two particles of the edge that is within it or
/// of the triangle that its feature comes through; -1 where nothing does.
inline void features_pierce(Plan& plan, double t, const double* x, std::int64_t* out) {
    const FeatureContact& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    const Surface& s = contact.surface;
    const Array<double> places = quads_of(plan, x);
    const Quads at{places.data()};
    std::vector<std::int64_t> own(plan.count);
    for (std::int64_t i = 0; i < plan.count; ++i) own[plan.rank[i]] = i;
    std::fill(out, out + 3, std::int64_t{-1});
    const double origin[3] = {}, least = 1e-3 * contacts.thickness;
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        const Features& features = contact.obstacles[k].features;
        if (!contact.has(contacts, k)) continue;
        const Pose pose = contacts.pose(k, t);
        const FeaturesAt from{features, pose};
        const auto tell = [&](Index a, Index b) { out[0] = k, out[1] = own[a], out[2] = own[b]; };
        // An edge of the cloth that enters the obstacle, by steps as long as the gap is.
        const Obstacle& obstacle = contacts.obstacles[k];
        const Placed<double> placed(pose, origin, obstacle);
        for (const auto& e : s.edges) {
            const Vec3<double> a = at(e[0]), b = at(e[1]);
            const double length = root(norm2(b - a));
            for (double way = 0.0; way < length;) {
                const double gap = with_shape(obstacle.shape, [&](auto shape) {
                    return stand<shape.value, true, double>(placed, obstacle.size, a + (way / length) * (b - a), {}).gap;
                });
                if (!(gap > 0.0)) return tell(e[0], e[1]);
                way += larger(gap, least);
            }
        }
        // A feature that comes through a triangle.
        for (const auto& c : s.triangles) {
            const Vec3<double> p[3] = {at(c[0]), at(c[1]), at(c[2])};
            Bounds box(p[0]);
            box.take(p[1]);
            box.take(p[2]);
            box = box.grown(features.radius);
            for (std::size_t j = 0; features.radius > 0.0 && j < features.points.size(); ++j) {
                const Vec3<double> q = from.place(static_cast<Index>(j));
                if (box.meets(Bounds(q)) &&
                    !(near_triangle(q, p[0], p[1], p[2]).square > features.radius * features.radius))
                    return tell(c[0], c[1]);
            }
            for (const auto& side : features.edges) {
                const Vec3<double> q = from.place(side[0]), r = from.place(side[1]);
                Bounds other(q);
                other.take(r);
                if (!box.meets(other) || !(volume(p[0], p[1], p[2], q) * volume(p[0], p[1], p[2], r) < 0.0)) continue;
                const double u = volume(q, r, p[0], p[1]), v = volume(q, r, p[1], p[2]), w = volume(q, r, p[2], p[0]);
                if ((u > 0.0 && v > 0.0 && w > 0.0) || (u < 0.0 && v < 0.0 && w < 0.0)) return tell(c[0], c[1]);
            }
        }
    }
}

}  // namespace cloth
