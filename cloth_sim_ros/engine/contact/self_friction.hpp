// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Friction between layers of the cloth: an anchor spring from each face of a particle to a point of the layer there.
// docs/derivations/friction.md derives it. V is a number or a dual number.
#pragma once

#include "contact/layer_anchors.hpp"
#include "contact/stiffness_bound.hpp"

namespace cloth::contact {

using laws::FrictionCoefficients;

/// Push on one face of a particle, as an acceleration, and the nearest triangle there, -1 for none.
template <class V>
struct Layer {
    Vec3<V> push{};
    Index triangle = -1;
    double gap = 1e30;
};

/// Kinematics of a particle relative to its anchor: offset along the triangle, velocity relative to a rigid body with
/// the triangle, and push across it.
template <class V>
struct AnchorKinematics {
    Index corner[4];  ///< the particle, and those of the triangle
    Index triangle;
    double mass;
    Vec3<V> offset, normal, slip;
    V gap, push;
    V anchor[3], foot[3];  ///< barycentric weights of the triangle's corners
    Vec3<V> slope[3];      ///< gradients of those weights

    Vec3<V> weights_at(Vec3<V> along) const {
        return {foot[0] + dot(slope[0], along), foot[1] + dot(slope[1], along), foot[2] + dot(slope[2], along)};
    }
};

template <class V>
class SelfFriction {
public:
    SelfFriction(const FrictionCoefficients& coefficients, double frequency, const SurfaceLaw<V>& law)
        : friction_(coefficients, frequency), law_(law), stiffness_(frequency * frequency) {}

    /// Find the layers on the faces of a particle from its contact. The first triangle about the particle defines the
    /// faces.
    template <class X>
    void find_layers(const Surface& s, const Contact<V>& m, X&& at, Layer<V> (&out)[layer_sides]) const {
        const V damping_factor = law_.damped(m) / m.scaling.scale;
        const Index i = m.gaps[0].corner[0];
        Vec3<double> up{};
        if (s.start[i] < s.start[i + 1]) {
            const auto& t = s.triangles[s.fan[s.start[i]]];
            const Vec3<double> a = value3(at(t[0])), b = value3(at(t[1])), c = value3(at(t[2]));
            up = cross(b - a, c - a);
        }
        for (const GapTerm<V>& g : m.gaps) {
            Layer<V>& layer = out[dot(up, value3(g.normal)) < 0.0 ? 1 : 0];
            layer.push = fma(splat<V>(g.sign) * damping_factor * law_.law(false).elastic(g.gap), g.normal, layer.push);
            if (g.sign < 0.0 || g.corner[2] == i || !(value_of(g.gap) < layer.gap)) continue;
            layer.gap = value_of(g.gap);
            layer.triangle = triangle_of(s, g);
        }
    }
    /// Kinematics on a layer. Without an anchor it is at the particle.
    template <class X, class U>
    AnchorKinematics<V> kinematics(const Surface& s, const Contact<V>& m, const Layer<V>& layer,
                                   const LayerAnchor& anchor, X&& at, U&& velocity) const {
        const bool has_anchor = anchor.bond != no_bond;
        AnchorKinematics<V> on;
        on.triangle = has_anchor ? anchor.triangle : layer.triangle;
        const auto& t = s.triangles[on.triangle];
        on.corner[0] = m.gaps[0].corner[0];
        for (int k = 0; k < 3; ++k) on.corner[k + 1] = t[k];
        on.mass = m.mass;
        const V unit = splat<V>(1.0);
        const Vec3<V> a = at(t[0]), e = at(t[1]) - a, g = at(t[2]) - a, r = at(on.corner[0]) - a, across = cross(e, g);
        const V over = unit / norm2(across);
        on.normal = root(over) * across;
        on.slope[1] = over * cross(g, across);
        on.slope[2] = over * cross(across, e);
        on.slope[0] = -(on.slope[1] + on.slope[2]);
        on.gap = dot(r, on.normal);
        on.foot[1] = dot(r, on.slope[1]);
        on.foot[2] = dot(r, on.slope[2]);
        on.foot[0] = unit - on.foot[1] - on.foot[2];
        on.anchor[1] = has_anchor ? splat<V>(anchor.second) : on.foot[1];
        on.anchor[2] = has_anchor ? splat<V>(anchor.third) : on.foot[2];
        on.anchor[0] = unit - on.anchor[1] - on.anchor[2];
        on.offset = has_anchor ? (on.foot[1] - on.anchor[1]) * e + (on.foot[2] - on.anchor[2]) * g : Vec3<V>{};
        // The normal changes at the rate -sum (n . v_k) slope_k.
        on.slip = velocity(on.corner[0]);
        for (int k = 0; k < 3; ++k) {
            const Vec3<V> v = velocity(t[k]);
            on.slip = fma(-on.foot[k], v, on.slip);
            on.slip = fma(on.gap * dot(on.normal, v), on.slope[k], on.slip);
        }
        const V push = dot(layer.push, on.normal);
        on.push = larger(push, -push);
        return on;
    }
    /// Call `visit` with each face of a particle in contact, the layer there, the valid anchor (`anchor_of(face)`), and
    /// the kinematics.
    template <class A, class X, class U, class F>
    void for_each_layer(const Surface& s, const Contact<V>& m, A&& anchor_of, X&& at, U&& velocity, F&& visit) const {
        if (m.edges || m.gaps.empty()) return;
        Layer<V> layers[layer_sides];
        find_layers(s, m, at, layers);
        for (int face = 0; face < layer_sides; ++face) {
            Layer<V>& layer = layers[face];
            if (layer.triangle < 0) continue;
            const Index i = m.gaps[0].corner[0];
            const LayerAnchor anchor = valid_anchor(s, layer.triangle, anchor_of(face, i));
            if (anchor.bond == no_bond) layer.triangle = supporting_triangle(s, layer.triangle, i, at);
            const AnchorKinematics<V> on = kinematics(s, m, layer, anchor, at, velocity);
            if (value_of(on.push) > 0.0) visit(face, layer, anchor, on);
        }
    }
    auto force(const AnchorKinematics<V>& on) const { return friction_.force(on.offset, on.normal, on.slip, on.push); }

    /// Call `visit` with each corner and its force. The forces on the triangle are those of a rigid body with a force
    /// at the particle: they conserve momentum and angular momentum.
    template <class R, class F>
    void forces(const AnchorKinematics<V>& on, const R& friction, F&& visit) const {
        const V mass = splat<V>(on.mass);
        const Vec3<V> force = mass * friction.push, damped = force + (mass * splat<V>(stiffness_)) * friction.stretch;
        visit(on.corner[0], force);
        for (int k = 0; k < 3; ++k) {
            const Vec3<V> reaction = fma(on.anchor[k], force, (on.foot[k] - on.anchor[k]) * damped);
            visit(on.corner[k + 1], (on.gap * dot(force, on.slope[k])) * on.normal - reaction);
        }
    }
    /// Call `visit` with each corner and a bound [N/m] of the stiffness of the anchor spring: for a spring k G G', the
    /// sum of |G_c| over corners times k |G_c| (Gershgorin).
    template <class F>
    void bounds(const AnchorKinematics<V>& on, F&& visit) const {
        double parts[4] = {1.0}, sum = 1.0;
        for (int k = 0; k < 3; ++k) {
            const double lever = absolute(value_of(on.gap)) * root(norm2(value3(on.slope[k])));
            sum += parts[k + 1] = absolute(value_of(on.anchor[k])) + lever;
        }
        for (int k = 0; k < 4; ++k) visit(on.corner[k], on.mass * stiffness_ * sum * parts[k]);
    }
    /// Anchor after sticking or sliding, at positions `at`. If it slides it is the particle advanced by `remaining` [m],
    /// minus the stretch. It stays in its triangle until the particle's foot has left it by `keep_margin`.
    template <class X>
    LayerAnchor next_anchor(const Surface& s, const AnchorKinematics<V>& on, const Layer<V>& layer,
                            const LayerAnchor& anchor, bool is_sliding, Vec3<V> remaining, Vec3<V> stretch,
                            X&& at) const {
        if (!is_sliding && anchor.bond == no_bond) return {layer.triangle, on.foot[1], on.foot[2], sticks};
        if (!is_sliding) return {anchor.triangle, anchor.second, anchor.third, sticks};
        const Vec3<V> b = on.weights_at(remaining - stretch);
        if (contains(on.foot, keep_margin)) return {on.triangle, b.y, b.z, slides};
        const Index next = supporting_triangle(s, layer.triangle, on.corner[0], at);
        return barycentric_anchor(s, next, b.x * at(on.corner[1]) + b.y * at(on.corner[2]) + b.z * at(on.corner[3]),
                                  at);
    }
    /// Triangle below a particle: of the nearest one and those about it, the first that contains the foot up to
    /// `enter_margin`. Over an edge or a corner, where rounding decides the nearest one, the choice is unique.
    template <class X>
    Index supporting_triangle(const Surface& s, Index nearest, Index i, X&& at) const {
        Index result = nearest;
        const Vec3<double> p = value3(at(i));
        for (const Index corner : s.triangles[nearest])
            for (Index k = s.start[corner]; k < s.start[corner + 1]; ++k) {
                const Index triangle = s.fan[k];
                if (triangle >= result || s.has(triangle, i)) continue;
                const auto& t = s.triangles[triangle];
                const Vec3<double> a = value3(at(t[0])), e = value3(at(t[1])) - a, g = value3(at(t[2])) - a, r = p - a;
                const Vec3<double> across = cross(e, g);
                const double square = norm2(across), height = dot(r, across), over = 1.0 / square;
                const double second = dot(r, cross(g, across)) * over, third = dot(r, cross(across, e)) * over;
                const double foot[3] = {1.0 - second - third, second, third};
                const double reach = law_.thickness(false);
                if (contains(foot, enter_margin) && height * height < reach * reach * square) result = triangle;
            }
        return result;
    }
    /// A position as an anchor in a triangle.
    template <class X>
    LayerAnchor barycentric_anchor(const Surface& s, Index triangle, Vec3<V> p, X&& at) const {
        const auto& t = s.triangles[triangle];
        const Vec3<V> a = at(t[0]), e = at(t[1]) - a, g = at(t[2]) - a, r = p - a, across = cross(e, g);
        const V over = splat<V>(1.0) / norm2(across);
        return {triangle, dot(r, cross(g, across)) * over, dot(r, cross(across, e)) * over, slides};
    }
    /// An anchor, if its triangle is the nearest one or touches it.
    LayerAnchor valid_anchor(const Surface& s, Index nearest, const LayerAnchor& anchor) const {
        if (anchor.bond == no_bond) return {};
        for (const Index corner : s.triangles[anchor.triangle])
            if (s.has(nearest, corner)) return anchor;
        return {};
    }
    const FrictionLaw<V>& law() const { return friction_; }
    double stiffness() const { return stiffness_; }

private:
    /// Negative weights allowed for a foot in its triangle, at first and later. Therefore sliding along an edge changes
    /// the triangle once, not in every step.
    static constexpr double enter_margin = 0.1, keep_margin = 0.2;

    template <class W>
    static bool contains(const W (&foot)[3], double margin) {
        return value_of(foot[0]) >= -margin && value_of(foot[1]) >= -margin && value_of(foot[2]) >= -margin;
    }
    static Vec3<double> value3(Vec3<V> a) { return {value_of(a.x), value_of(a.y), value_of(a.z)}; }
    static Index triangle_of(const Surface& s, const GapTerm<V>& g) {
        for (Index k = s.start[g.corner[1]]; k < s.start[g.corner[1] + 1]; ++k) {
            const auto& t = s.triangles[s.fan[k]];
            if (t[0] == g.corner[1] && t[1] == g.corner[2] && t[2] == g.corner[3]) return s.fan[k];
        }
        return -1;
    }
    FrictionLaw<V> friction_;
    const SurfaceLaw<V>& law_;
    double stiffness_;
};

/// Friction between layers over a run, on one thread.
class SelfFrictionRun {
public:
    SelfFrictionRun(const Surface& surface, const FrictionCoefficients& coefficients, double frequency,
                    const SurfaceLaw<double>& law, double step, const LayerAnchors& anchors)
        : surface_(surface), friction_(coefficients, frequency, law), step_(step),
          anchors_(layer_sides * surface.count), pushes_(anchors_.size(), 0.0), last_step_(anchors_.size(), -1) {
        for (int face = 0; face < layer_sides; ++face)
            for (std::int64_t i = 0; i < surface.count; ++i)
                anchors_[slot(face, i)] = anchors(face, static_cast<Index>(i));
    }
    /// Add the forces of a particle's contact at a step, and their power [W] to `dissipation`. Anchors move from step 0
    /// on.
    template <class X, class F>
    void add(std::int64_t step, const Contact<double>& m, X&& at, X&& velocity, F&& push, double* dissipation) {
        // A bond ends with the first step without contact.
        const auto anchor_of = [&](int face, Index i) {
            const std::size_t k = slot(face, i);
            return last_step_[k] + 1 >= step ? anchors_[k] : LayerAnchor{};
        };
        const auto add_layer = [&](int face, const Layer<double>& layer, const LayerAnchor& anchor,
                                   const AnchorKinematics<double>& on) {
            const auto friction = friction_.force(on);
            friction_.forces(on, friction, push);
            friction_.bounds(on, [&](Index c, double k) { load_.add(surface_, c, k); });
            if (dissipation) *dissipation += on.mass * friction.dissipation;
            if (step < 0) return;
            // Forces are evaluated at the middle of a step. Anchors are advanced to its end, like those on obstacles.
            const std::size_t k = slot(face, on.corner[0]);
            const double previous = last_step_[k] + 1 == step ? pushes_[k] : 0.0;
            const double end_push = larger(fma(0.5, previous > 0.0 ? on.push - previous : 0.0, on.push), 0.0);
            const Vec3<double> tangential = on.slip - dot(on.slip, on.normal) * on.normal,
                               remaining = (0.5 * step_) * tangential;
            const auto end = friction_.law().radial_return(on.offset + remaining, on.normal, on.slip, end_push);
            anchors_[k] = friction_.next_anchor(surface_, on, layer, anchor, end.slides, remaining, end.stretch, at);
            pushes_[k] = on.push;
            last_step_[k] = step;
        };
        friction_.for_each_layer(surface_, m, anchor_of, at, velocity, add_layer);
    }
    void flush() { load_.flush(); }
    /// Write the anchors after `steps` steps.
    void finish(std::int64_t steps, const std::int64_t* particle_of_rank, double* to) const {
        for (int face = 0; face < layer_sides; ++face)
            for (std::int64_t i = 0; i < surface_.count; ++i) {
                const std::size_t k = slot(face, i);
                write_anchor(to, surface_.count, face, particle_of_rank[i],
                             last_step_[k] + 1 == steps ? anchors_[k] : LayerAnchor{});
            }
    }
    /// Squared frequency [1/s^2] of anchor springs: two layers double that of one spring.
    double omega2() const { return larger(load_.max(), 2.0 * friction_.stiffness()); }

private:
    std::size_t slot(int face, std::int64_t i) const { return static_cast<std::size_t>(face * surface_.count + i); }

    const Surface& surface_;
    SelfFriction<double> friction_;
    double step_;
    std::vector<LayerAnchor> anchors_;
    std::vector<double> pushes_;
    std::vector<std::int64_t> last_step_;  ///< last step in contact
    RowSums load_;
};

}  // namespace cloth::contact
