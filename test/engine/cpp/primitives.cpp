// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Nearest points of triangles and segments: optimality conditions, which are sufficient because both sets are convex.
#include "contact/primitives.hpp"

#include <vector>

#include "samples.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

constexpr double tolerance = 1e-10;

/// Four points: random, on a lattice (so that some coincide, are collinear, or are parallel), or almost so.
struct Points {
    Vec3<double> at[4];

    Points(Random& random, int kind) {
        for (Vec3<double>& p : at) {
            p = random.vector();
            if (kind > 0) p = {std::round(p.x), std::round(p.y), std::round(p.z)};
            if (kind == 2) p = p + 1e-9 * random.vector();
        }
    }
};

/// Check that no point of a triangle is nearer: from the nearest one, no corner is on the side of the point.
void check_nearest_on_triangle(const Vec3<double>* at) {
    const OnTriangle<double> n = near_triangle(at[0], at[1], at[2], at[3]);
    Vec3<double> nearest{};
    double total = 0.0;
    for (int j = 0; j < 3; ++j) {
        CHECK(n.weight[j] >= 0.0);
        CHECK(n.weight[j] <= 1.0);
        total += n.weight[j];
        nearest = fma(n.weight[j], at[j + 1], nearest);
    }
    check_close(total, 1.0, tolerance);
    check_close(n.away, at[0] - nearest, tolerance, 1.0);
    check_close(n.square, norm2(n.away), tolerance);
    for (int j = 1; j < 4; ++j) CHECK(dot(n.away, at[j] - nearest) <= 1e-8);
}

/// Check that no points of two segments are nearer: along each, the distance has no slope, or rises from an end.
void check_nearest_on_segments(const Vec3<double>* at) {
    const OnSegments<double> n = near_segments(at[0], at[1], at[2], at[3]);
    const Vec3<double> first = at[1] - at[0], second = at[3] - at[2];
    check_close(n.away, fma(n.first, first, at[0]) - fma(n.second, second, at[2]), tolerance, 1.0);
    check_close(n.square, norm2(n.away), tolerance);
    const auto check_slope = [](double fraction, double slope) {
        CHECK(fraction >= 0.0);
        CHECK(fraction <= 1.0);
        if (fraction > 0.0) CHECK(slope <= 1e-8);
        if (fraction < 1.0) CHECK(slope >= -1e-8);
    };
    check_slope(n.first, dot(n.away, first));
    check_slope(n.second, -dot(n.away, second));
}

/// Vectors of points, with other points in each lane.
struct PointLanes {
    Vec3<vec<double>> at[4]{};
    std::vector<Points> points;

    explicit PointLanes(Random& random) {
        for (int k = 0; k < lanes<double>; ++k) {
            points.emplace_back(random, k % 3);
            for (int j = 0; j < 4; ++j) {
                const Vec3<double> p = points[k].at[j];
                at[j].x[k] = p.x, at[j].y[k] = p.y, at[j].z[k] = p.z;
            }
        }
    }
};

}  // namespace

TEST_CASE("the nearest point of a triangle is optimal") {
    Random random;
    for (const int kind : {0, 1, 2})
        for (int round = 0; round < 1000; ++round) check_nearest_on_triangle(Points(random, kind).at);
}

TEST_CASE("the nearest points of two segments are optimal") {
    Random random;
    for (const int kind : {0, 1})
        for (int round = 0; round < 1000; ++round) check_nearest_on_segments(Points(random, kind).at);
}

TEST_CASE("the nearest point of a segment is its foot or an end") {
    const Vec3<double> a{0.0, 0.0, 0.0}, b{2.0, 0.0, 0.0};
    const OnSegment<double> foot = near_segment(Vec3<double>{0.5, 3.0, 4.0}, a, b);
    CHECK(foot.fraction == 0.25);
    CHECK(foot.square == 25.0);
    CHECK(near_segment(Vec3<double>{-1.0, 2.0, 0.0}, a, b).fraction == 0.0);
    const OnSegment<double> end = near_segment(Vec3<double>{5.0, 4.0, 0.0}, a, b);
    CHECK(end.fraction == 1.0);
    CHECK(end.square == 25.0);
}

TEST_CASE("a segment without length is a point") {
    const Vec3<double> a{1.0, 1.0, 1.0}, p{1.0, 3.0, 1.0};
    const OnSegment<double> n = near_segment(p, a, a);
    CHECK(n.square == 4.0);
    CHECK(n.fraction >= 0.0);
    CHECK(n.fraction <= 1.0);
}

TEST_CASE("a triangle has a closed distance above its inside, an edge and a corner") {
    const Vec3<double> a{0.0, 0.0, 0.0}, b{1.0, 0.0, 0.0}, c{0.0, 1.0, 0.0};
    const auto inside = near_triangle({0.25, 0.25, -2.0}, a, b, c);
    CHECK(inside.square == 4.0);
    CHECK(inside.away.z == -2.0);
    CHECK(inside.weight[0] == 0.5);
    const auto edge = near_triangle({0.5, -1.0, 1.0}, a, b, c);
    CHECK(edge.square == 2.0);
    CHECK(edge.weight[2] == 0.0);
    const auto corner = near_triangle({3.0, -1.0, 0.0}, a, b, c);
    CHECK(corner.square == 5.0);
    CHECK(corner.weight[1] == 1.0);
}

TEST_CASE("a triangle tells the distances of its edges and corners") {
    Random random;
    for (int round = 0; round < 300; ++round) {
        const Points points(random, round % 3);
        const Vec3<double>* const at = points.at;
        PartSquares<double> parts;
        const auto with_parts = near_triangle(at[0], at[1], at[2], at[3], &parts);
        CHECK(has_same_bits(with_parts.square, near_triangle(at[0], at[1], at[2], at[3]).square));
        for (int j = 0; j < 3; ++j) {
            const auto edge = near_segment(at[0], at[1 + j], at[1 + (j + 1) % 3]);
            CHECK(has_same_bits(parts.edge[j], edge.square));
            CHECK(has_same_bits(parts.corner[j], norm2(at[0] - at[1 + j])));
        }
    }
}

TEST_CASE("degenerate triangles have the distance of their longest edge") {
    const Vec3<double> a{0.0, 0.0, 0.0}, b{1.0, 0.0, 0.0}, c{3.0, 0.0, 0.0}, p{2.0, 2.0, 0.0};
    CHECK(near_triangle(p, a, b, c).square == 4.0);
    CHECK(near_triangle(p, c, a, b).square == 4.0);
    CHECK(near_triangle(p, a, a, a).square == 8.0);
}

TEST_CASE("parallel, collinear and crossing segments have closed distances") {
    const Vec3<double> a{0.0, 0.0, 0.0}, b{2.0, 0.0, 0.0};
    CHECK(near_segments(a, b, {1.0, 3.0, 0.0}, {5.0, 3.0, 0.0}).square == 9.0);
    CHECK(near_segments(a, b, {3.0, 0.0, 0.0}, {5.0, 0.0, 0.0}).square == 1.0);
    CHECK(near_segments(a, b, {1.0, 0.0, 0.0}, {5.0, 0.0, 0.0}).square == 0.0);
    const auto crossing = near_segments(a, b, {0.5, -1.0, 1.0}, {0.5, 3.0, 1.0});
    CHECK(crossing.square == 1.0);
    CHECK(crossing.first == 0.25);
    CHECK(crossing.second == 0.25);
    CHECK(crossing.away.z == -1.0);
    CHECK(near_segments(a, a, {3.0, 4.0, 0.0}, {3.0, 4.0, 0.0}).square == 25.0);
}

TEST_CASE("lanes of nearest points have the bits of numbers") {
    Random random;
    for (int round = 0; round < 200; ++round) {
        const PointLanes all(random);
        const auto triangle = near_triangle(all.at[0], all.at[1], all.at[2], all.at[3]);
        const auto segments = near_segments(all.at[0], all.at[1], all.at[2], all.at[3]);
        for (int k = 0; k < lanes<double>; ++k) {
            const Vec3<double>* const p = all.points[k].at;
            const auto triangle1 = near_triangle(p[0], p[1], p[2], p[3]);
            const auto segments1 = near_segments(p[0], p[1], p[2], p[3]);
            CHECK(has_same_bits<double>(triangle.square[k], triangle1.square));
            CHECK(has_same_bits<double>(triangle.away.x[k], triangle1.away.x));
            for (int j = 0; j < 3; ++j) CHECK(has_same_bits<double>(triangle.weight[j][k], triangle1.weight[j]));
            CHECK(has_same_bits<double>(segments.square[k], segments1.square));
            CHECK(has_same_bits<double>(segments.first[k], segments1.first));
            CHECK(has_same_bits<double>(segments.second[k], segments1.second));
        }
    }
}

}  // namespace cloth::tests
