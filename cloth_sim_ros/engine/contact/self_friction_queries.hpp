// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of friction between layers, contact by contact, with the anchors of the plan.
#pragma once

#include "contact/self_contact.hpp"
#include "plan/plan.hpp"

namespace cloth::contact {

using plan::Plan;

/// Call `visit` with the friction law and the kinematics of each layer in contact.
template <class V, class X, class U, class F>
inline void for_each_layer_contact(const Plan& plan, const SurfaceLaw<V>& law, const Contact<V>& m, X&& at,
                                   U&& velocity, F&& visit) {
    if (!plan.has_self_friction()) return;
    const SelfFriction<V> friction(plan.self->friction, plan.contacts.frequency, law);
    friction.for_each_layer(
        plan.self->surface, m, plan.layer_anchors(), at, velocity,
        [&](int, const Layer<V>&, const LayerAnchor&, const AnchorKinematics<V>& on) { visit(friction, on); });
}
/// Energy [J], and power [W], of friction.
template <class X, class U>
inline double layer_energy(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, X&& at,
                           U&& velocity) {
    double energy = 0.0;
    for_each_layer_contact<double>(plan, law, m, at, velocity, [&](const auto& friction, const auto& on) {
        energy += on.mass * friction.force(on).energy;
    });
    return energy;
}
template <class X, class U>
inline double layer_dissipation(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, X&& at,
                                U&& velocity) {
    double dissipation = 0.0;
    for_each_layer_contact<double>(plan, law, m, at, velocity, [&](const auto& friction, const auto& on) {
        dissipation += on.mass * friction.force(on).dissipation;
    });
    return dissipation;
}
/// Call `visit` with each corner and a bound [N/m] of the stiffness of its anchor spring.
template <class X, class U, class F>
inline void for_each_layer_bound(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, X&& at,
                                 U&& velocity, F&& visit) {
    for_each_layer_contact<double>(plan, law, m, at, velocity,
                                   [&](const auto& friction, const auto& on) { friction.bounds(on, visit); });
}
template <class X, class U>
inline void add_layer_bounds(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, X&& at,
                             U&& velocity, double* stiff, double* damp) {
    const double damping_ratio = FrictionLaw<double>::damping_per_frequency / plan.contacts.frequency;
    for_each_layer_bound(plan, law, m, at, velocity, [&](Index c, double k) {
        const std::int64_t i = plan.particle_of_rank[c];
        const double damping = damping_ratio * k;
        if (stiff) add_block(stiff, plan.count, i, {k, k, k, 0.0, 0.0, 0.0});
        if (damp) add_block(damp, plan.count, i, {damping, damping, damping, 0.0, 0.0, 0.0});
    });
}
/// Call `visit` with each corner and its force, whose derivatives are those of the law.
template <class X, class U, class F>
inline void add_layer_product(const Plan& plan, const SurfaceLaw<Dual>& law, const Contact<Dual>& m, X&& at,
                              U&& velocity, F&& visit) {
    for_each_layer_contact<Dual>(plan, law, m, at, velocity, [&](const auto& friction, const auto& on) {
        friction.forces(on, friction.force(on), visit);
    });
}

/// Combine the anchors on a layer after runs, as `combine_anchors` does for obstacles: anchors that no run moved are
/// kept, the others are combined as positions and returned to the cone. The runs' `ends` are `stride` numbers apart.
template <class X, class U>
inline void combine_layer_anchors(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, X&& at,
                                  U&& velocity, std::int64_t runs, const double* weights, const double* ends,
                                  std::int64_t stride, double* out) {
    const Surface& s = plan.self->surface;
    const std::int64_t n = plan.count;
    const SelfFriction<double> friction(plan.self->friction, plan.contacts.frequency, law);
    const auto ended = [&](std::int64_t run, int face, Index i) {
        return LayerAnchors{ends + run * stride, plan.particle_of_rank.data(), n}(face, i);
    };
    const auto combined = [&](int face, Index i) {
        const LayerAnchor last_anchor = ended(runs - 1, face, i);
        bool all_bonded = last_anchor.bond != no_bond, same = true;
        for (std::int64_t run = 0; run < runs; ++run) {
            const LayerAnchor anchor = ended(run, face, i);
            all_bonded = all_bonded && anchor.bond != no_bond;
            same = same && anchor.triangle == last_anchor.triangle && anchor.second == last_anchor.second &&
                   anchor.third == last_anchor.third && anchor.bond == last_anchor.bond;
        }
        if (!all_bonded || same) return last_anchor;
        Vec3<double> sum{};
        for (std::int64_t run = 0; run < runs; ++run) {
            const LayerAnchor anchor = ended(run, face, i);
            const auto& t = s.triangles[anchor.triangle];
            const Vec3<double> a = at(t[0]), e = at(t[1]) - a, g = at(t[2]) - a;
            sum = fma(weights[run], fma(anchor.second, e, fma(anchor.third, g, a)), sum);
        }
        return friction.barycentric_anchor(s, last_anchor.triangle, sum, at);
    };
    friction.for_each_layer(
        s, m, combined, at, velocity,
        [&](int face, const Layer<double>& layer, const LayerAnchor& anchor, const AnchorKinematics<double>& on) {
            const auto force = friction.force(on);
            write_anchor(out, n, face, plan.particle_of_rank[on.corner[0]],
                         friction.next_anchor(s, on, layer, anchor, force.slides, {}, force.stretch, at));
        });
}

}  // namespace cloth::contact
