// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of relative motion against all particles and all pairs.
#include "contact/motion_bound.hpp"

#include <limits>

#include "sheets.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

/// Move all particles by the same vector [m], and each by up to another distance along each axis.
void move(Sheet& sheet, Vec3<double> common, double jitter, Random& random) {
    for (Index i = 0; i < sheet.surface.count; ++i)
        sheet.set_position(i, sheet.at(i) + common + jitter * random.vector());
}

/// Whether a bound is a distance less an allowance for rounding.
bool is_just_below(double bound, double distance) { return bound < distance && bound > (1.0 - 1e-11) * distance; }

}  // namespace

TEST_CASE("the bound of motion is not below any relative displacement") {
    Random random;
    for (const Index rows : {1, 2, 3, 7}) {
        Sheet sheet(rows);
        sheet.arrange(2, random);
        const std::vector<double> x0 = sheet.x;
        const std::int64_t n = sheet.surface.count;
        move(sheet, {1.0, 2.0, 3.0}, 0.1, random);
        MotionBound bound, from_origin;
        bound.include(sheet.x.data(), x0.data(), n);
        from_origin.include(sheet.x.data(), nullptr, n);
        const auto displacement = [&](Index i) {
            return sheet.at(i) - Vec3<double>{x0[4 * i], x0[4 * i + 1], x0[4 * i + 2]};
        };
        double most = 0.0;
        for (Index i = 0; i < n; ++i)
            for (Index j = 0; j < n; ++j) {
                most = std::max(most, std::sqrt(norm2(displacement(i) - displacement(j))));
                CHECK(from_origin.diameter() >= std::sqrt(norm2(sheet.at(i) - sheet.at(j))));
            }
        CHECK(bound.diameter() >= most);
        CHECK(bound.diameter() <= 0.2 * std::sqrt(3.0) + 1e-12);
        sheet.x[4 * (n - 1) + 1] = std::numeric_limits<double>::quiet_NaN();
        bound.include(sheet.x.data(), x0.data(), n);
        CHECK(std::isnan(bound.diameter()));
    }
}

TEST_CASE("pairs beyond a range stay beyond the bound of their patches") {
    Random random;
    constexpr double reach = 0.08, reduction = 0.02;
    for (const Index rows : {2, 8, 14})
        for (const int kind : {0, 1, 2})
            for (const std::int64_t columns : {std::int64_t{0}, std::int64_t{rows}}) {
                Sheet sheet(rows);
                sheet.arrange(kind, random);
                Patches patches(sheet.surface, columns);
                Patches::Distances beyond;
                patches.set_beyond(beyond, sheet.surface, sheet.x.data(), reach);
                CHECK(patches.bound(beyond, sheet.x.data()) >= reach - 1e-12);
                const Pairs triangles = sheet.all_triangles(reach), edges = sheet.all_edges(reach - reduction);
                for (const double jitter : {0.0, 0.005, 0.03}) {
                    move(sheet, {0.5, -1.0, 2.0}, jitter, random);
                    const double bound = patches.bound(beyond, sheet.x.data());
                    // Moving together leaves the bound.
                    if (jitter == 0.0) CHECK(bound >= reach - 1e-12);
                    for (const auto& pair : sheet.all_triangles(std::max(bound, 0.0)))
                        CHECK(std::binary_search(triangles.begin(), triangles.end(), pair));
                    for (const auto& pair : sheet.all_edges(std::max(bound - reduction, 0.0)))
                        CHECK(std::binary_search(edges.begin(), edges.end(), pair));
                }
            }
}

TEST_CASE("omitted pairs stay beyond the bound of their patches") {
    Random random;
    for (const int kind : {1, 2})
        for (const std::int64_t columns : {0, 12}) {
            Sheet sheet(12);
            sheet.arrange(kind, random);
            Patches patches(sheet.surface, columns);
            SurfacePairs pairs;
            pairs.build(sheet.surface, sheet.x.data(), 0.15);
            REQUIRE(pairs.triangles.size() > 50);
            REQUIRE(pairs.edges.size() > 50);
            Patches::Distances omitted;
            // Every other pair of any distance.
            patches.clear(omitted, sheet.x.data());
            double least = std::numeric_limits<double>::infinity();
            for (std::size_t k = 0; k < pairs.triangles.size(); k += 2) {
                const double distance = std::sqrt(pairs.triangles.square[k]);
                patches.include<false>(omitted, pairs.triangles.first[k], pairs.triangles.second[k], distance);
                least = std::min(distance, least);
            }
            for (std::size_t k = 0; k < pairs.edges.size(); k += 2) {
                const double distance = std::sqrt(pairs.edges.square[k]);
                patches.include<true>(omitted, pairs.edges.first[k], pairs.edges.second[k], distance);
                least = std::min(distance, least);
            }
            patches.finish(omitted);
            CHECK(is_just_below(patches.bound(omitted, sheet.x.data()), least));
            for (const double jitter : {0.001, 0.01}) {
                move(sheet, {3.0, 1.0, -2.0}, jitter, random);
                pairs.measure(sheet.surface, sheet.x.data());
                const double bound = patches.bound(omitted, sheet.x.data());
                for (std::size_t k = 0; k < pairs.triangles.size(); k += 2)
                    CHECK(std::sqrt(pairs.triangles.square[k]) >= bound);
                for (std::size_t k = 0; k < pairs.edges.size(); k += 2)
                    CHECK(std::sqrt(pairs.edges.square[k]) >= bound);
            }
            sheet.x[0] = std::numeric_limits<double>::quiet_NaN();
            CHECK_FALSE(patches.bound(omitted, sheet.x.data()) >= 0.0);
        }
}

TEST_CASE("distances of no pairs have no bound") {
    Sheet sheet(4);
    Patches patches(sheet.surface, 4);
    Patches::Distances none;
    patches.clear(none, sheet.x.data());
    patches.finish(none);
    CHECK(patches.bound(none, sheet.x.data()) == std::numeric_limits<double>::infinity());
}

TEST_CASE("the bound of a pair follows the motion of all patches that it is on") {
    // Patches have three by three particles.
    constexpr Index columns = 12, far_corner = 10 * columns + 10;
    Random random;
    Sheet sheet(columns);
    sheet.arrange(0, random);
    const Surface& s = sheet.surface;
    const auto edge_of = [&](Index i, Index j) {
        const auto edge = std::find(s.edges.begin(), s.edges.end(), std::array<Index, 2>{i, j});
        REQUIRE(edge != s.edges.end());
        return static_cast<Index>(edge - s.edges.begin());
    };
    const auto triangle_of = [&](Index i, Index j) {
        Index k = s.start[i];
        while (!s.has(s.fan[k], j)) ++k;
        return s.fan[k];
    };
    Patches patches(sheet.surface, columns);
    const auto check_bound = [&](auto edges, Index first, Index second, const std::vector<Index>& moving) {
        Patches::Distances omitted;
        patches.clear(omitted, sheet.x.data());
        patches.include<edges()>(omitted, first, second, 0.5);
        patches.finish(omitted);
        for (Index i = 0; i < s.count; ++i) {
            Sheet moved = sheet;
            moved.set_position(i, sheet.at(i) + Vec3<double>{0.0, 0.0, 0.125});
            const auto is_near = [&](Index j) {
                return i / columns / 3 == j / columns / 3 && i % columns / 3 == j % columns / 3;
            };
            const bool counts = std::any_of(moving.begin(), moving.end(), is_near);
            CHECK(is_just_below(patches.bound(omitted, moved.x.data()), counts ? 0.375 : 0.5));
        }
    };
    using IsEdges = std::true_type;
    using IsTriangle = std::false_type;
    check_bound(IsEdges{}, edge_of(2, 3), edge_of(far_corner, far_corner + 1), {2, 3, far_corner});
    check_bound(IsEdges{}, edge_of(0, 1), edge_of(7 * columns + 5, 8 * columns + 5), {0, 7 * columns + 5});
    check_bound(IsEdges{}, edge_of(0, 1), edge_of(7 * columns + 5, 7 * columns + 6),
                {0, 7 * columns + 5, 7 * columns + 6});
    check_bound(IsTriangle{}, 0, triangle_of(7 * columns + 5, 7 * columns + 6), {0, 7 * columns + 5, 7 * columns + 6});
    check_bound(IsTriangle{}, 0, triangle_of(7 * columns + 4, 7 * columns + 5), {0, 7 * columns + 4});
}

TEST_CASE("patches that are far from each other are bound by the motion of all") {
    // Two sheets, one above the other.
    constexpr Index rows = 6, n = rows * rows;
    Random random;
    Sheet sheet(rows);
    sheet.arrange(0, random);
    Surface& s = sheet.surface;
    for (std::size_t t = 0, count = s.triangles.size(); t < count; ++t)
        s.triangles.push_back({s.triangles[t][0] + n, s.triangles[t][1] + n, s.triangles[t][2] + n});
    s.count = 2 * n;
    s.build_topology();
    sheet.x.resize(4 * s.count);
    const auto lift = [&](double height) {
        for (Index i = 0; i < n; ++i) sheet.set_position(n + i, sheet.at(i) + Vec3<double>{0.0, 0.0, height});
    };
    lift(0.4);
    Patches patches(sheet.surface, 0);
    Patches::Distances beyond;
    patches.set_beyond(beyond, s, sheet.x.data(), 0.05);
    CHECK(is_just_below(patches.bound(beyond, sheet.x.data()), 0.05));
    lift(0.02);
    CHECK(patches.bound(beyond, sheet.x.data()) <= 0.02);
}

TEST_CASE("a patch has the triangles about its particles") {
    // Three patches of nine particles each, in one place each; a triangle is on the latter two.
    Surface s;
    s.count = 27;
    s.triangles = {{9, 18, 10}};
    s.build_topology();
    std::vector<double> x(4 * s.count, 0.0);
    for (int i = 0; i < 27; ++i) x[4 * i] = 2.0 * (i / 9 == 2) - (i / 9 > 0), x[4 * i + 1] = i / 9 > 0 ? 1.0 : 0.0;
    Patches patches(s, 0);
    Patches::Distances beyond;
    patches.set_beyond(beyond, s, x.data(), 0.5);
    // The first patch comes near the middle of the triangle, which is nearer than its corners.
    for (int i = 0; i < 9; ++i) x[4 * i + 1] = 0.95;
    CHECK(near_triangle<double>({0.0, 0.95, 0.0}, {-1.0, 1.0, 0.0}, {1.0, 1.0, 0.0}, {-1.0, 1.0, 0.0}).square > 0.002);
    CHECK(patches.bound(beyond, x.data()) <= 0.05 + 1e-12);
}

}  // namespace cloth::tests
