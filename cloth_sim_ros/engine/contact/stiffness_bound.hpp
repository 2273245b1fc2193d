// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Stiffness bounds of contact with the surface, for step control.
#pragma once

#include "contact/broad_phase.hpp"
#include "contact/obstacles.hpp"
#include "contact/surface_law.hpp"
#include "laws/friction.hpp"

namespace cloth::contact {

using laws::FrictionLaw, laws::stopping_gap;

/// Largest sum of stiffness over mass [1/s^2] at any particle.
class RowSums {
public:
    void add(const Surface& s, Index c, double stiffness) {
        if (!s.is_free[c]) return;
        if (sums_.empty()) sums_.assign(s.count, 0.0);
        if (sums_[c] == 0.0) particles_.push_back(c);
        sums_[c] += stiffness / s.masses[c];
    }
    /// Include another sum.
    void include(double sum) { max_ = larger(sum, max_); }
    /// Include the sums collected since the last call, and clear them.
    void flush() {
        for (const Index c : particles_) {
            include(sums_[c]);
            sums_[c] = 0.0;
        }
        particles_.clear();
    }
    double max() const { return max_; }

private:
    double max_ = 0.0;
    std::vector<double> sums_;
    std::vector<Index> particles_;
};

/// What contacts of one law make step control bound: the energy per mass that they absorb, in units of U^2/2, and row
/// sums of stiffness over mass relative to a single gap (Gershgorin).
struct ContactLoad {
    double energy = 0.0;
    RowSums rows;

    void include_energy(double more) { energy = larger(more, energy); }
    /// Add the bounds once the contacts have absorbed `expected` times their energy. `closing(b, shape)` is their largest
    /// closing speed [m/s] where the barrier has the energy `shape` of their energy b.
    template <class F>
    void add_to(ContactBounds& bounds, const ContactLaw<double>& law, double thickness, double expected,
                double min_row_sum, F&& closing) const {
        if (!(energy > 0.0)) return;
        const double row_sum = larger(rows.max(), min_row_sum), b = expected * energy;
        bounds.omega2 += row_sum * law.stiffness(stopping_gap(b) * thickness);
        bounds.damping += row_sum * law.damping_up_to(b, [&](double shape) { return closing(b, shape); });
    }
};

/// Stiffness bound of self-contact, of particles and of edges. A pair's stiffness k g g' is at most 2 k |g_c| at each
/// of its corners.
class StiffnessBound {
public:
    /// Least row sum relative to a single gap: two layers in contact push each other.
    static constexpr double min_row_sum = 2.0;
    double gap = 1e30;

    /// Include the contact of a particle or of a pair of edges.
    template <class V>
    void include(const Surface& s, const Contact<V>& m) {
        if (m.gaps.empty()) return;
        gap = smaller(m.min_gap(), gap);
        add_contact(m.edges, m.max_closing(), value_of(m.shape));
        for (const auto& g : m.gaps)
            for (int k = 0; k < 4; ++k) {
                if (!m.edges && k && g.corner[k] == g.corner[0]) continue;
                loads_[m.edges].rows.add(s, g.corner[k], 2.0 * g.sign * m.mass * absolute(value_of(g.weight[k])));
            }
    }
    /// Add a gap with a closing speed and a contact energy. One of the two masses may be at rest: then m w^2/2 is
    /// converted into half of m U^2/2 b.
    void add_contact(bool edges, double closing, double shape = 0.0) {
        include_energy(edges, energy_to_stop(closing, shape));
    }
    void include_energy(bool edges, double energy) { loads_[edges].include_energy(energy); }
    /// Include the row sums collected as the fourth number of each quad, times the inverse mass, and clear them.
    void gather_row_sums(const Surface& s, double* f) {
        // Four independent maxima, because each waits for the one before.
        double max[4] = {};
        const auto include = [&](std::int64_t i, double& to) {
            to = larger(f[4 * i + 3] * s.inverse[i], to);
            f[4 * i + 3] = 0.0;
        };
        std::int64_t i = 0;
        for (; i + 4 <= s.count; i += 4)
            for (int k = 0; k < 4; ++k) include(i + k, max[k]);
        for (; i < s.count; ++i) include(i, max[0]);
        for (const double lane_max : max) loads_[0].rows.include(lane_max);
    }
    /// Add the pairs of a list that come into contact within a duration [s], because the step has to be short enough for
    /// their closing speeds before that. Slower ones than `min_speed` [m/s] are ignored. Positions and velocities are
    /// quads.
    template <bool Edges>
    void add_approaching(const Surface& s, const PairList& pairs, const SurfaceLaw<double>& law, const double* x,
                         const double* velocities, double duration, double min_speed = 0.0) {
        using V = vec<double>;
        V max{};
        for (std::size_t k = 0; k < pairs.size(); k += lanes<double>) {
            Vec3<V> at[4], v[4], offset, relative_velocity;
            gather_pairs<Edges>(s, pairs, k, x, at);
            gather_pairs<Edges>(s, pairs, k, velocities, v);
            if constexpr (Edges) {
                const auto n = near_segments(at[0], at[1], at[2], at[3]);
                offset = n.away;
                relative_velocity = v[0] + n.first * (v[1] - v[0]) - v[2] - n.second * (v[3] - v[2]);
            } else {
                const auto n = near_triangle(at[0], at[1], at[2], at[3]);
                offset = n.away;
                relative_velocity = v[0] - n.weight[0] * v[1] - n.weight[1] * v[2] - n.weight[2] * v[3];
            }
            const Scaling<V> scaling = law.lane_scaling([&](int lane) {
                const auto c = pair_corners<Edges>(s, pairs, std::min(k + lane, pairs.size() - 1));
                return Edges ? law.scaling({c[0], c[1]}, {c[2], c[3]}) : law.scaling(c[0]);
            });
            const V distance = root(norm2(offset)),
                    closing = scaling.closing(distance, -dot(offset, relative_velocity) / distance),
                    remaining = scaling.gap(distance) - splat<V>(law.thickness(Edges));
            const auto approaches =
                (remaining >= V{}) & (remaining < splat<V>(duration) * closing) & (closing >= splat<V>(min_speed));
            max = larger(select(approaches, closing, V{}), max);
        }
        for (int lane = 0; lane < lanes<double>; ++lane) add_contact(Edges, max[lane]);
    }
    /// Include the row sums collected since the last call, and clear them.
    void flush() {
        for (ContactLoad& load : loads_) load.rows.flush();
    }
    /// `friction_omega2` [1/s^2]: squared frequency of the anchor springs, which act at every contact.
    ContactBounds bounds(double thickness, double damping, double expected = 1.0, double friction_omega2 = 0.0,
                         double frequency = 1.0) const {
        ContactBounds r;
        if (loads_[0].energy > 0.0) {
            r.omega2 += friction_omega2;
            r.damping += FrictionLaw<double>::damping_per_frequency / frequency * friction_omega2;
        }
        for (int edges = 0; edges < 2; ++edges) {
            const double d = edges ? 0.5 * thickness : thickness;
            // See `energy_to_stop`.
            loads_[edges].add_to(
                r, ContactLaw<double>(d, damping), d, expected, min_row_sum,
                [](double b, double shape) { return ContactLaw<double>::speed * root(0.5 * larger(b - shape, 0.0)); });
        }
        return r;
    }

private:
    ContactLoad loads_[2];  ///< of particles and of edges
};

/// Stiffness bound of contact with features. A gap's stiffness k g g' is at most k |w_c| at a corner of weight w_c,
/// because the weights add up to one and an obstacle does not yield. Jaws yield: there it is at most 2 k |w_c|, and 2 k
/// at the jaws.
class FeatureStiffnessBound {
public:
    explicit FeatureStiffnessBound(double mass) : mass_(mass) {}
    double gap = 1e30;

    /// Set the obstacle of the contacts that follow.
    void set_obstacle(const Contacts& contacts, std::int64_t obstacle) {
        const ParallelJaw* const jaw = contacts.jaw_of(obstacle);
        jaw_ = jaw ? contacts.obstacles[obstacle].parallel_jaw : -1;
        inverse_jaw_mass_ = jaw ? 1.0 / jaw->mass : 0.0;
        mobility_ = jaw ? 2.0 : 1.0;
        if (jaw_loads_.size() < contacts.parallel_jaws.size()) jaw_loads_.resize(contacts.parallel_jaws.size(), 0.0);
    }
    void include(const Surface& s, const Contact<double>& m) {
        gap = smaller(m.min_gap(), gap);
        for (const auto& g : m.gaps) {
            Index corner[3];
            double weight[3];
            int corners = 0;
            for (int k = 0; k < 4; ++k) {
                if (g.corner[k] < 0) continue;
                corner[corners] = g.corner[k];
                weight[corners++] = absolute(g.weight[k]);
            }
            add_contact(s, corners, corner, weight, g.closing, m.shape);
            for (int k = 0; k < corners; ++k) load_.rows.add(s, corner[k], mobility_ * g.sign * mass_ * weight[k]);
            if (jaw_ >= 0) jaw_loads_[jaw_] += mobility_ * g.sign * mass_ * inverse_jaw_mass_;
        }
    }
    /// Add a gap with a closing speed and a contact energy: m_e w^2/2 of all its corners is converted into M U^2/2 b,
    /// where 1/m_e is the sum of w_c^2 / m_c and the inverse mass of the jaws.
    void add_contact(const Surface& s, int corners, const Index* corner, const double* weight, double closing,
                     double shape) {
        const double speed = larger(closing, 0.0) / ContactLaw<double>::speed;
        double inverse = inverse_jaw_mass_;
        load_.rows.include(mobility_ * mass_ * inverse_jaw_mass_);
        for (int k = 0; k < corners; ++k) {
            inverse += weight[k] * weight[k] / s.masses[corner[k]];
            load_.rows.include(mobility_ * mass_ * weight[k] / s.masses[corner[k]]);
        }
        load_.include_energy(shape + speed * speed / (mass_ * inverse));
        max_closing_ = larger(closing, max_closing_);
    }
    /// Add a gap that comes into contact within a duration [s], because the step has to be short enough before that.
    /// `distance` [m] is left until then.
    void add_approaching(const Surface& s, int corners, const Index* corner, const double* weight, double distance,
                         double closing, double duration) {
        if (distance >= 0.0 && distance < duration * closing) add_contact(s, corners, corner, weight, closing, 0.0);
    }
    /// Include the row sums collected since the last call, and clear them.
    void flush() {
        load_.rows.flush();
        for (double& load : jaw_loads_) {
            load_.rows.include(load);
            load = 0.0;
        }
    }
    ContactBounds bounds(const SurfaceLaw<double>& law, double expected = 1.0) const {
        ContactBounds r;
        load_.add_to(r, law.law(false), law.thickness(false), expected, 1.0,
                     [&](double, double) { return expected * max_closing_; });
        return r;
    }

private:
    double mass_, inverse_jaw_mass_ = 0.0, mobility_ = 1.0;
    double max_closing_ = 0.0;  ///< [m/s]
    std::int64_t jaw_ = -1;     ///< index of the present obstacle's gripper, or -1
    ContactLoad load_;
    std::vector<double> jaw_loads_;
};

}  // namespace cloth::contact
