// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Broad phase of self-contact against all pairs.
#include "contact/broad_phase.hpp"

#include "sheets.hpp"

namespace cloth::tests {

using namespace contact;

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
    // Measured where it was built, and after a motion.
    for (int turn = 0; turn < 2; ++turn) {
        for (std::size_t k = 0; k < pairs.triangles.size(); ++k) {
            const auto& c = sheet.surface.triangles[pairs.triangles.second[k]];
            const auto expected =
                near_triangle(sheet.at(pairs.triangles.first[k]), sheet.at(c[0]), sheet.at(c[1]), sheet.at(c[2]));
            CHECK(has_same_bits(pairs.triangles.square[k], expected.square));
        }
        for (std::size_t k = 0; k < pairs.edges.size(); ++k) {
            const auto &a = sheet.surface.edges[pairs.edges.first[k]], &b = sheet.surface.edges[pairs.edges.second[k]];
            CHECK(has_same_bits(pairs.edges.square[k],
                                near_segments(sheet.at(a[0]), sheet.at(a[1]), sheet.at(b[0]), sheet.at(b[1])).square));
        }
        sheet.arrange(2, random);
        pairs.measure(sheet.surface, sheet.x.data());
    }
}

TEST_CASE("a selection keeps the pairs within a range and names the others") {
    Random random;
    PairList from, to;
    // An earlier content is replaced.
    to.add(7, 7);
    for (const int size : {0, 1, 9, 200}) {
        from.clear();
        for (int k = 0; k < size; ++k) {
            from.add(static_cast<Index>(random.below(20)), static_cast<Index>(k));
            from.square.push_back(random.uniform(0.0, 2.0));
        }
        from.square.resize(from.square.size() + lanes<double>, 0.0);
        std::vector<Index> omitted;
        Pairs near;
        std::vector<double> squares;
        for (int k = 0; k < size; ++k)
            if (from.square[k] < 1.0)
                near.emplace_back(from.first[k], from.second[k]), squares.push_back(from.square[k]);
            else
                omitted.push_back(static_cast<Index>(k));
        CHECK(to.select(from, 1.0) == omitted);
        CHECK(pairs_of(to) == near);
        CHECK(std::vector<double>(to.square.begin(), to.square.begin() + std::ssize(near)) == squares);
        CHECK(to.square.size() == near.size() + lanes<double>);
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

TEST_CASE("the pair lists omit particles and edges that are joined") {
    Random random;
    Sheet sheet(8);
    sheet.arrange(2, random);
    SurfacePairs pairs;
    pairs.build(sheet.surface, sheet.x.data(), 0.3);
    const std::size_t n_triangles = pairs.triangles.size(), n_edges = pairs.edges.size();
    for (const Index i : {5, 17, 40}) sheet.surface.joined[i + 1] = sheet.surface.joined[i];
    pairs.build(sheet.surface, sheet.x.data(), 0.3);
    CHECK(pairs.triangles.size() < n_triangles);
    CHECK(pairs.edges.size() < n_edges);
    CHECK(pairs_of(pairs.triangles) == sheet.all_triangles(0.3));
    CHECK(pairs_of(pairs.edges) == sheet.all_edges(0.3));
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
            cells.for_each_row(center - half, center + half, [&](std::int64_t begin, std::int64_t end) {
                for (std::int64_t slot = begin; slot < end; ++slot) ++visits[cells[slot]];
            });
            for (std::int64_t i = 0; i < count; ++i) {
                const Vec3<double> p = points[i] - center;
                const bool inside = std::abs(p.x) <= half.x && std::abs(p.y) <= half.y && std::abs(p.z) <= half.z;
                CHECK(visits[i] <= 1);
                if (inside) CHECK(visits[i] == 1);
            }
        }
    }
}

TEST_CASE("sorted boxes visit the slots that overlap and have other keys") {
    Random random;
    constexpr std::int64_t count = 50;
    SortedBoxes<2> boxes(count);
    std::vector<AxisBox> all;
    std::vector<std::array<Index, 2>> keys;
    const auto random_keys = [&] {
        return std::array<Index, 2>{static_cast<Index>(random.below(9)), static_cast<Index>(random.below(9))};
    };
    const auto random_box = [&](double size) {
        const Vec3<double> a = random.vector();
        AxisBox box(a);
        box.include(a + size * random.vector());
        return box;
    };
    for (std::int64_t slot = 0; slot < count; ++slot) {
        all.push_back(random_box(0.4));
        keys.push_back(random_keys());
        boxes.put(slot, all[slot], keys[slot]);
    }
    for (int round = 0; round < 100; ++round) {
        const AxisBox box = random_box(0.6);
        const std::array<Index, 2> excluded = random_keys();
        const std::int64_t begin = random.below(count), end = begin + random.below(count - begin + 1);
        std::vector<std::int64_t> visited, expected;
        boxes.for_each_overlap(begin, end, box, excluded, [&](std::int64_t slot) { visited.push_back(slot); });
        for (std::int64_t slot = begin; slot < end; ++slot) {
            const auto [a, b] = keys[slot];
            if (all[slot].overlaps(box) && a != excluded[0] && a != excluded[1] && b != excluded[0] && b != excluded[1])
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
            CHECK(bool(s.owned[t] >> k & 1) == (neighbor > static_cast<Index>(t)));
            if (neighbor < 0) continue;
            CHECK(s.has(neighbor, s.triangles[t][k]));
            CHECK(s.has(neighbor, s.triangles[t][(k + 1) % 3]));
            CHECK_FALSE(s.has(t, s.triangles[neighbor][s.opposite[t][k]]));
        }
    for (Index i = 0; i < s.count; ++i) {
        CHECK(bool(s.inner[i]) == (i == 4));
        for (Index k = s.start[i]; k < s.start[i + 1]; ++k)
            for (int j = 0; j < 3; ++j)
                if (s.triangles[s.fan[k]][j] == i)
                    CHECK(bool(s.owned[s.fan[k]] >> (3 + j) & 1) == (s.inner[i] && k == s.start[i]));
        for (Index k = s.start[i]; k < s.start[i + 1]; ++k) CHECK(s.has(s.fan[k], i));
    }
    CHECK(s.start[5] - s.start[4] == 6);
}

}  // namespace cloth::tests
