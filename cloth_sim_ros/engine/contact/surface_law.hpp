// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Law of contact with the surface: the contact barrier on gaps between a point and the surface, and between two edges.
// The point, or the second edge, is the cloth's or an obstacle's. docs/derivations/self_contact.md and
// docs/derivations/obstacle_features.md derive it. V is a number or a dual number.
#pragma once

#include "contact/primitives.hpp"
#include "contact/surface.hpp"
#include "laws/contact.hpp"

namespace cloth::contact {

using laws::ContactLaw, laws::full_thickness, laws::Scaling;

/// A gap: its vector is the sum of weights times corner positions; the weights add up to zero.
template <class V>
struct GapTerm {
    double sign;      ///< sign of the energy of this gap in the sum, 1 or -1
    Index corner[4];  ///< particles; ~k is point k of an obstacle
    V weight[4];
    Vec3<V> normal;
    V gap, closing;
};

/// Energy per mass, in units of U^2/2, that a gap has to absorb, from its closing speed [m/s] and its contact energy.
/// One of the two masses may be at rest: then all of m w^2/2 is converted into half of m U^2/2 b.
template <class V>
CLOTH_INLINE V energy_to_stop(V closing, V shape) {
    const V speed = larger(closing, V{}) * splat<V>(1.0 / ContactLaw<V>::speed);
    return shape + splat<V>(2.0) * speed * speed;
}

/// Contact with one energy: its gaps, and for edges the fade factor.
template <class V>
struct Contact {
    std::vector<GapTerm<V>> gaps;
    double mass = 0.0;
    /// Energy per mass in units of U^2/2, sum of the pushes, and rate of the energy [m^2/s^3].
    V shape{}, push{}, rate{};
    /// Scaling by a reduced thickness; gaps, speeds and these sums are in units of the full one.
    Scaling<V> scaling = full_thickness<V>();
    V lever{};  ///< sum of push times gap [m^2/s^2]
    /// Of a pair of edges: fade factor of the energy, and its gradient with respect to the corners.
    V fade_factor{};
    Vec3<V> slope[4];
    bool edges = false;
    bool has_feature = false;  ///< whether a side is a point or an edge of an obstacle

    /// Begin with the contact of the second edge, or of the point, which begins with a corner.
    void clear(Index corner) {
        gaps.clear();
        shape = push = rate = lever = V{};
        edges = false;
        has_feature = corner < 0;
    }
    double min_gap() const {
        double min = 1e30;
        for (const auto& g : gaps) min = smaller(value_of(g.gap), min);
        return min;
    }
    /// Largest closing speed of its gaps.
    double max_closing() const {
        double max = 0.0;
        for (const auto& g : gaps) max = larger(value_of(g.closing), max);
        return max;
    }
};

template <class V>
class SurfaceLaw {
public:
    /// The cloth with itself. Edges have half the thickness.
    SurfaceLaw(double thickness, double damping) : SurfaceLaw(thickness, 0.5 * thickness, damping, 0.0) {}
    /// The cloth with points and edges of obstacles. Both have half the thickness, so that particles in contact keep the
    /// cloth out of their range. `mass` [kg]: mean mass of a particle of the cloth.
    SurfaceLaw(double thickness, double damping, double mass)
        : SurfaceLaw(0.5 * thickness, 0.5 * thickness, damping, mass) {}

    double thickness(bool edges) const { return edges ? edge_thickness_ : thickness_; }

    /// Set a reduced thickness by particle, or null; `scalings` has to outlive the law.
    void reduce(const std::vector<Scaling<double>>* scalings) {
        scalings_ = scalings && !scalings->empty() ? scalings->data() : nullptr;
    }
    bool reduced() const { return scalings_; }
    /// Set the obstacle whose points and edges follow: their radius [m] and the scaling of its contacts.
    void set_obstacle(double radius, Scaling<double> scaling) {
        radius_ = radius;
        common_scaling_ = scaling;
    }
    double radius() const { return radius_; }
    Scaling<double> scaling(Index i) const { return scalings_ && i >= 0 ? scalings_[i] : common_scaling_; }
    /// Scaling of a pair of edges: that of the thinnest end.
    Scaling<double> scaling(const std::array<Index, 2>& edge1, const std::array<Index, 2>& edge2) const {
        Scaling<double> result = common_scaling_;
        if (!scalings_) return result;
        for (const Index c : {edge1[0], edge1[1], edge2[0], edge2[1]})
            if (scalings_[c].scale > result.scale) result = scalings_[c];
        return result;
    }

    /// Scaling of each lane, scaling_of(lane).
    template <class F>
    Scaling<vec<double>> lane_scaling(F&& scaling_of) const {
        Scaling<vec<double>> lanes_scaling = full_thickness<vec<double>>();
        for (int lane = 0; reduced() && lane < lanes<double>; ++lane) {
            const Scaling<double> scalar = scaling_of(lane);
            lanes_scaling.scale[lane] = scalar.scale, lanes_scaling.growth[lane] = scalar.growth;
        }
        return lanes_scaling;
    }

    /// Evaluate the energy of particle i, or of point ~i of an obstacle, with the triangles from `begin` to `end`: that
    /// of triangles, minus that of edges between two of them, plus that of inner particles. Therefore a flat surface
    /// counts once, independent of its triangulation (Euler's formula; Li et al., Convergent IPC, 2023).
    template <class X, class U>
    void particle(const Surface& s, Index i, const Index* begin, const Index* end, X&& at, U&& velocity,
                  Contact<V>& m) const {
        m.clear(i);
        m.mass = m.has_feature ? feature_mass_ : 0.5 * s.masses[i];
        m.scaling = splat_scaling(scaling(i));
        const double range = radius_ + thickness_ / value_of(m.scaling.scale), square_range = range * range;
        const Vec3<V> p = at(i);
        for (const Index* triangle = begin; triangle != end; ++triangle) {
            const auto& t = s.triangles[*triangle];
            const Vec3<V> x[3] = {at(t[0]), at(t[1]), at(t[2])};
            const OnTriangle<V> n = near_triangle(p, x[0], x[1], x[2]);
            if (!(value_of(n.square) < square_range)) continue;
            const V unit = splat<V>(1.0);
            add_gap(
                {1.0, {i, t[0], t[1], t[2]}, {unit, -n.weight[0], -n.weight[1], -n.weight[2]}, n.away, n.square, V{}},
                velocity, m);
            for (int k = 0; k < 3; ++k) {
                const int next = (k + 1) % 3;
                const Index neighbor = s.neighbors[*triangle][k];
                if (neighbor >= 0 && (s.has(neighbor, i) || *triangle < neighbor)) {
                    const OnSegment<V> e = near_segment(p, x[k], x[next]);
                    if (value_of(e.square) < square_range)
                        add_gap({-1.0,
                                 {i, t[k], t[next], i},
                                 {unit, e.fraction - unit, -e.fraction, V{}},
                                 e.away,
                                 e.square,
                                 V{}},
                                velocity, m);
                }
                if (s.inner[t[k]] && s.first_about(t[k], i) == *triangle) {
                    const Vec3<V> away = p - x[k];
                    const V square = norm2(away);
                    if (value_of(square) < square_range)
                        add_gap({1.0, {i, t[k], i, i}, {unit, -unit, V{}, V{}}, away, square, V{}}, velocity, m);
                }
            }
        }
        for (const GapTerm<V>& g : m.gaps) {
            const V push = splat<V>(g.sign) * particle_law_.elastic(g.gap);
            m.push = m.push + push;
            m.rate = m.rate + push * g.closing;
            m.shape = m.shape + splat<V>(g.sign) * particle_law_.shape(g.gap);
            m.lever = m.lever + push * g.gap;
        }
    }
    /// Evaluate the energy of two edges. It fades out as they become parallel, because the nearest points jump there:
    /// factor (2 - q) q, q = sin^2 of their angle over `parallel`, at most 1.
    template <class X, class U>
    void edges(const Surface& s, const std::array<Index, 2>& edge1, const std::array<Index, 2>& edge2, X&& at,
               U&& velocity, Contact<V>& m) const {
        m.clear(edge2[0]);
        const Index corner[4] = {edge1[0], edge1[1], edge2[0], edge2[1]};
        const Vec3<V> x[4] = {at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3])};
        const OnSegments<V> n = near_segments(x[0], x[1], x[2], x[3]);
        m.scaling = splat_scaling(scaling(edge1, edge2));
        const double range = radius_ + edge_thickness_ / value_of(m.scaling.scale);
        if (!(value_of(n.square) < range * range)) return;
        m.edges = true;
        m.mass = m.has_feature
                     ? feature_mass_
                     : 0.25 * (s.masses[corner[0]] + s.masses[corner[1]] + s.masses[corner[2]] + s.masses[corner[3]]);
        const V unit = splat<V>(1.0);
        add_gap({1.0,
                 {corner[0], corner[1], corner[2], corner[3]},
                 {unit - n.first, n.first, n.second - unit, -n.second},
                 n.away,
                 n.square,
                 V{}},
                velocity, m);
        apply_fade(x[1] - x[0], x[3] - x[2], m);
        const GapTerm<V>& g = m.gaps[0];
        const V shape = edge_law_.shape(g.gap);
        m.push = m.fade_factor * edge_law_.elastic(g.gap);
        m.shape = m.fade_factor * shape;
        m.rate = m.push * g.closing;
        m.lever = m.push * g.gap;
        const V energy = splat<V>(0.5 * ContactLaw<V>::speed * ContactLaw<V>::speed) * shape;
        for (int k = 0; k < 4; ++k) {
            m.slope[k] = energy * m.slope[k];
            m.rate = m.rate + dot(m.slope[k], velocity(corner[k]));
        }
    }
    /// Damping factor of the forces of one contact: Q of `ContactLaw` at the mean closing speed, rate over push.
    /// Therefore the dissipation (Q - 1) rate is never negative.
    V damped(const Contact<V>& m) const { return damped(m.push, m.rate, m.edges); }
    V damped(V push, V rate, bool edges) const {
        if (!(value_of(push) > 0.0)) return splat<V>(1.0);
        return damping_factor<V>(push, rate, edges);
    }
    /// The same for positive pushes; W may be a vector.
    template <class W>
    CLOTH_INLINE W damping_factor(W push, W rate, bool edges) const {
        const W unit = splat<W>(1.0);
        const double gamma = 0.5 * ContactLaw<V>::speed / thickness(edges);
        const W denominator = push * (unit + splat<W>(damping_ / gamma) * push);
        const W u = splat<W>(0.5 * damping_) * rate / denominator;
        return u + root(fma(u, u, unit));
    }
    /// Call `visit` with each corner of a contact and its force.
    template <class F>
    void forces(const Contact<V>& m, F&& visit) const {
        const V scale = splat<V>(m.mass) * damped(m), inverse_scale = splat<V>(1.0) / m.scaling.scale;
        for (const GapTerm<V>& g : m.gaps) {
            const V elastic = m.edges ? m.push : splat<V>(g.sign) * particle_law_.elastic(g.gap);
            const auto visit_corners = [&](auto&& force) {
                for (int k = 0; k < 4; ++k)
                    if (m.edges || !k || g.corner[k] != g.corner[0]) visit(g.corner[k], force(k));
            };
            // The order of products differs, and decides bits.
            if (m.has_feature) {
                const V part = inverse_scale * scale;
                const Vec3<V> push = (part * elastic) * g.normal;
                visit_corners([&](int k) {
                    const Vec3<V> force = g.weight[k] * push;
                    return m.edges ? force - (inverse_scale * part) * m.slope[k] : force;
                });
            } else {
                const V push = inverse_scale * elastic;
                visit_corners([&](int k) {
                    const Vec3<V> force = (push * g.weight[k]) * g.normal;
                    return scale * (m.edges ? force - (inverse_scale * inverse_scale) * m.slope[k] : force);
                });
            }
        }
    }
    double energy(const Contact<V>& m) const {
        return m.mass * 0.5 * ContactLaw<V>::speed * ContactLaw<V>::speed * value_of(m.shape) * unscaled(m);
    }
    /// Power of the damping [W].
    double dissipation(const Contact<V>& m) const {
        return m.mass * (value_of(damped(m)) - 1.0) * value_of(m.rate) * unscaled(m);
    }
    /// Power of its growth [W].
    double growth_power(const Contact<V>& m) const {
        return m.mass * value_of(m.scaling.growth) * unscaled(m) *
               growing(value_of(damped(m)) * value_of(m.lever), value_of(m.shape));
    }
    /// The same over mass, rate and square of the scale, by damped pushes times gaps and energy.
    template <class W>
    static W growing(W lever, W shape) {
        return fma(splat<W>(ContactLaw<double>::speed * ContactLaw<double>::speed), shape, lever);
    }
    const ContactLaw<V>& law(bool edges) const { return edges ? edge_law_ : particle_law_; }

private:
    SurfaceLaw(double thickness, double edge_thickness, double damping, double feature_mass)
        : thickness_(thickness), edge_thickness_(edge_thickness), damping_(damping), feature_mass_(feature_mass),
          particle_law_(thickness, damping), edge_law_(edge_thickness, damping) {}
    static Scaling<V> splat_scaling(Scaling<double> s) { return {splat<V>(s.scale), splat<V>(s.growth)}; }
    static double unscaled(const Contact<V>& m) {
        const double scale = value_of(m.scaling.scale);
        return 1.0 / (scale * scale);
    }
    /// sin^2 of the angle below which edges are parallel: 1.8 degrees, as in IPC.
    static constexpr double parallel = 1e-3;

    /// Complete a gap and add it. On entry g.normal is the vector across the gap [m] and g.gap its squared length
    /// [m^2].
    template <class U>
    void add_gap(GapTerm<V> g, U&& velocity, Contact<V>& m) const {
        const V distance = root(g.gap);
        g.normal = (splat<V>(1.0) / distance) * g.normal;
        g.gap = distance - splat<V>(radius_);
        Vec3<V> speed{};
        const bool has_obstacle_edge = m.edges && m.has_feature;
        if (has_obstacle_edge) {
            const Vec3<V> u = velocity(g.corner[2]), w = velocity(g.corner[3]);
            speed = g.weight[3] * (w - u) - u;
        }
        for (int k = 0; k < (has_obstacle_edge ? 2 : 4); ++k)
            if (!k || g.corner[k] != g.corner[0]) speed = fma(g.weight[k], velocity(g.corner[k]), speed);
        g.closing = m.scaling.closing(g.gap, -dot(g.normal, speed));
        g.gap = m.scaling.gap(g.gap);
        m.gaps.push_back(g);
    }
    void apply_fade(Vec3<V> u, Vec3<V> v, Contact<V>& m) const {
        const V unit = splat<V>(1.0), two = splat<V>(2.0);
        const V uu = norm2(u), vv = norm2(v), uv = dot(u, v), over = unit / (uu * vv);
        const V square = norm2(cross(u, v)) * over, q = square * splat<V>(1.0 / parallel);
        for (auto& slope : m.slope) slope = {};
        m.fade_factor = unit;
        if (!(value_of(q) < 1.0)) return;
        m.fade_factor = (two - q) * q;
        // d(sin^2)/du = 2 (v.v u - u.v v) / (u.u v.v) - 2 sin^2 u / u.u.
        const V steep = (two - two * q) * splat<V>(1.0 / parallel);
        const auto along = [&](Vec3<V> a, V bb, Vec3<V> b, V aa) {
            return steep * ((two * over) * (bb * a - uv * b) - (two * square / aa) * a);
        };
        const Vec3<V> first = along(u, vv, v, uu), second = along(v, uu, u, vv);
        m.slope[0] = -first, m.slope[1] = first, m.slope[2] = -second, m.slope[3] = second;
    }

    double thickness_, edge_thickness_, damping_, feature_mass_;
    ContactLaw<V> particle_law_, edge_law_;
    const Scaling<double>* scalings_ = nullptr;
    double radius_ = 0.0;
    Scaling<double> common_scaling_ = full_thickness<double>();
};

}  // namespace cloth::contact
