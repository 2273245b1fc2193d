// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What contact of the cloth with itself and with features of obstacles share: pairs, collision detection and law.
#include "contact/features.hpp"

#include "sheets.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

/// A box of edges of 0.6 m and its pose.
Features box_features() {
    Features box;
    for (int k = 0; k < 8; ++k)
        box.points.push_back(
            {0.3 * ((k & 1) - 0.5) * 2.0, 0.3 * ((k >> 1 & 1) - 0.5) * 2.0, 0.3 * ((k >> 2) - 0.5) * 2.0});
    for (Index k = 0; k < 8; ++k)
        for (const Index bit : {1, 2, 4})
            if (!(k & bit)) box.edges.push_back({k, k | bit});
    box.reach = 0.3 * std::sqrt(3.0);
    return box;
}
plan::Pose pose_at_center(Random& random) {
    plan::Pose pose{};
    const Vec3<double> a = random.vector(), b = random.vector();
    pose.rotation[0] = (1.0 / std::sqrt(norm2(a))) * a;
    const Vec3<double> c = cross(pose.rotation[0], b);
    pose.rotation[2] = (1.0 / std::sqrt(norm2(c))) * c;
    pose.rotation[1] = cross(pose.rotation[2], pose.rotation[0]);
    pose.position = 0.2 * random.vector();
    pose.velocity = random.vector();
    return pose;
}

}  // namespace

TEST_CASE("the pair lists of features are those of all points and edges") {
    Random random;
    const Features box = box_features();
    for (const Index rows : {2, 8})
        for (const int kind : {0, 2}) {
            Sheet sheet(rows);
            sheet.arrange(kind, random);
            const Surface& s = sheet.surface;
            const plan::Pose pose = pose_at_center(random);
            const FeaturesAt from{box, pose};
            for (const double reach : {0.02, 0.1, 0.4}) {
                Pairs triangles, edges;
                for (Index k = 0; k < std::ssize(box.points); ++k)
                    for (Index t = 0; t < std::ssize(s.triangles); ++t) {
                        const auto& c = s.triangles[t];
                        const auto n = near_triangle(from.position(k), sheet.at(c[0]), sheet.at(c[1]), sheet.at(c[2]));
                        if (n.square < reach * reach) triangles.emplace_back(k, t);
                    }
                for (Index k = 0; k < std::ssize(box.edges); ++k)
                    for (Index e = 0; e < std::ssize(s.edges); ++e) {
                        const auto n = near_segments(sheet.at(s.edges[e][0]), sheet.at(s.edges[e][1]),
                                                     from.position(box.edges[k][0]), from.position(box.edges[k][1]));
                        if (n.square < reach * reach) edges.emplace_back(k, e);
                    }
                FeaturePairs pairs;
                pairs.build(s, from, sheet.x.data(), reach);
                CHECK(pairs_of(pairs.triangles) == triangles);
                CHECK(pairs_of(pairs.edges) == edges);
                // Verlet lists, new and after a motion.
                FeatureVerletList list;
                for (const double shift : {0.0, 0.003}) {
                    std::vector<double> x = sheet.x;
                    for (std::size_t k = 0; k < x.size(); k += 4) x[k] += shift;
                    pairs.build(s, from, x.data(), smaller(reach, 0.3));
                    REQUIRE(list.find(s, x.data(), from, 0.5 * smaller(reach, 0.3), 0.5 * smaller(reach, 0.3)));
                    CHECK(pairs_of(list.triangles) == pairs_of(pairs.triangles));
                    CHECK(pairs_of(list.edges) == pairs_of(pairs.edges));
                }
            }
        }
}

TEST_CASE("the Verlet lists of moving features are new ones") {
    Random random;
    const Features box = box_features();
    Sheet sheet(8);
    sheet.arrange(0, random);
    const Surface& s = sheet.surface;
    std::vector<double> x = sheet.x;
    plan::Pose pose = pose_at_center(random);
    FeatureVerletList list;
    FeaturePairs fresh;
    std::size_t largest = 0;
    Vec3<double> direction = random.vector();
    for (int step = 0; step < 600; ++step) {
        if (step % 100 == 0) direction = -1.0 * direction + 0.2 * random.vector();
        // Slow and fast motions take turns; so do a thickness and searches from other positions.
        const double speed = step % 100 < 90 ? 1e-3 : 5e-3, thickness = step < 300 ? 0.05 : 0.06;
        const std::vector<double> previous_x = x;
        const plan::Pose previous_pose = pose;
        for (std::size_t k = 0; k < x.size(); k += 4)
            for (int j = 0; j < 3; ++j) x[k + j] += 0.02 * speed * random.uniform();
        pose.position = pose.position + speed * direction;
        if (step % 60 == 59) {
            std::vector<double> shifted = x;
            for (double& coordinate : shifted) coordinate += 0.1;
            REQUIRE(list.find(s, shifted.data(), {box, pose}, thickness, 0.02));
        }
        MotionBound cloth;
        cloth.include(x.data(), previous_x.data(), s.count);
        const double motion = max_relative_motion(cloth, box, previous_pose, pose);
        const FeaturesAt from{box, pose};
        const double infinity = std::numeric_limits<double>::infinity();
        REQUIRE(list.update(s, x.data(), from, thickness, 2.0 * motion, step % 60 < 59 && step ? motion : infinity));
        fresh.build(s, from, x.data(), thickness + 2.0 * motion);
        CHECK(pairs_of(list.triangles) == pairs_of(fresh.triangles));
        CHECK(pairs_of(list.edges) == pairs_of(fresh.edges));
        largest = std::max(largest, fresh.size());
    }
    CHECK(largest > 20);
}

TEST_CASE("a point of an obstacle has the gaps of a particle there") {
    Random random;
    Sheet sheet(4);
    sheet.arrange(0, random);
    const Surface& s = sheet.surface;
    std::vector<Index> all(s.triangles.size());
    std::iota(all.begin(), all.end(), Index{0});
    constexpr double thickness = 0.2, damping = 2.0;
    Features point{{{0.0, 0.0, 0.0}}, {}};
    for (int round = 0; round < 50; ++round) {
        plan::Pose pose = pose_at_center(random);
        pose.position = Vec3<double>{0.15, 0.15, 0.05} + 0.04 * random.vector();
        const FeaturesAt from{point, pose};
        const auto still = [](Index) { return Vec3<double>{}; };
        const auto at = [&](Index c) { return sheet.at(c); };
        SurfaceLaw<double> law(thickness, damping, 0.01);
        Contact<double> m;
        law.particle(s, ~0, all.data(), all.data() + all.size(), with_point_positions(from, at),
                     with_point_velocities(from, still), m);
        REQUIRE(!m.gaps.empty());
        CHECK(m.has_feature);
        Vec3<double> total{}, on_point{};
        double power = 0.0;
        law.forces(m, [&](Index c, Vec3<double> force) {
            total = total + force;
            if (c < 0) on_point = on_point + force, power += dot(force, pose.velocity);
        });
        CHECK(norm2(total) <= 1e-24 * norm2(on_point));
        // The power of the force is the loss of energy and the dissipation.
        const double rate = m.mass * m.rate;
        CHECK(power == doctest::Approx(-rate - law.dissipation(m)).epsilon(1e-9));
        // With a radius the point is as near as a point on it.
        law.set_obstacle(0.01, full_thickness<double>());
        Contact<double> nearer;
        law.particle(s, ~0, all.data(), all.data() + all.size(), with_point_positions(from, at),
                     with_point_velocities(from, still), nearer);
        CHECK(nearer.min_gap() == doctest::Approx(m.min_gap() - 0.01));
        CHECK(law.energy(nearer) > law.energy(m));
    }
}

TEST_CASE("straight paths that intersect are detected, and others are not") {
    const std::array<Index, 4> corner{0, 1, 2, 3};
    const std::vector<Vec3<double>> triangle{{0.2, 0.2, 0.5}, {0.0, 0.0, 0.0}, {1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}};
    const std::vector<Vec3<double>> edges{{0.0, 0.0, 0.5}, {1.0, 0.0, 0.5}, {0.5, -1.0, 0.0}, {0.5, 1.0, 0.0}};
    const auto intersects = [&](auto is_edges, const std::vector<Vec3<double>>& from, int moving,
                                Vec3<double> displacement, double radius = 0.0) {
        return ccd_pair<is_edges()>(
            corner, radius, 1e-6, [&](Index c) { return from[c]; },
            [&](Index c) { return c < moving ? from[c] + displacement : from[c]; });
    };
    CHECK(intersects(std::false_type{}, triangle, 1, {0.0, 0.0, -1.0}));
    CHECK_FALSE(intersects(std::false_type{}, triangle, 1, {0.0, 0.0, -0.49}));
    CHECK(intersects(std::false_type{}, triangle, 1, {0.0, 0.0, -0.49}, 0.02));
    CHECK_FALSE(intersects(std::false_type{}, triangle, 1, {2.0, 2.0, -1.0}));
    CHECK(intersects(std::true_type{}, edges, 2, {0.0, 0.0, -1.0}));
    CHECK_FALSE(intersects(std::true_type{}, edges, 2, {0.0, 0.0, -0.49}));
    CHECK_FALSE(intersects(std::true_type{}, edges, 2, {3.0, 0.0, -1.0}));
    CHECK_FALSE(intersects(std::true_type{}, edges, 4, {0.0, 0.0, -1.0}));
}

TEST_CASE("a segment intersects a triangle within its border alone") {
    const Vec3<double> a{0.0, 0.0, 0.0}, b{1.0, 0.0, 0.0}, c{0.0, 1.0, 0.0};
    CHECK(segment_intersects({0.2, 0.2, 1.0}, {0.2, 0.2, -1.0}, a, b, c));
    CHECK(segment_intersects({0.2, 0.2, -1.0}, {0.2, 0.2, 1.0}, a, b, c));
    CHECK_FALSE(segment_intersects({0.2, 0.2, 1.0}, {0.2, 0.2, 0.1}, a, b, c));
    CHECK_FALSE(segment_intersects({0.8, 0.8, 1.0}, {0.8, 0.8, -1.0}, a, b, c));
}

}  // namespace cloth::tests
