// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Sheets of triangles, flat, in layers, and crumpled.
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "contact/broad_phase.hpp"
#include "contact/primitives.hpp"
#include "contact/surface.hpp"
#include "samples.hpp"

namespace cloth::tests {

using contact::Index, contact::PairList, contact::Surface, contact::near_segments, contact::near_triangle;

using Pairs = std::vector<std::pair<Index, Index>>;

inline Pairs pairs_of(const PairList& list) {
    Pairs pairs;
    for (std::size_t k = 0; k < list.size(); ++k) pairs.emplace_back(list.first[k], list.second[k]);
    return pairs;
}

/// A sheet of triangles, and positions of its particles as quads [m].
struct Sheet {
    Surface surface;
    std::vector<double> x;

    explicit Sheet(Index rows) {
        surface.count = rows * rows;
        for (Index i = 0; i + 1 < rows; ++i)
            for (Index j = 0; j + 1 < rows; ++j) {
                const Index a = i * rows + j;
                surface.triangles.push_back({a, a + rows, a + 1});
                surface.triangles.push_back({a + 1, a + rows, a + rows + 1});
            }
        surface.build_topology();
        surface.shortest = 0.1;
        surface.masses.assign(surface.count, 0.01);
        surface.inverse.assign(surface.count, 100.0);
        surface.is_free.assign(surface.count, 1);
        x.assign(4 * surface.count, 0.0);
    }
    void set_position(Index i, Vec3<double> p) { x[4 * i] = p.x, x[4 * i + 1] = p.y, x[4 * i + 2] = p.z; }
    Vec3<double> at(Index i) const { return {x[4 * i], x[4 * i + 1], x[4 * i + 2]}; }

    /// Flat, of a spacing of 0.1 m, folded in layers, or crumpled in a cube of 1 m.
    void arrange(int kind, Random& random) {
        const Index rows = static_cast<Index>(std::lround(std::sqrt(surface.count)));
        for (Index i = 0; i < surface.count; ++i) {
            const double u = 0.1 * (i % rows), v = 0.1 * static_cast<double>(i / rows);
            const double folded = std::abs(std::remainder(v, 0.6));
            if (kind == 0) set_position(i, {u, v, 0.0});
            if (kind == 1)
                set_position(i, Vec3<double>{u, folded, 0.05 * std::round(v / 0.6)} + 0.02 * random.vector());
            if (kind == 2) set_position(i, 0.5 * random.vector());
            if (kind == 3) set_position(i, {1.0, 2.0, 3.0});
        }
    }
    /// All pairs of a particle and a triangle without it within a range.
    Pairs all_triangles(double reach) const {
        Pairs pairs;
        for (Index i = 0; i < surface.count; ++i)
            for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
                const auto& c = surface.triangles[t];
                if (surface.has(static_cast<std::int64_t>(t), i)) continue;
                if (near_triangle(at(i), at(c[0]), at(c[1]), at(c[2])).square < reach * reach)
                    pairs.emplace_back(i, static_cast<Index>(t));
            }
        return pairs;
    }
    /// All pairs of edges without a common particle within a range.
    Pairs all_edges(double reach) const {
        Pairs pairs;
        const Index count = static_cast<Index>(surface.edges.size());
        for (Index e = 0; e < count; ++e)
            for (Index f = e + 1; f < count; ++f) {
                const auto &a = surface.edges[e], &b = surface.edges[f];
                const auto joined = [&](Index i, Index j) { return surface.joined[i] == surface.joined[j]; };
                if (joined(a[0], b[0]) || joined(a[0], b[1]) || joined(a[1], b[0]) || joined(a[1], b[1])) continue;
                if (near_segments(at(a[0]), at(a[1]), at(b[0]), at(b[1])).square < reach * reach)
                    pairs.emplace_back(e, f);
            }
        return pairs;
    }
};

}  // namespace cloth::tests
