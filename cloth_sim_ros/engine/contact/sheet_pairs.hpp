// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Pairs of a regular sheet's cells, and the motions that bring them nearer.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <span>
#include <vector>

#include "contact/primitives.hpp"
#include "contact/surface.hpp"

namespace cloth::contact {

/// Motion of all particles of a sheet at constant velocities, (3, n), for a duration [s]; backwards for a negative one.
/// Each particle may deviate from it by up to a distance [m], (n,); null for none. If `in_any_direction`, relative
/// speeds count as if they closed the distance.
struct SheetMotion {
    const double* v;
    double duration;
    const double* deviations = nullptr;
    bool in_any_direction = false;
};

/// Pairs of a particle and a triangle, and of two edges, that share no particle, among cells of a regular sheet.
/// Particles are numbered row by row.
class SheetPairs {
public:
    /// Largest number of motions that are compared at once.
    static constexpr std::size_t max_motions = 2;

    /// Set the triangles and the diagonal of each cell. Return whether all triangles are halves of cells, and no two
    /// overlap.
    bool set(const Surface& s, std::int64_t rows, std::int64_t columns) {
        columns_ = columns;
        cells_.assign((rows - 1) * (columns - 1), {});
        for (const auto& t : s.triangles) {
            std::int64_t row = rows, column = columns;
            for (const Index i : t) row = std::min(row, i / columns), column = std::min(column, i % columns);
            if (row + 1 >= rows || column + 1 >= columns) return false;
            // Corners of the cell, in turn about it.
            const auto corner = static_cast<Index>(row * columns + column), next = static_cast<Index>(columns);
            const Corners around{corner, corner + 1, corner + next + 1, corner + next};
            int absent = -1, n_absent = 0;
            for (int k = 0; k < 4; ++k)
                if (std::find(t.begin(), t.end(), around[k]) == t.end()) absent = k, ++n_absent;
            Cell& cell = cells_[row * (columns - 1) + column];
            if (n_absent != 1 || cell.size == 2 || (cell.size && cell.absent != (absent + 2) % 4)) return false;
            cell.triangles[cell.size++] = t;
            cell.absent = absent;
            cell.diagonal = {around[(absent + 1) % 4], around[(absent + 3) % 4]};
        }
        n_ = rows * columns;
        return true;
    }
    std::int64_t cell_count() const { return static_cast<std::int64_t>(cells_.size()); }
    std::int64_t cell(std::int64_t row, std::int64_t column) const { return row * (columns_ - 1) + column; }
    /// Those of the motions `checked`, from positions x, (3, n), that bring a pair of some cells nearer than `needed`
    /// [m]: bit k stands for the k-th. If particles and triangles show it for all of them, edges are not compared.
    unsigned approaching(const std::vector<std::int64_t>& cells, const double* x, std::span<const SheetMotion> motions,
                         double needed, unsigned checked) {
        collect(cells);
        const unsigned near = approaching_pairs<false>(triangle_pairs_, x, motions, needed, checked),
                       rest = checked & ~near;
        return rest ? near | approaching_pairs<true>(edge_pairs_, x, motions, needed, rest) : near;
    }

private:
    using Corners = std::array<Index, 4>;
    using Ends = std::array<Index, 2>;

    /// Set the particles, edges and pairs of some cells.
    void collect(const std::vector<std::int64_t>& cells) {
        particles_.clear(), edges_.clear(), triangle_pairs_.clear(), edge_pairs_.clear();
        const auto next = static_cast<Index>(columns_);
        for (const std::int64_t k : cells) {
            const auto corner = static_cast<Index>(k / (columns_ - 1) * columns_ + k % (columns_ - 1));
            for (const Index i : {corner, corner + 1, corner + next, corner + next + 1})
                if (std::find(particles_.begin(), particles_.end(), i) == particles_.end()) particles_.push_back(i);
            // The sides to the left and above are those of a neighbour, if it is among the cells.
            const auto contains = [&](std::int64_t neighbor) {
                return std::find(cells.begin(), cells.end(), neighbor) != cells.end();
            };
            if (k % (columns_ - 1) == 0 || !contains(k - 1)) edges_.push_back({corner, corner + next});
            if (!contains(k - (columns_ - 1))) edges_.push_back({corner, corner + 1});
            edges_.push_back({corner + 1, corner + next + 1});
            edges_.push_back({corner + next, corner + next + 1});
            if (cells_[k].size) edges_.push_back(cells_[k].diagonal);
        }
        for (const std::int64_t k : cells)
            for (int half = 0; half < cells_[k].size; ++half) {
                const auto& t = cells_[k].triangles[half];
                for (const Index i : particles_)
                    if (i != t[0] && i != t[1] && i != t[2]) triangle_pairs_.push_back({i, t[0], t[1], t[2]});
            }
        for (std::size_t k = 0; k < edges_.size(); ++k)
            for (std::size_t j = 0; j < k; ++j) {
                const Ends &a = edges_[k], &b = edges_[j];
                if (a[0] != b[0] && a[0] != b[1] && a[1] != b[0] && a[1] != b[1])
                    edge_pairs_.push_back({a[0], a[1], b[0], b[1]});
            }
    }
    /// Check pairs by their distance, less the way at the largest closing speed of their corners along it: no points of
    /// a pair come nearer.
    template <bool Edges>
    unsigned approaching_pairs(const std::vector<Corners>& pairs, const double* x, std::span<const SheetMotion> motions,
                               double needed, unsigned checked) const {
        using V = vec<double>;
        V least[max_motions];
        std::fill_n(least, max_motions, splat<V>(std::numeric_limits<double>::infinity()));
        for (std::size_t k = 0; k < pairs.size(); k += lanes<double>) {
            const auto gather = [&](const double* a, Vec3<V>(&to)[4]) {
                for (int lane = 0; lane < lanes<double>; ++lane)
                    for (int j = 0; j < 4; ++j) {
                        const double* const from = a + pairs[std::min(k + lane, pairs.size() - 1)][j];
                        to[j].x[lane] = from[0], to[j].y[lane] = from[n_], to[j].z[lane] = from[2 * n_];
                    }
            };
            Vec3<V> at[4], velocity[4], away;
            gather(x, at);
            if constexpr (Edges)
                away = near_segments(at[0], at[1], at[2], at[3]).away;
            else
                away = near_triangle(at[0], at[1], at[2], at[3]).away;
            const V distance = root(norm2(away));
            for (std::size_t m = 0; m < motions.size(); ++m) {
                if (!(checked >> m & 1u)) continue;
                gather(motions[m].v, velocity);
                const V duration = splat<V>(motions[m].duration);
                V displacement[4];
                for (int j = 0; j < 4; ++j) displacement[j] = duration * dot(away, velocity[j]);
                // Corners before `split` are of one side.
                constexpr int split = Edges ? 2 : 1;
                V shortest = displacement[0], longest = displacement[split];
                for (int j = 1; j < split; ++j) shortest = smaller(displacement[j], shortest);
                for (int j = split + 1; j < 4; ++j) longest = larger(displacement[j], longest);
                // Without a distance, no direction is known.
                V closing = select(distance > V{}, larger(longest - shortest, V{}) / distance, V{});
                if (motions[m].in_any_direction) {
                    V square{};
                    for (int i = 0; i < split; ++i)
                        for (int j = split; j < 4; ++j) square = larger(norm2(velocity[i] - velocity[j]), square);
                    closing = absolute(duration) * root(square);
                }
                if (const double* const deviations = motions[m].deviations)
                    for (int lane = 0; lane < lanes<double>; ++lane) {
                        const Corners& pair = pairs[std::min(k + lane, pairs.size() - 1)];
                        double most[2]{};
                        for (int j = 0; j < 4; ++j) most[j >= split] = larger(deviations[pair[j]], most[j >= split]);
                        closing[lane] += most[0] + most[1];
                    }
                least[m] = smaller(distance - closing, least[m]);
            }
        }
        unsigned near = 0;
        for (std::size_t m = 0; m < motions.size(); ++m)
            if (bits_of(!(least[m] >= splat<V>(needed)))) near |= 1u << m;
        return near & checked;
    }
    /// A cell with up to two triangles; `absent`: the corner that the last one lacks.
    struct Cell {
        std::array<std::array<Index, 3>, 2> triangles;
        Ends diagonal;
        int size = 0, absent = -1;
    };
    std::int64_t columns_ = 0, n_ = 0;
    std::vector<Cell> cells_;
    /// Particles, edges and pairs of the compared cells.
    std::vector<Index> particles_;
    std::vector<Ends> edges_;
    std::vector<Corners> triangle_pairs_, edge_pairs_;
};

}  // namespace cloth::contact
