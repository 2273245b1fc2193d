// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Surface of the cloth for contact: triangles and their neighbours. Particles are numbered by rank.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <numeric>

#include "core/storage.hpp"

namespace cloth::contact {

using Index = std::int32_t;

/// A side of a triangle, from one of its corners to the next; its ends in ascending order.
struct HalfEdge {
    Index low, high, triangle, edge;
};
/// Sides of triangles, sorted by their ends.
inline std::vector<HalfEdge> sorted_half_edges(const std::vector<std::array<Index, 3>>& triangles) {
    std::vector<HalfEdge> half_edges;
    for (std::size_t t = 0; t < triangles.size(); ++t)
        for (int k = 0; k < 3; ++k) {
            const Index a = triangles[t][k], b = triangles[t][(k + 1) % 3];
            half_edges.push_back({std::min(a, b), std::max(a, b), static_cast<Index>(t), k});
        }
    std::stable_sort(half_edges.begin(), half_edges.end(), [](const HalfEdge& a, const HalfEdge& b) {
        return a.low != b.low ? a.low < b.low : a.high < b.high;
    });
    return half_edges;
}

struct Surface {
    std::int64_t count = 0;               ///< number of particles
    std::vector<double> masses, inverse;  ///< [kg], and inverse masses, zero if anchored
    std::vector<char> is_free;
    std::vector<std::array<Index, 3>> triangles;
    /// Neighbour of each triangle across its edges from corner 0 to 1, 1 to 2, 2 to 0; -1 at the border.
    std::vector<std::array<Index, 3>> neighbors;
    /// Corner of each neighbour that is not on the common edge, as 0, 1 or 2.
    std::vector<std::array<Index, 3>> opposite;
    std::vector<std::array<Index, 2>> edges;
    /// Edges and corners of which each triangle is the first: bit j for the edge from corner j, between two triangles;
    /// bit 3 + j for corner j, if that is inner.
    std::vector<unsigned char> owned;
    /// Triangles about each particle in ascending order: fan[start[i]] to before fan[start[i + 1]].
    std::vector<Index> fan, start;
    /// Particles that are not on a border.
    std::vector<char> inner;
    /// Lowest of the particles that joints connect with each one, itself included: these do not touch each other.
    std::vector<Index> joined;
    bool has_joints = false;
    /// Shortest edge of the cloth at rest [m].
    double shortest = 0.0;

    /// Whether a corner of a triangle is a particle, or is joined to it. No corner is a point of an obstacle, ~k.
    bool has(std::int64_t triangle, Index particle) const {
        if (particle < 0) return false;
        const auto& t = triangles[triangle];
        const Index j = joined[particle];
        return joined[t[0]] == j || joined[t[1]] == j || joined[t[2]] == j;
    }
    /// First triangle about a particle that does not contain particle i.
    Index first_about(Index particle, Index i) const {
        for (Index k = start[particle]; k < start[particle + 1]; ++k)
            if (!has(fan[k], i)) return fan[k];
        return -1;
    }
    /// Build edges and fans from triangles. An edge of more than two triangles counts as a border.
    void build_topology() {
        const std::vector<HalfEdge> half_edges = sorted_half_edges(triangles);
        joined.resize(count);
        std::iota(joined.begin(), joined.end(), Index{0});
        neighbors.assign(triangles.size(), {-1, -1, -1});
        opposite.assign(triangles.size(), {0, 0, 0});
        inner.assign(count, 1);
        edges.clear();
        for (std::size_t first = 0, last; first < half_edges.size(); first = last) {
            for (last = first; last < half_edges.size() && half_edges[last].low == half_edges[first].low &&
                               half_edges[last].high == half_edges[first].high;)
                ++last;
            edges.push_back({half_edges[first].low, half_edges[first].high});
            if (last - first == 2) {
                for (const std::size_t k : {first, first + 1}) {
                    const HalfEdge &side = half_edges[k], &other = half_edges[2 * first + 1 - k];
                    neighbors[side.triangle][side.edge] = other.triangle;
                    opposite[side.triangle][side.edge] = (other.edge + 2) % 3;
                }
            } else {
                inner[half_edges[first].low] = inner[half_edges[first].high] = 0;
            }
        }
        start.assign(count + 1, 0);
        for (const auto& t : triangles)
            for (const Index corner : t) ++start[corner + 1];
        for (std::int64_t i = 0; i < count; ++i) {
            if (!start[i + 1]) inner[i] = 0;
            start[i + 1] += start[i];
        }
        fan.resize(3 * triangles.size());
        std::vector<Index> next(start.begin(), start.end() - 1);
        owned.assign(triangles.size(), 0);
        for (std::size_t t = 0; t < triangles.size(); ++t)
            for (int j = 0; j < 3; ++j) {
                const Index corner = triangles[t][j];
                if (neighbors[t][j] > static_cast<Index>(t)) owned[t] |= 1u << j;
                if (inner[corner] && next[corner] == start[corner]) owned[t] |= 8u << j;
                fan[next[corner]++] = static_cast<Index>(t);
            }
    }
};

}  // namespace cloth::contact
