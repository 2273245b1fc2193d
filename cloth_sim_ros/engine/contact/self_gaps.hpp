// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Gaps between particles and the surface in runs, evaluated in every step for a vector at a time. The law is that of
// surface_law.hpp. No bit depends on the vector width or on candidates out of range: each lane is one number, and sums
// follow the order of the candidates.
#pragma once

#include <bit>
#include <cstring>

#include "contact/broad_phase.hpp"
#include "contact/surface_law.hpp"

namespace cloth::contact {

class SelfGaps {
public:
    /// Index of the first number of a particle's quad; such of the corners of a gap: the particle, then as many as there
    /// are weights. The particle replaces missing ones.
    using Offset = std::uint32_t;
    using Corners = std::array<Offset, 4>;

    /// Set the candidates: particles and triangles, and the edges and corners of these.
    void set_candidates(const Surface& s, const PairList& triangles) {
        const Index* const listed = triangles.second.data();
        n_candidates_ = static_cast<Index>(triangles.size());
        const std::size_t padded = triangles.size() + lanes<double>;
        candidates_.resize(padded), opposite_.resize(padded), parts_.assign(padded, 0);
        blocks_.clear();
        place_.resize(s.triangles.size());
        about_.assign(s.count, -1);
        capacity_ = padded;
        Index begin = 0, longest = 0;
        for (Index first = 0, last; first < n_candidates_; first = last) {
            const Index i = triangles.first[first];
            for (last = first; last < n_candidates_ && triangles.first[last] == i; ++last) place_[listed[last]] = last;
            for (Index k = s.start[i]; k < s.start[i + 1]; ++k)
                for (const Index corner : s.triangles[s.fan[k]]) about_[corner] = i;
            for (Index k = first; k < last; ++k) {
                const Index triangle = listed[k];
                const auto& t = s.triangles[triangle];
                // Edges between two triangles and inner particles, each by the first triangle without i that has it.
                unsigned parts = s.owned[triangle];
                if (s.has_joints || about_[t[0]] == i || about_[t[1]] == i || about_[t[2]] == i)
                    for (int j = 0; j < 3; ++j) {
                        const Index neighbor = s.neighbors[triangle][j];
                        if (neighbor >= 0 && s.has(neighbor, i)) parts |= 1u << j;
                        if (s.inner[t[j]] && s.first_about(t[j], i) == triangle) parts |= 8u << j;
                    }
                for (int j = 0; j < 3; ++j) {
                    const Index neighbor = s.neighbors[triangle][j], place = neighbor < 0 ? -1 : place_[neighbor];
                    const bool is_listed = place >= first && place < last && listed[place] == neighbor;
                    opposite_[k][j] =
                        8 * static_cast<Offset>(is_listed ? place : n_candidates_) + s.opposite[triangle][j];
                }
                candidates_[k] = {offset(i), offset(t[0]), offset(t[1]), offset(t[2])};
                parts_[k] = static_cast<unsigned char>(parts);
                capacity_ += static_cast<std::size_t>(std::popcount(parts));
            }
            if (last - begin < block_size && last < n_candidates_) continue;
            blocks_.push_back(last);
            longest = std::max(longest, last - begin);
            begin = last;
        }
        if (n_candidates_)
            std::fill(candidates_.end() - lanes<double>, candidates_.end(), candidates_[n_candidates_ - 1]);
        for (auto& numbers : geometry_) numbers.resize(longest + lanes<double>);
        edges_.resize(3 * longest);
    }
    /// Find gaps below the thickness, and triangles within a range, which is at least that. If the nearest point of a
    /// triangle is on one of its edges, both have the same gap with opposite energies and forces: such pairs are
    /// omitted.
    void find(const double* x, double thickness, double reach) {
        const double max_square = thickness * thickness;
        square.resize(candidates_.size());
        state_.resize(n_candidates_ + lanes<double> + 1);
        state_[n_candidates_] = 0;
        if (gap_.size() < capacity_) {
            corner_.resize(capacity_), terms_.resize(4 * capacity_), normals_.resize(4 * capacity_);
            for (auto* of : {weight_, away_})
                for (int j = 0; j < 3; ++j) of[j].resize(capacity_);
            // Last, because its size tells that all have theirs.
            gap_.resize(capacity_);
        }
        points_.clear(), remaining_.resize(capacity_);
        std::size_t n_remaining = 0;
        vec<double> least = splat<vec<double>>(1e30);
        size = 0;
        Index begin = 0;
        for (const Index end : blocks_) {
            const Offset* const last_edge = measure_triangles(begin, end, x, max_square, reach * reach, least);
            for (const Offset* edge = edges_.data(); edge < last_edge; ++edge) {
                remaining_[n_remaining] = *edge;
                n_remaining += cancel(*edge) ? 0 : 1;
            }
            add_triangles(begin, end);
            begin = end;
        }
        min_square = 1e30;
        for (int lane = 0; lane < lanes<double>; ++lane) min_square = smaller<double>(least[lane], min_square);
        ends[0] = size;
        remaining_.resize(n_remaining);
        for (const Offset edge : remaining_) {
            const Corners& c = candidates_[edge / 8];
            corner_[size++] = {c[0], c[1 + edge % 8], c[1 + (edge % 8 + 1) % 3], c[0]};
        }
        ends[1] = size;
        for (const Offset point : points_) {
            const Corners& c = candidates_[point / 8];
            corner_[size++] = {c[0], c[1 + point % 8], c[0], c[0]};
        }
        for (int lane = 0; lane < lanes<double> && size; ++lane) corner_[size + lane] = corner_[size - 1];
        measure<2>(ends[0], ends[1], x);
        measure<1>(ends[1], size, x);
    }
    /// Evaluate the law: pushes without damping, closing speeds, gaps, b; and normals. If the law is reduced, gaps and
    /// speeds are in units of the full thickness, see Scaling.
    void evaluate(const ContactLaw<vec<double>>& law, const SurfaceLaw<double>& surface_law, const double* v) {
        using V = vec<double>;
        const V unit = splat<V>(1.0);
        for (std::size_t k = 0; k < size; k += lanes<double>) {
            Vec3<V> velocity[4];
            gather<4>(corner_.data() + k, v, velocity);
            V gap = root(load(gap_.data() + k));
            const V over = unit / gap;
            Vec3<V> speed = velocity[0];
            for (int j = 0; j < 3; ++j) speed = fma(load(weight_[j].data() + k), velocity[j + 1], speed);
            const Vec3<V> n{over * load(away_[0].data() + k), over * load(away_[1].data() + k),
                            over * load(away_[2].data() + k)};
            V closing = -dot(n, speed);
            if (surface_law.reduced()) {
                const Scaling<V> scaling =
                    surface_law.lane_scaling([&](int lane) { return surface_law.scaling(corner_[k + lane][0] / 4); });
                closing = scaling.closing(gap, closing);
                gap = scaling.gap(gap);
            }
            const auto store_rows = [&](std::vector<double>& to, V a, V b, V c, V d) CLOTH_INLINED {
                quad<double> rows[lanes<double>];
                interleave(a, b, c, rows, d);
                for (int lane = 0; lane < lanes<double>; ++lane) store4(to.data() + 4 * (k + lane), rows[lane]);
            };
            store_rows(terms_, law.elastic(gap), closing, gap, law.shape(gap));
            store_rows(normals_, n.x, n.y, n.z, unit);
        }
    }

    /// Number of gaps: triangles, edges from ends[0] on, particles from ends[1] on; each by ascending particles.
    std::size_t size = 0, ends[2] = {};
    const Corners& corners(std::size_t k) const { return corner_[k]; }
    const double* weights(int j) const { return weight_[j].data(); }
    double sign(std::size_t k) const { return k >= ends[0] && k < ends[1] ? -1.0 : 1.0; }
    /// Push, closing speed, gap and b of gap k; its normal, and 1.
    const double* terms(std::size_t k) const { return terms_.data() + 4 * k; }
    const double* normal(std::size_t k) const { return normals_.data() + 4 * k; }
    /// Squared distances of all candidate triangles [m^2], with padding at the end, their minimum, at most 1e30, and
    /// their corners.
    std::vector<double> square;
    double min_square = 1e30;
    std::array<Index, 4> candidate(std::size_t k) const {
        std::array<Index, 4> corners;
        for (int j = 0; j < 4; ++j) corners[j] = static_cast<Index>(candidates_[k][j] / 4);
        return corners;
    }

private:
    /// Bit of a candidate's state: within range. Below it, bit j: within the thickness, and the nearest point is on the
    /// edge opposite to corner j.
    static constexpr unsigned in_range = 8;
    /// Candidates that are evaluated at a time, so that their numbers stay in the cache.
    static constexpr Index block_size = 256;

    static Offset offset(Index i) { return 4 * static_cast<Offset>(i); }
    template <int Count>
    static CLOTH_INLINE void gather(const Corners* corner, const double* x, Vec3<vec<double>>* at) {
        quad<double> rows[lanes<double>];
        for (int j = 0; j < Count; ++j) {
            for (int lane = 0; lane < lanes<double>; ++lane) rows[lane] = load4(x + corner[lane][j]);
            deinterleave(rows, at[j].x, at[j].y, at[j].z);
        }
    }
    /// A byte of each lane.
    static std::uint64_t load_bytes(const unsigned char* from) {
        std::uint64_t bytes = 0;
        std::memcpy(&bytes, from, lanes<double>);
        return bytes;
    }
    static void store_bytes(unsigned char* to, std::uint64_t bytes) { std::memcpy(to, &bytes, lanes<double>); }
    template <class M>
    static CLOTH_INLINE std::uint64_t bytes_of(M numbers) {
        typedef unsigned char Bytes __attribute__((vector_size(lanes<double>)));
        const Bytes bytes = __builtin_convertvector(numbers, Bytes);
        std::uint64_t to = 0;
        std::memcpy(&to, &bytes, lanes<double>);
        return to;
    }
    static unsigned join_bits(std::uint64_t bytes) {
        return static_cast<unsigned>((bytes & 0x0101010101010101) * 0x0102040810204080 >> 56);
    }
    /// Measure a block of candidates: numbers, states, and edges and points within the thickness.
    Offset* measure_triangles(Index begin, Index end, const double* x, double max_square, double range_square,
                              vec<double>& least) {
        using V = vec<double>;
        using M = decltype(V{} < V{});
        Offset* edge = edges_.data();
        for (Index k = begin; k < end; k += lanes<double>) {
            Vec3<V> at[4];
            gather<4>(candidates_.data() + k, x, at);
            PartSquares<V> parts;
            const OnTriangle<V> n = near_triangle(at[0], at[1], at[2], at[3], &parts);
            least = smaller(n.square, least);
            store(square.data() + k, n.square);
            const V numbers[7] = {-n.weight[0], -n.weight[1], -n.weight[2], n.away.x, n.away.y, n.away.z, n.square};
            for (int j = 0; j < 7; ++j) store(geometry_[j].data() + (k - begin), numbers[j]);
            const M inside = n.square < splat<V>(max_square);
            M state = (n.square < splat<V>(range_square)) & (M{} + in_range), active{};
            for (int j = 0; j < 3; ++j) {
                state |= (n.weight[j] == V{}) & inside & (M{} + (1 << j));
                active |= (parts.edge[j] < splat<V>(max_square)) & (M{} + (1 << j));
                active |= (parts.corner[j] < splat<V>(max_square)) & (M{} + (8 << j));
            }
            const std::uint64_t last_lanes = ~std::uint64_t{0} >> (64 - 8 * std::min(end - k, Index{lanes<double>}));
            store_bytes(state_.data() + k, bytes_of(state) & last_lanes);
            const std::uint64_t parts_within = bytes_of(active) & load_bytes(parts_.data() + k) & last_lanes;
            for (std::uint64_t bits = parts_within & 0x0707070707070707; bits; bits &= bits - 1)
                *edge++ = 8 * static_cast<Offset>(k) + std::countr_zero(bits);
            for (std::uint64_t bits = parts_within & 0x3838383838383838; bits; bits &= bits - 1)
                points_.push_back(8 * static_cast<Offset>(k) + std::countr_zero(bits) - 3);
        }
        return edge;
    }
    /// Omit a triangle that has the gap of an edge. Return false if there is none.
    bool cancel(Offset edge) {
        const Offset own = edge % 8 ? edge - 1 : edge + 2, across = opposite_[edge / 8][edge % 8];
        const auto has_gap = [&](Offset corner) { return state_[corner / 8] >> corner % 8 & 1; };
        const Offset corner = has_gap(own) ? own : across;
        const bool cancels = has_gap(corner);
        state_[corner / 8] = cancels ? 0 : state_[corner / 8];
        return cancels;
    }
    /// Add the triangles of a block that are within range.
    void add_triangles(Index begin, Index end) {
        for (Index k = begin; k < end; k += lanes<double>) {
            unsigned bits = join_bits(load_bytes(state_.data() + k) / in_range);
            if (!bits) continue;
            for (int j = 0; j < 7; ++j) {
                double* const to = (j < 3 ? weight_[j] : j < 6 ? away_[j - 3] : gap_).data() + size;
                store(to, compress(load(geometry_[j].data() + (k - begin)), bits));
            }
            for (; bits; bits &= bits - 1) corner_[size++] = candidates_[k + std::countr_zero(bits)];
        }
    }
    /// Weights, vectors and squared distances of edges or points.
    template <int Size>
    void measure(std::size_t begin, std::size_t end, const double* x) {
        using V = vec<double>;
        const V unit = splat<V>(1.0);
        for (std::size_t k = begin; k < end; k += lanes<double>) {
            Vec3<V> at[Size + 1], away;
            gather<Size + 1>(corner_.data() + k, x, at);
            V weight[3] = {-unit};
            if constexpr (Size == 2) {
                const OnSegment<V> n = near_segment(at[0], at[1], at[2]);
                away = n.away, weight[0] = n.fraction - unit, weight[1] = -n.fraction;
            } else {
                away = at[0] - at[1];
            }
            for (int j = 0; j < 3; ++j) store(weight_[j].data() + k, weight[j]);
            store(away_[0].data() + k, away.x), store(away_[1].data() + k, away.y), store(away_[2].data() + k, away.z);
            store(gap_.data() + k, norm2(away));
        }
    }

    /// Candidates and, for each: edges and corners that it is the first to have, by bit; the corner of the triangle
    /// across each edge, as a bit of `state_`, one without effect if that is no candidate. Ends of blocks, which have
    /// whole particles.
    Index n_candidates_ = 0;
    std::size_t capacity_ = 0;
    std::vector<Corners> candidates_, corner_;
    std::vector<unsigned char> parts_, state_;
    std::vector<std::array<Offset, 3>> opposite_;
    std::vector<Index> blocks_, place_, about_;
    std::vector<Offset> edges_, points_, remaining_;
    std::vector<double> geometry_[7], weight_[3], away_[3], gap_, terms_, normals_;
};

/// Sums of the energies of particles (see Contact), and their forces.
class SelfSums {
public:
    /// Largest energy that a particle has to absorb, see energy_to_stop.
    double max_energy = 0.0;

    /// Sum the gaps below the thickness. Return the largest speed at which others would close within a duration [s], or
    /// zero.
    double include(const SelfGaps& gaps, std::int64_t count, double thickness, double duration) {
        index_.resize(count, -1);
        if (const std::size_t capacity = gaps.size + lanes<double>; particle_.size() < capacity) {
            for (auto* all : {&sums_, &forces_}) all->resize(4 * capacity);
            for (auto* all : {&closing_, &mass_, &scale_}) all->resize(capacity);
            particle_.resize(capacity), sum_of_.resize(capacity);
        }
        // Local pointers, because the compiler reloads members after each store of a quad.
        double *const sums = sums_.data(), *const closing = closing_.data();
        Index *const index_of = index_.data(), *const sum_of = sum_of_.data();
        std::size_t size = 0;
        double approach_speed = 0.0;
        for (std::size_t k = 0; k < gaps.size; ++k) {
            const double* const terms = gaps.terms(k);
            if (!(terms[2] < thickness)) {
                sum_of[k] = -1;
                if (terms[2] - thickness < duration * terms[1]) approach_speed = larger(terms[1], approach_speed);
                continue;
            }
            const SelfGaps::Offset i = gaps.corners(k)[0];
            Index index = index_of[i / 4];
            if (index < 0) {
                index_of[i / 4] = index = static_cast<Index>(size++);
                store4(sums + 4 * index, quad<double>{});
                closing[index] = 0.0;
                particle_[index] = i;
            }
            sum_of[k] = index;
            const double sign = gaps.sign(k), push = sign * terms[0];
            store4(sums + 4 * index,
                   cloth::fma(quad<double>{push, push, push, sign}, quad<double>{1.0, terms[1], terms[2], terms[3]},
                              load4(sums + 4 * index)));
            closing[index] = larger(terms[1], closing[index]);
        }
        size_ = size;
        return approach_speed;
    }
    /// Damping factors of the forces, dissipation, and growth power [W].
    void finalize(const Surface& s, const SurfaceLaw<double>& law, double* dissipation, double& growth_power) {
        using V = vec<double>;
        const V unit = splat<V>(1.0);
        V most{};
        // Padding without energy.
        std::fill_n(sums_.begin() + 4 * size_, 4 * lanes<double>, 0.0);
        std::fill_n(closing_.begin() + size_, lanes<double>, 0.0);
        std::fill_n(particle_.begin() + size_, lanes<double>, 0);
        for (std::size_t k = 0; k < size_; k += lanes<double>) {
            quad<double> rows[lanes<double>];
            for (int lane = 0; lane < lanes<double>; ++lane) {
                rows[lane] = load4(sums_.data() + 4 * (k + lane));
                mass_[k + lane] = s.masses[particle_[k + lane] / 4];
            }
            V push, rate, lever, shape;
            deinterleave(rows, push, rate, lever, shape);
            most = larger(energy_to_stop(load(closing_.data() + k), shape), most);
            const Scaling<V> scaling = law.lane_scaling([&](int lane) { return law.scaling(particle_[k + lane] / 4); });
            const V inverse_scale = unit / scaling.scale, square = inverse_scale * inverse_scale,
                    factor = select(push > V{}, law.damping_factor(push, rate, false), unit),
                    mass = splat<V>(0.5) * load(mass_.data() + k);
            store(scale_.data() + k, factor * (mass * inverse_scale));
            if (!dissipation) continue;
            const V loss = mass * (factor - unit) * rate * square,
                    power = mass * scaling.growth * square * SurfaceLaw<double>::growing(factor * lever, shape);
            for (int lane = 0; lane < lanes<double>; ++lane) {
                *dissipation += loss[lane];
                if (law.reduced()) growth_power += power[lane];
            }
        }
        max_energy = 0.0;
        for (int lane = 0; lane < lanes<double>; ++lane) max_energy = larger<double>(most[lane], max_energy);
    }
    /// Add forces to quads f; the fourth number is the mass times the weights, see StiffnessBound.
    void add_forces(const SelfGaps& gaps, double* f) {
        const auto add = [](double* to, quad<double> addend)
                             CLOTH_INLINED { store4(to, quad<double>(load4(to) + addend)); };
        double* const forces = forces_.data();
        const double *const scale = scale_.data(), *const mass = mass_.data(), *const terms = gaps.terms(0),
                            *const normals = gaps.normal(0);
        const double* const weight[] = {gaps.weights(0), gaps.weights(1), gaps.weights(2)};
        const SelfGaps::Corners* const corners_of = &gaps.corners(0);
        const Index* const sum_of = sum_of_.data();
        std::fill_n(forces, 4 * size_, 0.0);
        // Gaps with a number of corners besides the particle.
        const auto add_gaps = [&](auto corners, double sign, std::size_t begin, std::size_t end) CLOTH_INLINED {
            for (std::size_t k = begin; k < end; ++k) {
                const Index index = sum_of[k];
                if (index < 0) continue;
                const double force = scale[index] * (sign * terms[4 * k]);
                quad<double> force_and_mass =
                    quad<double>{force, force, force, sign * mass[index]} * load4(normals + 4 * k);
                add(forces + 4 * index, force_and_mass);
                // Weights of corners are not positive.
                force_and_mass[3] = -force_and_mass[3];
                for (int j = 0; j < corners(); ++j) {
                    double* const to = f + corners_of[k][j + 1];
                    store4(to, cloth::fma(splat<quad<double>>(weight[j][k]), force_and_mass, load4(to)));
                }
            }
        };
        add_gaps(std::integral_constant<int, 3>{}, 1.0, 0, gaps.ends[0]);
        add_gaps(std::integral_constant<int, 2>{}, -1.0, gaps.ends[0], gaps.ends[1]);
        add_gaps(std::integral_constant<int, 1>{}, 1.0, gaps.ends[1], gaps.size);
        for (std::size_t k = 0; k < size_; ++k) {
            add(f + particle_[k], load4(forces + 4 * k));
            index_[particle_[k] / 4] = -1;
        }
    }

private:
    std::size_t size_ = 0;
    /// By particle in contact: pushes, rates, levers and b; forces; closing speeds, masses, factors of the forces. Of
    /// each particle and gap, the index of these, or -1.
    std::vector<double> sums_, forces_, closing_, mass_, scale_;
    std::vector<SelfGaps::Offset> particle_;
    std::vector<Index> index_, sum_of_;
};

}  // namespace cloth::contact
