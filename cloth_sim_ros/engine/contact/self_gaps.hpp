// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Gaps between particles and the surface in runs, evaluated in every step for a vector at a time. The law is that of
// self_law.hpp. No bit depends on the vector width or on candidates out of range: each lane is one number, and sums
// follow the order of the candidates.
#pragma once

#include "contact/broad_phase.hpp"
#include "contact/self_law.hpp"

namespace cloth::contact {

/// Corners of gaps: the particle, then the others. The particle replaces missing corners.
struct Corners {
    std::vector<Index> of[4];
    std::size_t size() const { return of[0].size(); }
    void clear() {
        for (auto& all : of) all.clear();
    }
    void add(Index a, Index b, Index c, Index e) {
        of[0].push_back(a), of[1].push_back(b), of[2].push_back(c), of[3].push_back(e);
    }
    std::array<Index, 4> at(std::size_t k) const { return {of[0][k], of[1][k], of[2][k], of[3][k]}; }
    void move(std::size_t from, std::size_t to) {
        for (auto& all : of) all[to] = all[from];
    }
    void shorten(std::size_t size) {
        for (auto& all : of) all.resize(size);
    }
};

/// Nearest point of a particle: weights of the other corners, vector from there, squared distance.
template <class V>
struct GapGeometry {
    V weight[3], square;
    Vec3<V> away;
};
/// To a triangle, an edge or a particle: 3, 2 or 1 corners.
template <int Size, class V>
CLOTH_INLINE GapGeometry<V> gap_geometry(const Vec3<V>* at) {
    const V zero{}, unit = splat<V>(1.0);
    if constexpr (Size == 3) {
        const OnTriangle<V> n = near_triangle(at[0], at[1], at[2], at[3]);
        return {{-n.weight[0], -n.weight[1], -n.weight[2]}, n.square, n.away};
    } else if constexpr (Size == 2) {
        const OnSegment<V> n = near_segment(at[0], at[1], at[2]);
        return {{n.fraction - unit, -n.fraction, zero}, n.square, n.away};
    } else {
        const Vec3<V> away = at[0] - at[1];
        return {{-unit, zero, zero}, norm2(away), away};
    }
}

class SelfGaps {
public:
    /// Set the candidates within a range [m] at positions x: triangles, and their edges and particles that count.
    void set_candidates(const Surface& s, const PairList& triangles, const double* x, double reach) {
        for (auto& all : candidates_) all.clear();
        edge_triangles_.clear();
        for (std::size_t first = 0, last; first < triangles.size(); first = last) {
            const Index i = triangles.first[first];
            for (last = first; last < triangles.size() && triangles.first[last] == i;) ++last;
            const Index *const listed = triangles.second.data(), *const begin = listed + first,
                               *const end = listed + last;
            for (const Index* triangle = begin; triangle != end; ++triangle) {
                const auto& t = s.triangles[*triangle];
                candidates_[0].add(i, t[0], t[1], t[2]);
                for (int j = 0; j < 3; ++j) {
                    // Edges between two triangles and inner particles, each by the first triangle that has it.
                    const Index neighbor = s.neighbors[*triangle][j];
                    if (neighbor >= 0 && (s.has(neighbor, i) || *triangle < neighbor)) {
                        const Index* const match = std::lower_bound(begin, end, neighbor);
                        EdgeTriangles b{{static_cast<Index>(triangle - listed), -1}, {(j + 2) % 3, 0}};
                        if (match != end && *match == neighbor) {
                            b.triangle[1] = static_cast<Index>(match - listed);
                            for (int k = 1; k < 3; ++k) {
                                const Index corner = s.triangles[neighbor][k];
                                if (corner != t[j] && corner != t[(j + 1) % 3]) b.opposite[1] = k;
                            }
                        }
                        edge_triangles_.push_back(b);
                        candidates_[1].add(i, t[j], t[(j + 1) % 3], i);
                    }
                    if (s.inner[t[j]] && s.first_about(t[j], i) == *triangle) candidates_[2].add(i, t[j], i, i);
                }
            }
        }
        measure<2>(1, x);
        std::size_t n_edges_left = 0;
        for (std::size_t k = 0; k < candidates_[1].size(); ++k) {
            if (!(geometry_[1][6][k] < reach * reach)) continue;
            edge_triangles_[n_edges_left] = edge_triangles_[k];
            candidates_[1].move(k, n_edges_left++);
        }
        candidates_[1].shorten(n_edges_left);
    }
    /// Find gaps below the thickness, and triangles within a range, which is at least that. If the nearest point of a
    /// triangle is on one of its edges, both have the same gap with opposite energies and forces: such pairs are
    /// omitted.
    void find(const double* x, double thickness, double reach) {
        const double max_square = thickness * thickness;
        measure<3>(0, x);
        measure<2>(1, x);
        measure<1>(2, x);
        square.assign(geometry_[0][6].begin(),
                      geometry_[0][6].begin() + static_cast<std::ptrdiff_t>(candidates_[0].size()));
        const std::size_t max_size =
            candidates_[0].size() + candidates_[1].size() + candidates_[2].size() + lanes<double>;
        if (law_[0].size() < max_size) {
            for (auto& all : corner) all.resize(max_size);
            for (auto* of : {weight, away})
                for (int j = 0; j < 3; ++j) of[j].resize(max_size);
            for (auto& all : law_) all.resize(max_size);
        }
        remaining_.clear();
        const auto& triangles = geometry_[0];
        cancelled_.assign(candidates_[0].size(), 0);
        each_below(geometry_[1][6].data(), candidates_[1].size(), max_square, [&](std::size_t k) {
            const EdgeTriangles& b = edge_triangles_[k];
            bool cancels = false;
            for (int half = 0; half < 2 && !cancels; ++half) {
                const Index t = b.triangle[half];
                cancels =
                    t >= 0 && !cancelled_[t] && triangles[6][t] < max_square && triangles[b.opposite[half]][t] == 0.0;
                if (cancels) cancelled_[t] = 1;
            }
            if (!cancels) remaining_.push_back(static_cast<Index>(k));
        });
        size = 0;
        each_below(triangles[6].data(), candidates_[0].size(), reach * reach, [&](std::size_t k) {
            if (!cancelled_[k]) add(0, k);
        });
        ends[0] = size;
        for (const Index k : remaining_) add(1, k);
        ends[1] = size;
        each_below(geometry_[2][6].data(), candidates_[2].size(), max_square, [&](std::size_t k) { add(2, k); });
    }
    /// Corners of an evaluated triangle, parallel to `square`.
    std::array<Index, 4> corners(std::size_t k) const { return candidates_[0].at(k); }
    double sign(std::size_t k) const { return k >= ends[0] && k < ends[1] ? -1.0 : 1.0; }
    double gap(std::size_t k) const { return law_[0][k]; }
    double closing(std::size_t k) const { return law_[1][k]; }
    double push(std::size_t k) const { return law_[2][k]; }
    double shape(std::size_t k) const { return law_[3][k]; }
    Vec3<double> normal(std::size_t k) const { return {away[0][k], away[1][k], away[2][k]}; }

    /// Evaluate the law: gaps, closing speeds, pushes without damping, b; `away` becomes the normal. If the law is
    /// reduced, gaps and speeds are in units of the full thickness, see Scaling.
    void evaluate(const ContactLaw<vec<double>>& law, const SelfLaw<double>& self_law, const double* v) {
        using V = vec<double>;
        for (std::size_t k = 0; k < size; k += lanes<double>) {
            Vec3<V> velocity[4];
            gather<4>(corner, k, size, v, velocity);
            V gap = root(load(law_[0].data() + k));
            const V over = splat<V>(1.0) / gap;
            Vec3<V> speed = velocity[0];
            for (int j = 0; j < 3; ++j) speed = fma(load(weight[j].data() + k), velocity[j + 1], speed);
            const Vec3<V> n{over * load(away[0].data() + k), over * load(away[1].data() + k),
                            over * load(away[2].data() + k)};
            store(away[0].data() + k, n.x), store(away[1].data() + k, n.y), store(away[2].data() + k, n.z);
            V closing = -dot(n, speed);
            if (self_law.reduced()) {
                Scaling<V> scaling = full_thickness<V>();
                for (int lane = 0; lane < lanes<double>; ++lane) {
                    const Scaling<double> lane_scaling = self_law.scaling(corner[0][std::min(k + lane, size - 1)]);
                    scaling.scale[lane] = lane_scaling.scale;
                    scaling.growth[lane] = lane_scaling.growth;
                }
                closing = scaling.closing(gap, closing);
                gap = scaling.gap(gap);
            }
            store(law_[0].data() + k, gap);
            store(law_[1].data() + k, closing);
            store(law_[2].data() + k, law.elastic(gap));
            store(law_[3].data() + k, law.shape(gap));
        }
    }

    /// Results: triangles, edges from ends[0] on, particles from ends[1] on; each by ascending particles.
    std::size_t size = 0, ends[2] = {};
    std::vector<Index> corner[4];
    std::vector<double> weight[3], away[3];
    /// Squared distances of all evaluated triangles [m^2].
    std::vector<double> square;

private:
    template <int Count>
    static CLOTH_INLINE void gather(const std::vector<Index>* corner, std::size_t k, std::size_t end, const double* x,
                                    Vec3<vec<double>>* at) {
        quad<double> rows[lanes<double>];
        for (int j = 0; j < Count; ++j) {
            for (int lane = 0; lane < lanes<double>; ++lane)
                rows[lane] = load4(x + 4 * static_cast<std::int64_t>(corner[j][std::min(k + lane, end - 1)]));
            deinterleave(rows, at[j].x, at[j].y, at[j].z);
        }
    }
    /// Weights, vectors and squared distances of all candidates of one kind.
    template <int Size>
    void measure(int kind, const double* x) {
        using V = vec<double>;
        const Corners& from = candidates_[kind];
        auto& geometry = geometry_[kind];
        if (geometry[6].size() < from.size() + lanes<double>)
            for (auto& all : geometry) all.resize(from.size() + lanes<double>);
        for (std::size_t k = 0; k < from.size(); k += lanes<double>) {
            Vec3<V> at[Size + 1];
            gather<Size + 1>(from.of, k, from.size(), x, at);
            const GapGeometry<V> n = gap_geometry<Size>(at);
            const V numbers[7] = {n.weight[0], n.weight[1], n.weight[2], n.away.x, n.away.y, n.away.z, n.square};
            for (int j = 0; j < 7; ++j) store(geometry[j].data() + k, numbers[j]);
        }
    }
    void add(int kind, std::size_t k) {
        const auto& geometry = geometry_[kind];
        for (int j = 0; j < 4; ++j) corner[j][size] = candidates_[kind].of[j][k];
        for (int j = 0; j < 3; ++j) weight[j][size] = geometry[j][k], away[j][size] = geometry[j + 3][k];
        law_[0][size++] = geometry[6][k];
    }

    /// Triangles on either side of a candidate edge, by index or -1; and their corners that are not on the edge.
    struct EdgeTriangles {
        Index triangle[2];
        int opposite[2];
    };
    Corners candidates_[3];
    std::vector<EdgeTriangles> edge_triangles_;
    std::vector<double> geometry_[3][7], law_[4];
    std::vector<Index> remaining_;
    std::vector<char> cancelled_;
};

/// Sums of the energies of particles (see Contact), and their forces.
class SelfSums {
public:
    /// Largest energy that a particle has to absorb, see energy_to_stop.
    double max_energy = 0.0;

    void begin(std::int64_t count, std::size_t gaps) {
        size_ = gaps_ = 0;
        index_.resize(count, 0);
        if (sum_of_.size() >= gaps + lanes<double>) return;
        for (auto* all : {&push_, &rate_, &shape_, &closing_, &scale_, &lever_}) all->resize(gaps + lanes<double>);
        particle_force_.resize(4 * (gaps + lanes<double>));
        particle_.resize(gaps + lanes<double>);
        sum_of_.resize(gaps + lanes<double>);
        which_.resize(gaps + lanes<double>);
    }
    /// Include a gap below the thickness.
    void include(std::size_t k, const SelfGaps& gaps) {
        const Index i = gaps.corner[0][k];
        auto index = static_cast<std::size_t>(index_[i]);
        if (index >= size_ || particle_[index] != i) {
            index = size_++;
            push_[index] = rate_[index] = shape_[index] = closing_[index] = lever_[index] = 0.0;
            particle_[index] = i;
            index_[i] = static_cast<Index>(index);
        }
        which_[gaps_] = static_cast<Index>(k);
        sum_of_[gaps_++] = static_cast<Index>(index);
        const double sign = gaps.sign(k), push = sign * gaps.push(k);
        push_[index] += push;
        rate_[index] = cloth::fma(push, gaps.closing(k), rate_[index]);
        lever_[index] = cloth::fma(push, gaps.gap(k), lever_[index]);
        shape_[index] = cloth::fma(sign, gaps.shape(k), shape_[index]);
        closing_[index] = larger(gaps.closing(k), closing_[index]);
    }
    /// Damping factors of the forces, dissipation, and growth power [W].
    void finalize(const Surface& s, const SelfLaw<double>& law, double* dissipation, double& growth_power) {
        using V = vec<double>;
        max_energy = 0.0;
        for (std::size_t k = 0; k < size_; k += lanes<double>) {
            const V push = load(push_.data() + k), rate = load(rate_.data() + k);
            const V damping_factor = select(push > V{}, law.damping_factor(push, rate, false), splat<V>(1.0));
            store(scale_.data() + k, damping_factor);
            double energies[lanes<double>];
            store(energies, energy_to_stop(load(closing_.data() + k), load(shape_.data() + k)));
            // Padding behind the last one does not count.
            for (std::size_t lane = 0; lane < std::min<std::size_t>(lanes<double>, size_ - k); ++lane)
                max_energy = larger(energies[lane], max_energy);
        }
        for (std::size_t k = 0; k < size_; ++k) {
            const double mass = 0.5 * s.masses[particle_[k]];
            const Scaling<double> scaling = law.scaling(particle_[k]);
            const double inverse_scale = 1.0 / scaling.scale;
            if (dissipation) *dissipation += mass * (scale_[k] - 1.0) * rate_[k] * (inverse_scale * inverse_scale);
            if (dissipation && law.reduced())
                growth_power += mass * scaling.growth * (inverse_scale * inverse_scale) *
                                SelfLaw<double>::growing(scale_[k] * lever_[k], shape_[k]);
            scale_[k] *= mass * inverse_scale;
        }
    }
    /// Add forces to quads f; the fourth number is the mass times the weights, see StiffnessBound.
    void add_forces(const Surface& s, const SelfGaps& gaps, double* f) {
        std::fill(particle_force_.begin(), particle_force_.begin() + 4 * static_cast<std::ptrdiff_t>(size_), 0.0);
        for (std::size_t at = 0; at < gaps_; ++at) {
            const std::size_t k = which_[at], index = sum_of_[at];
            const double sign = gaps.sign(k), force = scale_[index] * (sign * gaps.push(k));
            const Vec3<double> n = gaps.normal(k);
            const quad<double> force_and_mass{force * n.x, force * n.y, force * n.z, sign * s.masses[particle_[index]]};
            double* const particle_force = particle_force_.data() + 4 * index;
            store4(particle_force, quad<double>(load4(particle_force) + force_and_mass));
            const int corners = k < gaps.ends[0] ? 3 : k < gaps.ends[1] ? 2 : 1;
            for (int j = 0; j < corners; ++j) {
                double* const to = f + 4 * static_cast<std::int64_t>(gaps.corner[j + 1][k]);
                const double w = gaps.weight[j][k];
                store4(to, cloth::fma(quad<double>{w, w, w, absolute(w)}, force_and_mass, load4(to)));
            }
        }
        for (std::size_t k = 0; k < size_; ++k) {
            double* const to = f + 4 * static_cast<std::int64_t>(particle_[k]);
            store4(to, quad<double>(load4(to) + load4(particle_force_.data() + 4 * k)));
        }
    }

private:
    std::size_t size_ = 0, gaps_ = 0;
    std::vector<double> push_, rate_, shape_, closing_, scale_, lever_, particle_force_;
    std::vector<Index> particle_, index_, sum_of_, which_;
};

}  // namespace cloth::contact
