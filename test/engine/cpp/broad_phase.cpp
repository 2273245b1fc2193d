// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Broad phase of self-contact against all pairs.
#include "contact/broad_phase.hpp"

#include <algorithm>
#include <utility>

#include "samples.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

using Pairs = std::vector<std::pair<Index, Index>>;

Pairs pairs_of(const PairList& list) {
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
                if (a[0] == b[0] || a[0] == b[1] || a[1] == b[0] || a[1] == b[1]) continue;
                if (near_segments(at(a[0]), at(a[1]), at(b[0]), at(b[1])).square < reach * reach)
                    pairs.emplace_back(e, f);
            }
        return pairs;
    }
};

}  // namespace

TEST_CASE("the pair lists are those of all pairs") {
    Random random;
    for (const Index rows : {2, 3, 8})
        for (const int kind : {0, 1, 2, 3}) {
            Sheet sheet(rows);
            sheet.arrange(kind, random);
            for (const double reach : {0.03, 0.11, 0.5}) {
                SurfacePairs pairs;
                pairs.build(sheet.surface, sheet.x.data(), reach, 0.2 * reach);
                CHECK(pairs.reach == reach);
                CHECK(pairs_of(pairs.triangles) == sheet.all_triangles(reach));
                CHECK(pairs_of(pairs.edges) == sheet.all_edges(reach - 0.2 * reach));
            }
        }
}

TEST_CASE("squared distances of pair lists are those of the primitives") {
    Random random;
    Sheet sheet(8);
    sheet.arrange(2, random);
    SurfacePairs pairs;
    pairs.build(sheet.surface, sheet.x.data(), 0.2);
    REQUIRE(pairs.triangles.size() > 100);
    REQUIRE(pairs.edges.size() > 100);
    std::vector<double> squares;
    pairs.triangle_squares(sheet.surface, sheet.x.data(), squares);
    for (std::size_t k = 0; k < pairs.triangles.size(); ++k) {
        const auto& c = sheet.surface.triangles[pairs.triangles.second[k]];
        const auto expected =
            near_triangle(sheet.at(pairs.triangles.first[k]), sheet.at(c[0]), sheet.at(c[1]), sheet.at(c[2]));
        CHECK(has_same_bits(squares[k], expected.square));
    }
    pairs.edge_squares(sheet.surface, sheet.x.data(), squares);
    for (std::size_t k = 0; k < pairs.edges.size(); ++k) {
        const auto &a = sheet.surface.edges[pairs.edges.first[k]], &b = sheet.surface.edges[pairs.edges.second[k]];
        CHECK(has_same_bits(squares[k],
                            near_segments(sheet.at(a[0]), sheet.at(a[1]), sheet.at(b[0]), sheet.at(b[1])).square));
    }
}

TEST_CASE("a surface without triangles has no pairs") {
    SurfacePairs pairs;
    pairs.build(Surface{}, nullptr, 0.1);
    CHECK(pairs.triangles.size() == 0);
    CHECK(pairs.edges.size() == 0);
}

TEST_CASE("pairs are sorted by both indices") {
    Random random;
    PairList list;
    Pairs expected;
    for (int k = 0; k < 300; ++k) {
        list.add(static_cast<Index>(random.below(20)), static_cast<Index>(random.below(20)));
        expected.emplace_back(list.first.back(), list.second.back());
    }
    std::sort(expected.begin(), expected.end());
    list.sort_both(20);
    CHECK(pairs_of(list) == expected);
}

TEST_CASE("the sort by the first index keeps the order of the second") {
    PairList list;
    for (const auto& [a, b] : Pairs{{2, 0}, {0, 1}, {2, 1}, {0, 5}, {1, 3}}) list.add(a, b);
    list.sort(3);
    CHECK(pairs_of(list) == Pairs{{0, 1}, {0, 5}, {1, 3}, {2, 0}, {2, 1}});
}

TEST_CASE("cells visit each point of a box once") {
    Random random;
    for (const std::int64_t count : {1, 7, 300}) {
        std::vector<Vec3<double>> points(count);
        for (Vec3<double>& p : points) p = random.vector();
        Cells cells(count, 0.15);
        cells.fill([&](std::int64_t i) { return points[i]; });
        for (int round = 0; round < 50; ++round) {
            const Vec3<double> center = 1.2 * random.vector(), half{0.3, 0.2, 0.1};
            std::vector<int> visits(count, 0);
            cells.for_each(center - half, center + half, [&](Index i) { ++visits[i]; });
            for (std::int64_t i = 0; i < count; ++i) {
                const Vec3<double> p = points[i] - center;
                const bool inside = std::abs(p.x) <= half.x && std::abs(p.y) <= half.y && std::abs(p.z) <= half.z;
                CHECK(visits[i] <= 1);
                if (inside) CHECK(visits[i] == 1);
            }
        }
    }
}

TEST_CASE("sorted boxes visit the slots that overlap") {
    Random random;
    constexpr std::int64_t count = 50;
    SortedBoxes boxes(count);
    std::vector<std::array<Vec3<double>, 2>> ends(count);
    const auto ascending = [](Vec3<double> a, Vec3<double> b) {
        return std::array<Vec3<double>, 2>{Vec3<double>{std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)},
                                           Vec3<double>{std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)}};
    };
    for (std::int64_t slot = 0; slot < count; ++slot) {
        const Vec3<double> a = random.vector();
        ends[slot] = ascending(a, a + 0.4 * random.vector());
        boxes.put(slot, ends[slot][0], ends[slot][1]);
    }
    for (int round = 0; round < 100; ++round) {
        const Vec3<double> a = random.vector();
        const auto box = ascending(a, a + 0.6 * random.vector());
        const std::int64_t begin = random.below(count), end = begin + random.below(count - begin + 1);
        std::vector<std::int64_t> visited, expected;
        boxes.for_each_overlap(begin, end, box[0], box[1], [&](std::int64_t slot) { visited.push_back(slot); });
        for (std::int64_t slot = begin; slot < end; ++slot) {
            const auto& [low, high] = ends[slot];
            if (low.x <= box[1].x && low.y <= box[1].y && low.z <= box[1].z && high.x >= box[0].x &&
                high.y >= box[0].y && high.z >= box[0].z)
                expected.push_back(slot);
        }
        CHECK(visited == expected);
    }
}

TEST_CASE("the topology of a sheet has neighbours, borders and fans") {
    const Sheet sheet(3);
    const Surface& s = sheet.surface;
    CHECK(s.triangles.size() == 8);
    CHECK(s.edges.size() == 16);
    for (std::size_t t = 0; t < s.triangles.size(); ++t)
        for (int k = 0; k < 3; ++k) {
            const Index neighbor = s.neighbors[t][k];
            if (neighbor < 0) continue;
            CHECK(s.has(neighbor, s.triangles[t][k]));
            CHECK(s.has(neighbor, s.triangles[t][(k + 1) % 3]));
        }
    for (Index i = 0; i < s.count; ++i) {
        CHECK(bool(s.inner[i]) == (i == 4));
        for (Index k = s.start[i]; k < s.start[i + 1]; ++k) CHECK(s.has(s.fan[k], i));
    }
    CHECK(s.start[5] - s.start[4] == 6);
}

}  // namespace cloth::tests
