// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of contact between points or edges of an obstacle, with a radius, and triangles or edges of the cloth.
// docs/derivations/obstacle_features.md derives it. V is a number or a dual number.
#pragma once

#include "contact/obstacles.hpp"
#include "contact/primitives.hpp"
#include "contact/surface.hpp"

namespace cloth::contact {

/// Points of one obstacle in its own frame, edges between them, and their radius [m]: the centre of a ball, corners and
/// edges of a box. `reach` [m]: largest distance of a point from the origin of the frame.
struct Features {
    std::vector<Vec3<double>> points;
    std::vector<std::array<Index, 2>> edges;
    double radius = 0.0, reach = 0.0;
};

/// Features at one time. `lever` [m]: vector from the reference point of torques (the gripper of a jaw) to the
/// position.
struct FeaturesAt {
    const Features& features;
    const Pose& pose;
    Vec3<double> lever{};

    Vec3<double> arm(Index k) const {
        const Vec3<double> p = features.points[k];
        return p.x * pose.rotation[0] + p.y * pose.rotation[1] + p.z * pose.rotation[2];
    }
    Vec3<double> position(Index k) const { return pose.position + arm(k); }
    Vec3<double> velocity(Index k) const { return pose.velocity + cross(pose.spin, arm(k)); }
};

template <class V>
CLOTH_INLINE Vec3<V> constant(Vec3<double> a) {
    return {splat<V>(a.x), splat<V>(a.y), splat<V>(a.z)};
}
CLOTH_INLINE double number_of(double a) { return a; }
CLOTH_INLINE double number_of(Dual a) { return a.value; }

/// A gap between the cloth and a feature.
template <class V>
struct FeatureGapTerm {
    double sign;  ///< sign of the energy of this gap in the sum, 1 or -1
    int corners;
    Index corner[3];
    V weight[3];     ///< of the corners, at the nearest point of the cloth
    V share;         ///< weight of the obstacle's second point, at its nearest point
    Vec3<V> normal;  ///< away from the obstacle
    V gap, closing;
};

/// Contact of one point or of one pair of edges: its gaps and its energy.
template <class V>
struct FeatureContact {
    std::vector<FeatureGapTerm<V>> gaps;
    Index point[2];  ///< of the obstacle; equal for a point
    bool edges = false;
    /// Energy per mass in U^2/2, sum of the pushes [m/s^2], and rate of the energy [m^2/s^3].
    V shape{}, push{}, rate{};
    V lever{};  ///< sum of push times gap [m^2/s^2]
    /// Of edges: fade factor of the energy, and its gradient with respect to the four ends, the cloth's first [m/s^2].
    V fade_factor{};
    Vec3<V> slope[4];

    void clear(Index first, Index second) {
        gaps.clear();
        point[0] = first, point[1] = second;
        edges = false;
        shape = push = rate = lever = V{};
    }
    double min_gap() const {
        double min = 1e30;
        for (const auto& g : gaps) min = smaller(number_of(g.gap), min);
        return min;
    }
};

/// sin^2 of the angle below which two edges are parallel: 1.8 degrees, as in Li et al., Incremental Potential Contact.
inline constexpr double feature_parallel = 1e-3;

template <class V>
class FeatureLaw {
public:
    /// Features have half the thickness, so that particles in contact keep the cloth out of their range. `mass` [kg]:
    /// mean mass of a particle of the cloth.
    FeatureLaw(double thickness, double damping, double mass)
        : thickness_(0.5 * thickness), damping_(damping), mass_(mass), law_(0.5 * thickness, damping) {}

    double thickness() const { return thickness_; }
    /// Set a reduced thickness. Gaps and speeds of contacts are then in units of the full thickness, see Scaling.
    void reduce(Scaling<double> scaling) { scaling_ = {splat<V>(scaling.scale), splat<V>(scaling.growth)}; }
    const Scaling<V>& scaling() const { return scaling_; }
    /// Distance from points and edges within which contact acts [m].
    double range() const { return thickness_ / number_of(scaling_.scale); }
    double mass() const { return mass_; }
    const ContactLaw<V>& law() const { return law_; }

    /// Evaluate the energy of a point with the triangles from `begin` to `end`: that of triangles, minus that of edges
    /// between two of them, plus that of inner particles. Therefore a flat surface counts once, independent of its
    /// triangulation.
    template <class X, class U>
    void point(const Surface& s, const FeaturesAt& from, Index k, const Index* begin, const Index* end, X&& at,
               U&& velocity, FeatureContact<V>& m) const {
        m.clear(k, k);
        const Vec3<V> p = constant<V>(from.position(k)), speed = constant<V>(from.velocity(k));
        const double radius = from.features.radius, max_square = (radius + range()) * (radius + range());
        const V unit = splat<V>(1.0), none{};
        const auto add_gap = [&](double sign, int corners, const Index(&corner)[3], const V(&weight)[3], Vec3<V> away,
                                 V square) {
            if (!(number_of(square) < max_square)) return;
            FeatureGapTerm<V> g{sign, corners, {}, {}, none, {}, {}, {}};
            for (int c = 0; c < 3; ++c) g.corner[c] = corner[c], g.weight[c] = weight[c];
            finish(g, -away, square, radius, speed, velocity);
            m.gaps.push_back(g);
        };
        for (const Index* triangle = begin; triangle != end; ++triangle) {
            const auto& t = s.triangles[*triangle];
            const Vec3<V> x[3] = {at(t[0]), at(t[1]), at(t[2])};
            const OnTriangle<V> n = near_triangle(p, x[0], x[1], x[2]);
            if (!(number_of(n.square) < max_square)) continue;
            add_gap(1.0, 3, {t[0], t[1], t[2]}, {n.weight[0], n.weight[1], n.weight[2]}, n.away, n.square);
            for (int edge = 0; edge < 3; ++edge) {
                const int next = (edge + 1) % 3;
                if (*triangle < s.neighbors[*triangle][edge]) {
                    const OnSegment<V> e = near_segment(p, x[edge], x[next]);
                    add_gap(-1.0, 2, {t[edge], t[next], 0}, {unit - e.fraction, e.fraction, none}, e.away, e.square);
                }
                if (s.inner[t[edge]] && s.fan[s.start[t[edge]]] == *triangle) {
                    const Vec3<V> away = p - x[edge];
                    add_gap(1.0, 1, {t[edge], 0, 0}, {unit, none, none}, away, norm2(away));
                }
            }
        }
        for (const FeatureGapTerm<V>& g : m.gaps) {
            const V push = splat<V>(g.sign) * law_.elastic(g.gap);
            m.push = m.push + push;
            m.rate = m.rate + push * g.closing;
            m.shape = m.shape + splat<V>(g.sign) * law_.shape(g.gap);
            m.lever = m.lever + push * g.gap;
        }
    }
    /// Evaluate the energy of an edge of the cloth with an edge of an obstacle. It fades out as they become parallel,
    /// because the nearest points jump there: factor (2 - q) q, q = sin^2 of the angle over `feature_parallel`, at most
    /// 1.
    template <class X, class U>
    void edges(const std::array<Index, 2>& cloth_edge, const FeaturesAt& from, Index edge, X&& at, U&& velocity,
               FeatureContact<V>& m) const {
        const std::array<Index, 2>& obstacle_edge = from.features.edges[edge];
        m.clear(obstacle_edge[0], obstacle_edge[1]);
        const Vec3<V> x[4] = {at(cloth_edge[0]), at(cloth_edge[1]), constant<V>(from.position(obstacle_edge[0])),
                              constant<V>(from.position(obstacle_edge[1]))};
        const OnSegments<V> n = near_segments(x[0], x[1], x[2], x[3]);
        const double radius = from.features.radius;
        if (!(number_of(n.square) < (radius + range()) * (radius + range()))) return;
        m.edges = true;
        const V unit = splat<V>(1.0);
        const Vec3<V> u = constant<V>(from.velocity(obstacle_edge[0])),
                      w = constant<V>(from.velocity(obstacle_edge[1]));
        FeatureGapTerm<V> g{1.0, 2, {cloth_edge[0], cloth_edge[1], 0}, {unit - n.first, n.first, V{}}, n.second, {},
                            {},  {}};
        finish(g, n.away, n.square, radius, u + n.second * (w - u), velocity);
        m.gaps.push_back(g);
        apply_fade(x[1] - x[0], x[3] - x[2], m);
        const V shape = law_.shape(g.gap);
        m.push = m.fade_factor * law_.elastic(g.gap);
        m.shape = m.fade_factor * shape;
        m.rate = m.push * g.closing;
        m.lever = m.push * g.gap;
        const V energy = splat<V>(0.5 * ContactLaw<V>::speed * ContactLaw<V>::speed) * shape;
        for (int k = 0; k < 4; ++k) {
            m.slope[k] = energy * m.slope[k];
            m.rate = m.rate + dot(m.slope[k], k < 2 ? velocity(cloth_edge[k]) : k == 2 ? u : w);
        }
    }
    /// Damping factor of the forces of one contact: Q of `ContactLaw` at the mean closing speed, rate over push.
    /// Therefore the dissipation (Q - 1) rate is never negative.
    V damped(const FeatureContact<V>& m) const {
        const V unit = splat<V>(1.0);
        if (!(number_of(m.push) > 0.0)) return unit;
        const double gamma = 0.5 * ContactLaw<V>::speed / thickness_;
        const V denominator = m.push * (unit + splat<V>(damping_ / gamma) * m.push);
        const V u = splat<V>(0.5 * damping_) * m.rate / denominator;
        return u + root(fma(u, u, unit));
    }
    /// Call `cloth` with each corner of a contact and its force, and `obstacle` with each point of the obstacle and its
    /// force.
    template <class F, class G>
    void forces(const FeatureContact<V>& m, F&& cloth, G&& obstacle) const {
        const V part = splat<V>(1.0) / scaling_.scale, scale = part * (splat<V>(mass_) * damped(m));
        for (const FeatureGapTerm<V>& g : m.gaps) {
            const Vec3<V> push = (scale * (m.edges ? m.push : splat<V>(g.sign) * law_.elastic(g.gap))) * g.normal;
            for (int k = 0; k < g.corners; ++k) {
                Vec3<V> force = g.weight[k] * push;
                if (m.edges) force = force - (part * scale) * m.slope[k];
                cloth(g.corner[k], force);
            }
            if (m.edges) {
                obstacle(m.point[0], -((splat<V>(1.0) - g.share) * push) - (part * scale) * m.slope[2]);
                obstacle(m.point[1], -(g.share * push) - (part * scale) * m.slope[3]);
            } else {
                obstacle(m.point[0], -push);
            }
        }
    }
    double energy(const FeatureContact<V>& m) const {
        return mass_ * 0.5 * ContactLaw<V>::speed * ContactLaw<V>::speed * number_of(m.shape) * unscaled();
    }
    /// Power of the damping [W].
    double dissipation(const FeatureContact<V>& m) const {
        return mass_ * (number_of(damped(m)) - 1.0) * number_of(m.rate) * unscaled();
    }
    /// Power of the recovery of the thickness [W].
    double growth_power(const FeatureContact<V>& m) const {
        const double square = ContactLaw<V>::speed * ContactLaw<V>::speed;
        return mass_ * number_of(scaling_.growth) * unscaled() *
               fma(square, number_of(m.shape), number_of(damped(m)) * number_of(m.lever));
    }

private:
    double unscaled() const {
        const double scale = number_of(scaling_.scale);
        return 1.0 / (scale * scale);
    }
    template <class U>
    void finish(FeatureGapTerm<V>& g, Vec3<V> offset, V square, double radius, Vec3<V> speed, U&& velocity) const {
        const V away = root(square);
        g.gap = away - splat<V>(radius);
        g.normal = (splat<V>(1.0) / away) * offset;
        Vec3<V> slip = -speed;
        for (int k = 0; k < g.corners; ++k) slip = fma(g.weight[k], velocity(g.corner[k]), slip);
        g.closing = scaling_.closing(g.gap, -dot(g.normal, slip));
        g.gap = scaling_.gap(g.gap);
    }
    void apply_fade(Vec3<V> u, Vec3<V> v, FeatureContact<V>& m) const {
        const V unit = splat<V>(1.0), two = splat<V>(2.0);
        const V uu = norm2(u), vv = norm2(v), uv = dot(u, v), over = unit / (uu * vv);
        const V square = norm2(cross(u, v)) * over, q = square * splat<V>(1.0 / feature_parallel);
        for (auto& slope : m.slope) slope = {};
        m.fade_factor = unit;
        if (!(number_of(q) < 1.0)) return;
        m.fade_factor = (two - q) * q;
        // d(sin^2)/du = 2 (v.v u - u.v v) / (u.u v.v) - 2 sin^2 u / u.u.
        const V steep = (two - two * q) * splat<V>(1.0 / feature_parallel);
        const auto along = [&](Vec3<V> a, V bb, Vec3<V> b, V aa) {
            return steep * ((two * over) * (bb * a - uv * b) - (two * square / aa) * a);
        };
        const Vec3<V> first = along(u, vv, v, uu), second = along(v, uu, u, vv);
        m.slope[0] = -first, m.slope[1] = first, m.slope[2] = -second, m.slope[3] = second;
    }

    double thickness_, damping_, mass_;
    ContactLaw<V> law_;
    Scaling<V> scaling_ = full_thickness<V>();
};

}  // namespace cloth::contact
