// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// The gaps between particles and the surface about them, as runs meet them: in every step, so a vector of them at a time.
// The law is that of self_law.hpp. No bit depends on the width of vectors, nor on which candidates there are beyond those
// within reach: lanes do what a single number would do, and sums are taken in the order of the candidates.
#pragma once

#include "self_law.hpp"
#include "self_pairs.hpp"

namespace cloth {

/// Corners of gaps: the particle, then those of what it meets. What has fewer has the particle in their place.
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

/// Where a particle is nearest to what it meets: weights of the further corners, the way from there, its square.
template <class V>
struct NearGap {
    V weight[3], square;
    Vec3<V> away;
};
/// To a triangle, an edge or a particle: of 3, 2 or 1 corners.
template <int Size, class V>
CLOTH_INLINE NearGap<V> near_gap(const Vec3<V>* at) {
    const V zero{}, one = splat<V>(1.0);
    if constexpr (Size == 3) {
        const OnTriangle<V> n = near_triangle(at[0], at[1], at[2], at[3]);
        return {{-n.weight[0], -n.weight[1], -n.weight[2]}, n.square, n.away};
    } else if constexpr (Size == 2) {
        const OnSegment<V> n = near_segment(at[0], at[1], at[2]);
        return {{n.share - one, -n.share, zero}, n.square, n.away};
    } else {
        const Vec3<V> away = at[0] - at[1];
        return {{-one, zero, zero}, norm2(away), away};
    }
}

class SelfGaps {
public:
    /// What particles may meet within a reach [m] at positions x: triangles, and what of them counts beside them.
    void offer(const Surface& s, const PairList& triangles, const double* x, double reach) {
        for (auto& all : offered_) all.clear();
        beside_.clear();
        for (std::size_t first = 0, last; first < triangles.size(); first = last) {
            const Index i = triangles.first[first];
            for (last = first; last < triangles.size() && triangles.first[last] == i;) ++last;
            const Index *const own = triangles.second.data(), *const begin = own + first, *const end = own + last;
            for (const Index* triangle = begin; triangle != end; ++triangle) {
                const auto& t = s.triangles[*triangle];
                offered_[0].add(i, t[0], t[1], t[2]);
                for (int j = 0; j < 3; ++j) {
                    // An edge between two triangles and a particle within the sheet, by the first one that has it.
                    const Index other = s.across[*triangle][j];
                    if (other >= 0 && (s.has(other, i) || *triangle < other)) {
                        const Index* const there = std::lower_bound(begin, end, other);
                        Beside b{{static_cast<Index>(triangle - own), -1}, {(j + 2) % 3, 0}};
                        if (there != end && *there == other) {
                            b.triangle[1] = static_cast<Index>(there - own);
                            for (int k = 1; k < 3; ++k) {
                                const Index corner = s.triangles[other][k];
                                if (corner != t[j] && corner != t[(j + 1) % 3]) b.opposite[1] = k;
                            }
                        }
                        beside_.push_back(b);
                        offered_[1].add(i, t[j], t[(j + 1) % 3], i);
                    }
                    if (s.inner[t[j]] && s.first_about(t[j], i) == *triangle) offered_[2].add(i, t[j], i, i);
                }
            }
        }
        measure<2>(1, x);
        std::size_t kept = 0;
        for (std::size_t k = 0; k < offered_[1].size(); ++k) {
            if (!(seen_[1][6][k] < reach * reach)) continue;
            beside_[kept] = beside_[k];
            offered_[1].move(k, kept++);
        }
        offered_[1].shorten(kept);
    }
    /// Find what is nearer than the thickness, and triangles that are nearer than a reach, which is at least that. Where a
    /// triangle is nearest on one of its edges both have the same gap, and their energies and forces are equal and
    /// opposite: such pairs are left out.
    void find(const double* x, double thickness, double reach) {
        const double below = thickness * thickness;
        measure<3>(0, x);
        measure<2>(1, x);
        measure<1>(2, x);
        square.assign(seen_[0][6].begin(), seen_[0][6].begin() + static_cast<std::ptrdiff_t>(offered_[0].size()));
        const std::size_t most = offered_[0].size() + offered_[1].size() + offered_[2].size() + lanes<double>;
        if (law_[0].size() < most) {
            for (auto& all : corner) all.resize(most);
            for (auto* of : {weight, away})
                for (int j = 0; j < 3; ++j) of[j].resize(most);
            for (auto& all : law_) all.resize(most);
        }
        left_.clear();
        const auto& triangles = seen_[0];
        gone_.assign(offered_[0].size(), 0);
        each_below(seen_[1][6].data(), offered_[1].size(), below, [&](std::size_t k) {
            const Beside& b = beside_[k];
            bool cancels = false;
            for (int side = 0; side < 2 && !cancels; ++side) {
                const Index t = b.triangle[side];
                cancels = t >= 0 && !gone_[t] && triangles[6][t] < below && triangles[b.opposite[side]][t] == 0.0;
                if (cancels) gone_[t] = 1;
            }
            if (!cancels) left_.push_back(static_cast<Index>(k));
        });
        size = 0;
        each_below(triangles[6].data(), offered_[0].size(), reach * reach, [&](std::size_t k) {
            if (!gone_[k]) add(0, k);
        });
        ends[0] = size;
        for (const Index k : left_) add(1, k);
        ends[1] = size;
        each_below(seen_[2][6].data(), offered_[2].size(), below, [&](std::size_t k) { add(2, k); });
    }
    /// The triangles that were looked at, beside `square`.
    std::array<Index, 4> corners(std::size_t k) const { return offered_[0].at(k); }
    double sign(std::size_t k) const { return k >= ends[0] && k < ends[1] ? -1.0 : 1.0; }
    double gap(std::size_t k) const { return law_[0][k]; }
    double closing(std::size_t k) const { return law_[1][k]; }
    double push(std::size_t k) const { return law_[2][k]; }
    double shape(std::size_t k) const { return law_[3][k]; }
    Vec3<double> normal(std::size_t k) const { return {away[0][k], away[1][k], away[2][k]}; }

    /// Evaluate the law at what was found: gaps, the speeds with which they close, pushes per mass without damping, b, and
    /// `away` becomes its direction.
    /// Where the law of the surface is reduced, gaps and speeds are in units of the whole thickness, see Scaling.
    void evaluate(const ContactLaw<vec<double>>& law, const SelfLaw<double>& own, const double* v) {
        using V = vec<double>;
        for (std::size_t k = 0; k < size; k += lanes<double>) {
            Vec3<V> moving[4];
            gather<4>(corner, k, size, v, moving);
            V gap = root(load(law_[0].data() + k));
            const V over = splat<V>(1.0) / gap;
            Vec3<V> speed = moving[0];
            for (int j = 0; j < 3; ++j) speed = fma(load(weight[j].data() + k), moving[j + 1], speed);
            const Vec3<V> n{over * load(away[0].data() + k), over * load(away[1].data() + k), over * load(away[2].data() + k)};
            store(away[0].data() + k, n.x), store(away[1].data() + k, n.y), store(away[2].data() + k, n.z);
            V closing = -dot(n, speed);
            if (own.reduced()) {
                Scaling<V> scaling = whole_thickness<V>();
                for (int lane = 0; lane < lanes<double>; ++lane) {
                    const Scaling<double> one = own.scaling(corner[0][std::min(k + lane, size - 1)]);
                    scaling.scale[lane] = one.scale;
                    scaling.growth[lane] = one.growth;
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

    /// What was found: triangles, edges from ends[0] on, particles from ends[1] on; each by ascending particles.
    std::size_t size = 0, ends[2] = {};
    std::vector<Index> corner[4];
    std::vector<double> weight[3], away[3];
    /// Squared distances of all triangles that were looked at [m^2].
    std::vector<double> square;

private:
    template <int Count>
    static CLOTH_INLINE void gather(const std::vector<Index>* corner, std::size_t k, std::size_t end, const double* x,
                                    Vec3<vec<double>>* at) {
        quad<double> rows[lanes<double>];
        for (int j = 0; j < Count; ++j) {
            for (int lane = 0; lane < lanes<double>; ++lane)
                rows[lane] = load4(x + 4 * static_cast<std::int64_t>(corner[j][std::min(k + lane, end - 1)]));
            apart(rows, at[j].x, at[j].y, at[j].z);
        }
    }
    /// Weights, ways across and squared distances of all that are offered of one kind.
    template <int Size>
    void measure(int kind, const double* x) {
        using V = vec<double>;
        const Corners& from = offered_[kind];
        auto& seen = seen_[kind];
        if (seen[6].size() < from.size() + lanes<double>)
            for (auto& all : seen) all.resize(from.size() + lanes<double>);
        for (std::size_t k = 0; k < from.size(); k += lanes<double>) {
            Vec3<V> at[Size + 1];
            gather<Size + 1>(from.of, k, from.size(), x, at);
            const NearGap<V> n = near_gap<Size>(at);
            const V numbers[7] = {n.weight[0], n.weight[1], n.weight[2], n.away.x, n.away.y, n.away.z, n.square};
            for (int j = 0; j < 7; ++j) store(seen[j].data() + k, numbers[j]);
        }
    }
    void add(int kind, std::size_t k) {
        const auto& seen = seen_[kind];
        for (int j = 0; j < 4; ++j) corner[j][size] = offered_[kind].of[j][k];
        for (int j = 0; j < 3; ++j) weight[j][size] = seen[j][k], away[j][size] = seen[j + 3][k];
        law_[0][size++] = seen[6][k];
    }

    /// The triangles on either side of an edge that is offered, by their place, -1 where it is not; and which of their
    /// corners is not on the edge.
    struct Beside {
        Index triangle[2];
        int opposite[2];
    };
    Corners offered_[3];
    std::vector<Beside> beside_;
    std::vector<double> seen_[3][7], law_[4];
    std::vector<Index> left_;
    std::vector<char> gone_;
};

/// What adds to the energies of particles, by the particle (see Meeting), and the forces of that.
class SelfSums {
public:
    /// The largest energy that one has to take up, see energy_to_stop.
    double most = 0.0;

    void begin(std::int64_t count, std::size_t gaps) {
        size_ = gaps_ = 0;
        place_.resize(count, 0);
        if (of_.size() >= gaps + lanes<double>) return;
        for (auto* all : {&push_, &rate_, &shape_, &closing_, &scale_, &lever_}) all->resize(gaps + lanes<double>);
        own_.resize(4 * (gaps + lanes<double>));
        particle_.resize(gaps + lanes<double>);
        of_.resize(gaps + lanes<double>);
        which_.resize(gaps + lanes<double>);
    }
    /// Take in a gap below the thickness.
    void take(std::size_t k, const SelfGaps& gaps) {
        const Index i = gaps.corner[0][k];
        auto place = static_cast<std::size_t>(place_[i]);
        if (place >= size_ || particle_[place] != i) {
            place = size_++;
            push_[place] = rate_[place] = shape_[place] = closing_[place] = lever_[place] = 0.0;
            particle_[place] = i;
            place_[i] = static_cast<Index>(place);
        }
        which_[gaps_] = static_cast<Index>(k);
        of_[gaps_++] = static_cast<Index>(place);
        const double sign = gaps.sign(k), push = sign * gaps.push(k);
        push_[place] += push;
        rate_[place] = cloth::fma(push, gaps.closing(k), rate_[place]);
        lever_[place] = cloth::fma(push, gaps.gap(k), lever_[place]);
        shape_[place] = cloth::fma(sign, gaps.shape(k), shape_[place]);
        closing_[place] = larger(gaps.closing(k), closing_[place]);
    }
    /// What damping multiplies forces by, what it takes, and what growth gives [W].
    void close(const Surface& s, const SelfLaw<double>& law, double* lost, double& grown) {
        using V = vec<double>;
        most = 0.0;
        for (std::size_t k = 0; k < size_; k += lanes<double>) {
            const V push = load(push_.data() + k), rate = load(rate_.data() + k);
            const V damped = select(push > V{}, law.quotient(push, rate, false), splat<V>(1.0));
            store(scale_.data() + k, damped);
            double energies[lanes<double>];
            store(energies, energy_to_stop(load(closing_.data() + k), load(shape_.data() + k)));
            // What is left behind the last one does not count.
            for (std::size_t lane = 0; lane < std::min<std::size_t>(lanes<double>, size_ - k); ++lane)
                most = larger(energies[lane], most);
        }
        for (std::size_t k = 0; k < size_; ++k) {
            const double mass = 0.5 * s.masses[particle_[k]];
            const Scaling<double> scaling = law.scaling(particle_[k]);
            const double part = 1.0 / scaling.scale;
            if (lost) *lost += mass * (scale_[k] - 1.0) * rate_[k] * (part * part);
            if (lost && law.reduced())
                grown += mass * scaling.growth * (part * part) *
                         SelfLaw<double>::growing(scale_[k] * lever_[k], shape_[k]);
            scale_[k] *= mass * part;
        }
    }
    /// Add forces to quads f; and as their fourth number the mass of what pushes times its weights, see Demand.
    void push(const Surface& s, const SelfGaps& gaps, double* f) {
        std::fill(own_.begin(), own_.begin() + 4 * static_cast<std::ptrdiff_t>(size_), 0.0);
        for (std::size_t at = 0; at < gaps_; ++at) {
            const std::size_t k = which_[at], place = of_[at];
            const double sign = gaps.sign(k), force = scale_[place] * (sign * gaps.push(k));
            const Vec3<double> n = gaps.normal(k);
            const quad<double> all{force * n.x, force * n.y, force * n.z, sign * s.masses[particle_[place]]};
            double* const own = own_.data() + 4 * place;
            store4(own, quad<double>(load4(own) + all));
            const int corners = k < gaps.ends[0] ? 3 : k < gaps.ends[1] ? 2 : 1;
            for (int j = 0; j < corners; ++j) {
                double* const to = f + 4 * static_cast<std::int64_t>(gaps.corner[j + 1][k]);
                const double w = gaps.weight[j][k];
                store4(to, cloth::fma(quad<double>{w, w, w, absolute(w)}, all, load4(to)));
            }
        }
        for (std::size_t k = 0; k < size_; ++k) {
            double* const to = f + 4 * static_cast<std::int64_t>(particle_[k]);
            store4(to, quad<double>(load4(to) + load4(own_.data() + 4 * k)));
        }
    }

private:
    std::size_t size_ = 0, gaps_ = 0;
    std::vector<double> push_, rate_, shape_, closing_, scale_, lever_, own_;
    std::vector<Index> particle_, place_, of_, which_;
};

}  // namespace cloth
