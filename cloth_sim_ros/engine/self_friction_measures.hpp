// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What is asked of friction between layers beside its forces over a run, meeting by meeting, with the plan's anchors.
#pragma once

#include "list_measures.hpp"
#include "plan.hpp"

namespace cloth {

/// Call `what` with the friction law and each stance of a meeting.
template <class V, class X, class U, class F>
inline void for_each_stance(const Plan& plan, const SelfLaw<V>& law, const Meeting<V>& m, X&& at, U&& moving, F&& what) {
    if (!plan.rubs()) return;
    const LayerFriction<V> friction(plan.self->rough, plan.contacts.frequency, law);
    friction.each(plan.self->surface, m, plan.layer_anchors(), at, moving,
                  [&](int, const Layer<V>&, const LayerAnchor&, const Stance<V>& on) { what(friction, on); });
}
template <class X, class U>
inline double layer_energy(const Plan& plan, const SelfLaw<double>& law, const Meeting<double>& m, X&& at, U&& moving) {
    double energy = 0.0;
    for_each_stance<double>(plan, law, m, at, moving, [&](const auto& friction, const Stance<double>& on) {
        energy += on.mass * friction.rub(on).energy;
    });
    return energy;
}
/// Power that friction takes [W].
template <class X, class U>
inline double layer_lost(const Plan& plan, const SelfLaw<double>& law, const Meeting<double>& m, X&& at, U&& moving) {
    double lost = 0.0;
    for_each_stance<double>(plan, law, m, at, moving, [&](const auto& friction, const Stance<double>& on) {
        lost += on.mass * friction.rub(on).lost;
    });
    return lost;
}
template <class X, class U>
inline void add_layer_bounds(const Plan& plan, const SelfLaw<double>& law, const Meeting<double>& m, X&& at, U&& moving,
                             double* stiff, double* damp) {
    const double rate = FrictionLaw<double>::damping_share / plan.contacts.frequency;
    for_each_stance<double>(plan, law, m, at, moving, [&](const auto& friction, const Stance<double>& on) {
        friction.bounds(on, [&](Index c, double k) {
            const Sym3<double> all{k, k, k, 0.0, 0.0, 0.0}, part{rate * k, rate * k, rate * k, 0.0, 0.0, 0.0};
            if (stiff) add_block(stiff, plan.count, plan.own[c], all);
            if (damp) add_block(damp, plan.count, plan.own[c], part);
        });
    });
}
/// Add the derivative of the forces to out, (3, n).
template <class X, class U>
inline void add_layer_product(const Plan& plan, const SelfLaw<Dual>& law, const Meeting<Dual>& m, X&& at, U&& moving,
                              double* out) {
    for_each_stance<Dual>(plan, law, m, at, moving, [&](const auto& friction, const Stance<Dual>& on) {
        friction.forces(on, friction.rub(on), [&](Index c, Vec3<Dual> force) {
            const std::int64_t i = plan.own[c];
            out[i] += force.x.slope;
            out[plan.count + i] += force.y.slope;
            out[2 * plan.count + i] += force.z.slope;
        });
    });
}
template <class X, class U>
inline void add_layer_loads(const Plan& plan, const SelfLaw<double>& law, const Meeting<double>& m, X&& at, U&& moving,
                            LayerLoad& load) {
    for_each_stance<double>(plan, law, m, at, moving, [&](const auto& friction, const Stance<double>& on) {
        friction.bounds(on, [&](Index c, double k) { load.add(plan.self->surface, c, k); });
    });
}

/// Anchors on a layer after runs that ended with some of their own, as `settle_anchors` has them for obstacles: what no
/// run moved stays as it is; the rest is combined as places, and dragged back onto the cone. `ends` of each run lie
/// `stride` numbers apart.
template <class X, class U>
inline void settle_layers(const Plan& plan, const SelfLaw<double>& law, const Meeting<double>& m, X&& at, U&& moving,
                          std::int64_t runs, const double* weights, const double* ends, std::int64_t stride,
                          double* out) {
    const Surface& s = plan.self->surface;
    const std::int64_t n = plan.count;
    const LayerFriction<double> friction(plan.self->rough, plan.contacts.frequency, law);
    const auto ended = [&](std::int64_t run, int side, Index i) {
        return LayerAnchors{ends + run * stride, plan.own.data(), n}(side, i);
    };
    const auto combined = [&](int side, Index i) {
        const LayerAnchor last = ended(runs - 1, side, i);
        bool all = last.bond != no_bond, same = true;
        for (std::int64_t run = 0; run < runs; ++run) {
            const LayerAnchor one = ended(run, side, i);
            all = all && one.bond != no_bond;
            same = same && one.triangle == last.triangle && one.second == last.second && one.third == last.third &&
                   one.bond == last.bond;
        }
        if (!all || same) return last;
        Vec3<double> sum{};
        for (std::int64_t run = 0; run < runs; ++run) {
            const LayerAnchor one = ended(run, side, i);
            const auto& t = s.triangles[one.triangle];
            const Vec3<double> a = at(t[0]), e = at(t[1]) - a, g = at(t[2]) - a;
            sum = fma(weights[run], fma(one.second, e, fma(one.third, g, a)), sum);
        }
        return friction.weighed(s, last.triangle, sum, at);
    };
    friction.each(s, m, combined, at, moving,
                  [&](int side, const Layer<double>& layer, const LayerAnchor& anchor, const Stance<double>& on) {
                      const auto rubbed = friction.rub(on);
                      LayerAnchor kept = anchor;
                      if (rubbed.slides)
                          kept = friction.dragged(s, on, layer, Vec3<double>{}, rubbed.stretch, at);
                      else if (anchor.bond == no_bond)
                          kept = {layer.triangle, on.foot[1], on.foot[2], sticks};
                      else
                          kept.bond = sticks;
                      keep_anchor(out, n, side, plan.own[on.corner[0]], kept);
                  });
}

}  // namespace cloth
