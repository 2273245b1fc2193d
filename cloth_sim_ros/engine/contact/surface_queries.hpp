// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of contact with the surface, by the cloth itself and by points and edges of obstacles: energy, powers, bounds,
// derivative product, anchors, prediction. Arrays are (3, n) by component.
#pragma once

#include "contact/surface_contacts.hpp"

namespace cloth::contact {

/// Add the sum of term(contact) over the contacts of the cloth with itself, and that over the others.
template <class F>
inline void add_sums(Plan& plan, const SurfaceState& state, double& to, F&& term) {
    double sums[2] = {};
    for_each_surface_contact<double>(plan, state, [&](const auto& c) { sums[c.contact.has_feature] += term(c); });
    to += sums[0];
    to += sums[1];
}

/// Call `visit` with the friction law and the kinematics of each layer in contact, with the anchors of the plan.
template <class C, class F>
inline void for_each_layer_contact(const Plan& plan, const C& c, F&& visit) {
    if (!plan.has_self_friction() || c.contact.has_feature) return;
    const SelfFriction<typename C::Number> friction(plan.self->friction, plan.contacts.frequency, c.law);
    friction.for_each_layer(plan.self->surface, c.contact, plan.layer_anchors(), c.at, c.velocity,
                            [&](int, const auto&, const auto&, const auto& on) { visit(friction, on); });
}
/// Sum of a number of the friction per mass, for all layers in contact.
template <class C, class F>
inline double layer_sum(const Plan& plan, const C& c, F&& number) {
    double sum = 0.0;
    for_each_layer_contact(plan, c,
                           [&](const auto& friction, const auto& on) { sum += on.mass * number(friction.force(on)); });
    return sum;
}
template <class C>
inline double layer_dissipation(const Plan& plan, const C& c) {
    return layer_sum(plan, c, [](const auto& friction) { return friction.dissipation; });
}

void add_surface_energy(Plan& plan, double t, const double* x, double& potential) {
    add_sums(plan, {.t = t, .x = x}, potential, [&](const auto& c) {
        return c.law.energy(c.contact) + layer_sum(plan, c, [](const auto& friction) { return friction.energy; });
    });
}
double self_dissipation(Plan& plan, double t, const double* x, const double* v) {
    double dissipation = 0.0;
    for_each_self_contact<double>(plan, {.t = t, .x = x, .v = v}, [&](const auto& c) {
        dissipation += c.law.dissipation(c.contact) + layer_dissipation(plan, c);
    });
    return dissipation;
}
/// Power of friction between layers [W].
double self_friction_power(Plan& plan, double t, const double* x, const double* v) {
    double dissipation = 0.0;
    for_each_self_contact<double>(plan, {.t = t, .x = x, .v = v},
                                  [&](const auto& c) { dissipation += layer_dissipation(plan, c); });
    return dissipation;
}
void add_surface_jerk(Plan& plan, const Moment& moment, double factor, double duration, double* out) {
    const SurfaceLaw<double> surface_law(plan.contacts.thickness, plan.contacts.damping);
    const SurfaceState state{.t = moment.t, .x = moment.x, .v = moment.v, .duration = duration};
    for_each_surface_contact<double>(plan, state, [&](const auto& c) {
        const Contact<double>& m = c.contact;
        const double scale = factor * m.mass * (m.edges ? m.fade_factor : 1.0) / m.scaling.scale,
                     thickness = surface_law.thickness(m.edges);
        for (const GapTerm<double>& g : m.gaps) {
            if (!(g.gap < thickness) && !(g.gap < thickness - factor * g.closing * duration)) continue;
            // Out of contact, the surface stops the particle within the interval, or has stopped it.
            const double speed = g.closing / ContactLaw<double>::speed,
                         nearest = g.gap < thickness ? g.gap : stopping_gap(speed * speed) * thickness,
                         jerk = scale * g.sign * surface_law.law(m.edges).stiffness(nearest) * g.closing;
            for (int corner = 0; corner < 4; ++corner) {
                if (g.corner[corner] < 0 || (!m.edges && corner && g.corner[corner] == g.corner[0])) continue;
                const std::int64_t i = plan.particle_of_rank[g.corner[corner]];
                const double part = g.weight[corner] * jerk * plan.free_inverse[i];
                out[i] += part * g.normal.x, out[plan.count + i] += part * g.normal.y;
                out[2 * plan.count + i] += part * g.normal.z;
            }
        }
    });
}
/// Add the power of contacts that recover their thickness [W].
void add_surface_growth_power(Plan& plan, double t, const double* x, const double* v, double& power) {
    if (!plan.contacts.reduced.any()) return;
    add_sums(plan, {.t = t, .x = x, .v = v}, power, [](const auto& c) { return c.law.growth_power(c.contact); });
}
/// Add the wrench on each obstacle about its position, the power on the cloth and the dissipation, (obstacles,
/// record_numbers).
void add_feature_wrenches(Plan& plan, double t, const double* x, const double* v, double weight, double* wrenches) {
    for_each_feature_contact<double>(plan, {.t = t, .x = x, .v = v}, [&](const auto& c) {
        double* const to = wrenches + c.obstacle * record_numbers;
        c.law.forces(c.contact, [&](Index k, Vec3<double> force) {
            if (k < 0) FeatureRun::accumulate(to, *c.from, ~k, force, weight);
        });
        to[record_numbers - 1] += weight * c.law.dissipation(c.contact);
    });
}
/// Add the forces that open the jaws [N], by gripper.
void add_feature_jaw_forces(Plan& plan, double t, const double* x, const double* v, std::vector<double>& jaw_forces) {
    for_each_feature_contact<double>(plan, {.t = t, .x = x, .v = v}, [&](const auto& c) {
        const Obstacle& obstacle = plan.contacts.obstacles[c.obstacle];
        if (obstacle.parallel_jaw < 0) return;
        c.law.forces(c.contact, [&](Index k, Vec3<double> force) {
            if (k < 0) jaw_forces[obstacle.parallel_jaw] += obstacle.jaw_side * dot(c.from->pose.rotation[1], force);
        });
    });
}

/// Add blocks that bound the stiffness and damping of a contact: for a gap k g g', g = weights times normal, at most
/// `mobility` k |w_c| n n' at corner c, because the weights of either side add up to one. Terms with a negative sign
/// only soften, and fading edges too.
inline void add_gap_bounds(const Plan& plan, const SurfaceLaw<double>& law, const Contact<double>& m, double mobility,
                           double* stiff, double* damp) {
    for (const GapTerm<double>& g : m.gaps) {
        if (g.sign < 0.0) continue;
        const double mass = mobility * m.mass * (m.edges ? m.fade_factor : 1.0);
        const double k = mass * law.law(m.edges).stiffness(g.gap), c = mass * law.law(m.edges).damping(g.gap);
        for (int corner = 0; corner < 4; ++corner) {
            if (g.corner[corner] < 0 || (!m.edges && corner && g.corner[corner] == g.corner[0])) continue;
            const double weight = absolute(g.weight[corner]);
            const std::int64_t i = plan.particle_of_rank[g.corner[corner]];
            if (stiff) add_block(stiff, plan.count, i, outer(k * weight, g.normal, 0.0));
            if (damp) add_block(damp, plan.count, i, outer(c * weight, g.normal, 0.0));
        }
    }
}
/// Call `visit` with each corner and a bound [N/m] of the stiffness of its anchor spring.
template <class C, class F>
inline void for_each_layer_bound(const Plan& plan, const C& c, F&& visit) {
    for_each_layer_contact(plan, c, [&](const auto& friction, const auto& on) { friction.bounds(on, visit); });
}
void add_self_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp) {
    const double damping_ratio = FrictionLaw<double>::damping_per_frequency / plan.contacts.frequency;
    for_each_self_contact<double>(plan, {.t = t, .x = x}, [&](const auto& contact) {
        for_each_layer_bound(plan, contact, [&](Index c, double k) {
            const std::int64_t i = plan.particle_of_rank[c];
            const double damping = damping_ratio * k;
            if (stiff) add_block(stiff, plan.count, i, {k, k, k, 0.0, 0.0, 0.0});
            if (damp) add_block(damp, plan.count, i, {damping, damping, damping, 0.0, 0.0, 0.0});
        });
        add_gap_bounds(plan, contact.law, contact.contact, 2.0, stiff, damp);
    });
}
void add_feature_bounds(Plan& plan, double t, const double* x, double* stiff, double* damp) {
    for_each_feature_contact<double>(plan, {.t = t, .x = x},
                                     [&](const auto& c) { add_gap_bounds(plan, c.law, c.contact, 1.0, stiff, damp); });
}
void add_surface_product(Plan& plan, double t, const double* x, const double* v, const double* dx, const double* dv,
                         double* out) {
    const auto add = [&](Index c, Vec3<Dual> force) {
        if (c < 0) return;
        const std::int64_t i = plan.particle_of_rank[c];
        out[i] += force.x.slope;
        out[plan.count + i] += force.y.slope;
        out[2 * plan.count + i] += force.z.slope;
    };
    for_each_surface_contact<Dual>(plan, {.t = t, .x = x, .v = v, .dx = dx, .dv = dv}, [&](const auto& c) {
        for_each_layer_contact(
            plan, c, [&](const auto& friction, const auto& on) { friction.forces(on, friction.force(on), add); });
        c.law.forces(c.contact, add);
    });
}

/// Number of particles and pairs of edges in contact, and their least gap [m], infinite if there are none.
void self_gaps(Plan& plan, const double* x, double* out) {
    out[0] = 0.0;
    out[1] = std::numeric_limits<double>::infinity();
    for_each_self_contact<double>(plan, {.t = 0.0, .x = x, .ignore_reduction = true}, [&](const auto& c) {
        out[0] += 1.0;
        out[1] = smaller(c.contact.min_gap(), out[1]);
    });
}
/// Lower the gaps in column 1 of (obstacles, 2) to the least gap of each obstacle's features.
void feature_gaps(Plan& plan, double t, const double* x, double* out) {
    for_each_feature_contact<double>(plan, {.t = t, .x = x, .ignore_reduction = true}, [&](const auto& c) {
        double& to = out[2 * c.obstacle + 1];
        to = smaller(c.contact.min_gap(), to);
    });
}
/// Lower the gaps [m] in the rows and columns of `ReducedThickness`, in units of the full thickness of particles. The
/// last row has each particle's contacts within the thickness, to triangles, edges and particles, and of its edges with
/// other edges; the last column each obstacle's features within half the thickness.
void surface_gap_rows(Plan& plan, double t, const double* x, double* out) {
    const std::int64_t columns = plan.count + 1;
    for_each_surface_contact<double>(plan, {.t = t, .x = x, .ignore_reduction = true}, [&](const auto& c) {
        const Contact<double>& m = c.contact;
        const double gap = m.edges || m.has_feature ? 2.0 * m.min_gap() : m.min_gap();
        const auto lower = [&](std::int64_t row, std::int64_t column) {
            double& to = out[row * columns + column];
            to = smaller(gap, to);
        };
        if (m.has_feature) return lower(c.obstacle, plan.count);
        for (int k = 0; k < (m.edges ? 4 : 1); ++k)
            lower(plan.contacts.count(), plan.particle_of_rank[m.gaps[0].corner[k]]);
    });
}

/// Combine the anchors on layers after runs, as `combine_anchors` does for obstacles, whose anchors come before them:
/// anchors that no run moved are kept, the others are combined as positions and returned to the cone.
void combine_self_anchors(Plan& plan, double t, const double* x, const double* v, std::int64_t runs,
                          const double* weights, const double* all_ends, double* all_out) {
    if (!plan.has_self_friction()) return;
    const std::int64_t offset = plan.contacts.obstacle_anchors(plan.count), stride = plan.anchor_count();
    const double* const ends = all_ends + offset;
    double* const out = all_out + offset;
    const Surface& s = plan.self->surface;
    const std::int64_t n = plan.count;
    const auto ended = [&](std::int64_t run, int face, Index i) {
        return LayerAnchors{ends + run * stride, plan.particle_of_rank.data(), n}(face, i);
    };
    for_each_self_contact<double>(plan, {.t = t, .x = x, .v = v}, [&](const auto& contact) {
        const SelfFriction<double> friction(plan.self->friction, plan.contacts.frequency, contact.law);
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
                const Vec3<double> a = contact.at(t[0]), e = contact.at(t[1]) - a, g = contact.at(t[2]) - a;
                sum = fma(weights[run], fma(anchor.second, e, fma(anchor.third, g, a)), sum);
            }
            return friction.barycentric_anchor(s, last_anchor.triangle, sum, contact.at);
        };
        friction.for_each_layer(
            s, contact.contact, combined, contact.at, contact.velocity,
            [&](int face, const Layer<double>& layer, const LayerAnchor& anchor, const AnchorKinematics<double>& on) {
                const auto force = friction.force(on);
                write_anchor(out, n, face, plan.particle_of_rank[on.corner[0]],
                             friction.next_anchor(s, on, layer, anchor, force.slides, {}, force.stretch, contact.at));
            });
    });
}

/// Call visit(particle, corners, end, same, start, before, stretch) for each layer with anchor springs in two states: both
/// anchors, the triangle of the second one, and both stretches [m]. A stretch turns and deforms with the triangle of its
/// anchor; `before` is that of the first state with the triangle of the second.
template <class F>
inline void for_each_layer_spring(const Plan& plan, const AnchoredState& start, const AnchoredState& end, F&& visit) {
    if (!plan.has_self_friction()) return;
    const std::int64_t n = plan.count, before_layers = plan.contacts.obstacle_anchors(n);
    const Surface& s = plan.self->surface;
    const LayerAnchors starts{start.anchors + before_layers, plan.particle_of_rank.data(), n},
        ends{end.anchors + before_layers, plan.particle_of_rank.data(), n};
    const RankReader at_start{plan, start.x}, at_end{plan, end.x};
    for (int face = 0; face < layer_sides; ++face)
        for (std::int64_t rank = 0; rank < n; ++rank) {
            const Index i = static_cast<Index>(rank);
            const LayerAnchor a = starts(face, i), b = ends(face, i);
            if (a.bond == no_bond || b.bond == no_bond) continue;
            // Stretch by the weights of an anchor at some positions, with the edges of its triangle at the end.
            const auto stretch = [&](const LayerAnchor& anchor, const auto& at) {
                const auto& t = s.triangles[anchor.triangle];
                const Vec3<double> c = at(t[0]), e = at(t[1]) - c, g = at(t[2]) - c, r = at(i) - c,
                                   across = cross(e, g);
                const double area = norm2(across), over = area > 0.0 ? 1.0 / area : 0.0;
                const double second = dot(r, cross(g, across)) * over, third = dot(r, cross(across, e)) * over;
                const Vec3<double> d = at_end(t[0]);
                return (second - anchor.second) * (at_end(t[1]) - d) + (third - anchor.third) * (at_end(t[2]) - d);
            };
            visit(i, s.triangles[b.triangle], a, b, stretch(a, at_start), stretch(b, at_end));
        }
}

/// Add what friction between layers may have changed, as `add_friction_change` does for obstacles, whose anchors come
/// before them. A stuck layer's velocity is that of its particle relative to the anchor's place on the triangle.
inline void add_layer_friction_change(const Plan& plan, const AnchoredState& start, const AnchoredState& end,
                                      double* out) {
    const std::int64_t n = plan.count;
    const double frequency = plan.contacts.frequency, rate = 1.0 / (end.t - start.t);
    const RankReader at{plan, end.x}, velocity{plan, end.v};
    for_each_layer_spring(
        plan, start, end,
        [&](Index i, const auto& t, const LayerAnchor& a, const LayerAnchor& b, const Vec3<double>& before,
            const Vec3<double>& stretch) {
            double* const vibration = out + 3 * n + plan.particle_of_rank[i];
            if (a.triangle == b.triangle && a.second == b.second && a.third == b.third) {
                const Vec3<double> c = at(t[0]), across = cross(at(t[1]) - c, at(t[2]) - c);
                const double first = 1.0 - b.second - b.third, area = norm2(across);
                const Vec3<double> slip =
                    velocity(i) - first * velocity(t[0]) - b.second * velocity(t[1]) - b.third * velocity(t[2]);
                add_to(vibration, n,
                       slip - (area > 0.0 ? dot(slip, across) / area : 0.0) * across - rate * (stretch - before));
                return;
            }
            if (b.bond == sticks) add_to(vibration, n, frequency * stretch);
            const Vec3<double> force =
                (0.5 * plan.self->surface.masses[i] * frequency * frequency) * (before - stretch);
            const auto add = [&](Index c, double weight) {
                const std::int64_t k = plan.particle_of_rank[c];
                add_to(out + k, n, (weight * plan.free_inverse[k]) * force);
            };
            add(i, 1.0);
            add(t[0], b.second + b.third - 1.0);
            add(t[1], -b.second);
            add(t[2], -b.third);
        });
}

/// Add the differences of stretches between layers, as `add_stretch_difference` does for obstacles.
inline void add_layer_stretch_difference(const Plan& plan, const AnchoredState& a, const AnchoredState& b,
                                         double* out) {
    for_each_layer_spring(plan, a, b,
                          [&](Index i, const auto&, const LayerAnchor& first, const LayerAnchor& second,
                              const Vec3<double>& before, const Vec3<double>& stretch) {
                              const bool slide = first.bond == slides && second.bond == slides;
                              if (!slide) add_to(out + plan.particle_of_rank[i], plan.count, stretch - before);
                          });
}

ContactBounds predict_self_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                   const double* v) {
    SelfContact& self = *plan.self;
    SelfVerletList& neighbors = self.neighbors();
    const double d = plan.contacts.thickness;
    // A reduced thickness is below the full one.
    if (!is_surely_in_contact(plan, x) && self.stays_separated(x, v, d, duration)) {
        neighbors.clear();
        return {};
    }
    const Array<double> positions = quads_of(plan, x), velocities = quads_of(plan, v);
    MotionBound motion;
    motion.include(velocities.data(), nullptr, plan.count);
    // At most half the shortest edge, so that neighbours in a flat sheet don't count. The next call sees pairs further
    // away.
    const double margin = smaller(motion.diameter() * duration, 0.5 * self.surface.shortest);
    StiffnessBound bound;
    RowSums load;
    SurfaceLaw<double> law(d, plan.contacts.damping);
    std::vector<Scaling<double>> scalings;
    self_scalings(plan, t, scalings);
    law.reduce(&scalings);
    if (!neighbors.find(positions.data(), d, margin)) {
        const double infinite = std::numeric_limits<double>::infinity();
        return {infinite, infinite};
    }
    const Surface& s = self.surface;
    const Quads at{positions.data()}, velocity{velocities.data()};
    Contact<double> m;
    // Edges have half the thickness. Slower layers are stopped by their particles before that. Edges that touch
    // nevertheless, in a twist, are seen by the run itself.
    const double min_edge_speed = ContactLaw<double>::speed * root(0.5 * law.law(false).shape(0.5 * d) / expected);
    for_each_neighbor(
        neighbors, d,
        [&](Index i, const Index* begin, const Index* end, double) {
            law.particle(s, i, begin, end, at, velocity, m);
            bound.include(s, m);
            for_each_layer_bound(plan, SurfaceContact{law, m, at, velocity},
                                 [&](Index c, double k) { load.add(s, c, k); });
        },
        [&](const std::array<Index, 4>& c, double) {
            law.edges(s, {c[0], c[1]}, {c[2], c[3]}, at, velocity, m);
            bound.include(s, m);
        });
    bound.add_approaching<false>(s, neighbors.triangles, law, at.from, velocity.from, duration);
    bound.add_approaching<true>(s, neighbors.edges, law, at.from, velocity.from, duration, min_edge_speed);
    bound.flush();
    load.flush();
    const double frequency = plan.contacts.frequency;
    const double friction_omega2 = plan.has_self_friction() ? larger(load.max(), 2.0 * frequency * frequency) : 0.0;
    return bound.bounds(d, plan.contacts.damping, expected, friction_omega2, frequency);
}

ContactBounds predict_feature_contact(Plan& plan, double t, double duration, double expected, const double* x,
                                      const double* v) {
    FeatureContactModel& contact = *plan.features;
    const Contacts& contacts = plan.contacts;
    // Usually particles alone keep all obstacles out.
    if (!contact.has_any(contacts)) return {};
    SurfaceLaw<double> law = contact.law(contacts);
    const double infinite = std::numeric_limits<double>::infinity();
    const Array<double> positions = quads_of(plan, x), velocities = quads_of(plan, v);
    const Quads at{positions.data()}, velocity{velocities.data()};
    FeatureStiffnessBound bound(contact.mass);
    Contact<double> m;
    const BoundingBall cloth(x, plan.count);
    MotionBound cloth_motion;
    cloth_motion.include(velocities.data(), nullptr, plan.count);
    for (std::int64_t k = 0; k < contacts.count(); ++k) {
        FeatureVerletList& neighbors = contact.neighbors()[k];
        if (!contact.has(contacts, k)) continue;
        const Pose pose = contacts.obstacle_pose(k, t, duration);
        const FeaturesAt from{contact.obstacles[k], pose};
        bound.set_obstacle(contacts, k);
        law.set_obstacle(from.features.radius, contacts.feature_scaling(k, plan.count, t));
        MotionBound motion = cloth_motion;
        motion.include(pose.velocity);
        const double speed = motion.diameter() + root(norm2(pose.spin)) * from.features.reach;
        // The next call sees pairs further away.
        const double margin = smaller(speed * duration, 2.0 * contact.surface.shortest);
        const double distance =
            root(norm2(cloth.center - pose.position)) - cloth.radius - from.features.reach - from.features.radius;
        if (cloth.finite && distance > law.thickness(false) + margin) {
            neighbors.clear();
            continue;
        }
        if (!neighbors.find(contact.surface, positions.data(), from, law.thickness(false), margin))
            return {infinite, infinite};
        for_each_feature_contact<double>(
            contact.surface, neighbors, from, law, with_point_positions(from, at),
            with_point_velocities(from, velocity), m, [&](const auto& term) { bound.include(contact.surface, term); },
            &bound, duration);
    }
    bound.flush();
    if (bound.gap <= 0.0) return {infinite, infinite};
    return bound.bounds(law, expected);
}

}  // namespace cloth::contact
