// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Searches of a mesh, and bounds that exclude obstacles and blocks of particles before a search.
#include "contact/culling.hpp"

#include "samples.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

/// Vertices and triangles of an octahedron with half axes of 0.3, 0.2 and 0.1 m, in half of which a face is dented.
struct Solid {
    std::vector<double> positions;
    std::vector<std::int64_t> corners;

    explicit Solid(bool is_dented) {
        for (int axis = 0; axis < 3; ++axis)
            for (const double sign : {-1.0, 1.0})
                for (int c = 0; c < 3; ++c) positions.push_back(c == axis ? sign * (0.3 - 0.1 * axis) : 0.0);
        for (int x = 0; x < 2; ++x)
            for (int y = 2; y < 4; ++y)
                for (int z = 4; z < 6; ++z) {
                    const bool is_turned = (x + y + z) % 2 == 0;
                    const std::int64_t face[3] = {x, is_turned ? z : y, is_turned ? y : z};
                    if (is_dented && x == 0) {
                        const std::int64_t middle = static_cast<std::int64_t>(positions.size()) / 3;
                        for (int c = 0; c < 3; ++c)
                            positions.push_back(0.2 * (positions[3 * face[0] + c] + positions[3 * face[1] + c] +
                                                       positions[3 * face[2] + c]));
                        for (int k = 0; k < 3; ++k)
                            for (const std::int64_t corner : {face[k], face[(k + 1) % 3], middle})
                                corners.push_back(corner);
                    } else {
                        corners.insert(corners.end(), face, face + 3);
                    }
                }
    }
    Mesh mesh() const {
        return Mesh(static_cast<std::int64_t>(positions.size() / 3), positions.data(),
                    static_cast<std::int64_t>(corners.size() / 3), corners.data());
    }
    Vec3<double> vertex(std::int64_t k) const { return {positions[3 * k], positions[3 * k + 1], positions[3 * k + 2]}; }
    /// Squared distance of a point from the nearest of all triangles.
    double square(Vec3<double> p) const {
        double least = 1e300;
        for (std::size_t k = 0; k < corners.size(); k += 3)
            least = smaller(near_triangle(p, vertex(corners[k]), vertex(corners[k + 1]), vertex(corners[k + 2])).square,
                            least);
        return least;
    }
};

bool is_same(const SurfacePoint<double>& a, const SurfacePoint<double>& b) {
    return has_same_bits(a.gap, b.gap) && has_same_bits(a.normal.x, b.normal.x) &&
           has_same_bits(a.normal.y, b.normal.y) && has_same_bits(a.normal.z, b.normal.z);
}

/// Random path that starts at time 0.
std::vector<double> random_path(Random& random) {
    std::vector<double> path(plan::path_numbers, 0.0);
    for (int k = 1; k < 13; ++k) path[k] = random.uniform();
    path[16] = 1.0;
    for (int k = 17; k < 26; ++k) path[k] = random.uniform();
    return path;
}

}  // namespace

TEST_CASE("a search finds the nearest of all triangles, whatever the hint") {
    Random random;
    for (const bool is_dented : {false, true}) {
        const Solid solid(is_dented);
        const Mesh mesh = solid.mesh();
        Index last = 0;
        for (int round = 0; round < 2000; ++round) {
            // Near the planes and axes of symmetry several triangles are equally near.
            Vec3<double> p = 0.5 * random.vector();
            if (round % 3 == 1) p.y = 0.0;
            if (round % 3 == 2) p.x = p.z = 0.0;
            const SurfacePoint<double> point = nearest_on_mesh<double>(mesh, p, no_gap<double>);
            check_close(point.gap * point.gap, solid.square(p), 1e-9, 1e-3);
            Index random_hint = static_cast<Index>(random.below(static_cast<std::int64_t>(solid.corners.size() / 3)));
            CHECK(is_same(nearest_on_mesh<double>(mesh, p, no_gap<double>, &random_hint), point));
            CHECK(is_same(nearest_on_mesh<double>(mesh, p, no_gap<double>, &last), point));
            CHECK(last == random_hint);
        }
    }
}

TEST_CASE("a gap above the limit is a lower bound above it, others have the same bits") {
    Random random;
    const Solid solid(true);
    const Mesh mesh = solid.mesh();
    int n_far = 0;
    for (int round = 0; round < 2000; ++round) {
        const Vec3<double> p = 0.8 * random.vector();
        const double limit = random.uniform(0.0, 0.3);
        const SurfacePoint<double> exact = nearest_on_mesh<double>(mesh, p, no_gap<double>),
                                   limited = nearest_on_mesh<double>(mesh, p, limit);
        if (is_same(exact, limited)) continue;
        ++n_far;
        CHECK(limited.gap > limit);
        CHECK(limited.gap <= exact.gap);
        CHECK(norm2(limited.normal) == 0.0);
    }
    CHECK(n_far > 100);
}

TEST_CASE("the bounds of a block are below its gaps and above its speeds") {
    Random random;
    const Solid solid(false);
    const auto mesh = std::make_shared<const Mesh>(solid.mesh());
    const Obstacle obstacle{Shape::mesh, {}, 0.3, {}, -1, 0.0, mesh};
    for (int round = 0; round < 200; ++round) {
        alignas(64) double x[3 * contact_block], v[3 * contact_block], mass[contact_block];
        const Vec3<double> center = random.vector(), velocity = random.vector();
        const double size = random.uniform(0.0, 0.3);
        for (std::int64_t i = 0; i < contact_block; ++i) {
            const Vec3<double> p = center + size * random.vector(), u = velocity + size * random.vector();
            x[i] = p.x, x[contact_block + i] = p.y, x[2 * contact_block + i] = p.z;
            v[i] = u.x, v[contact_block + i] = u.y, v[2 * contact_block + i] = u.z;
            mass[i] = 1.0;
        }
        const PosedObstacle<double> posed(plan::pose_at(random_path(random).data(), random.uniform(0.0, 1.0)),
                                          obstacle);
        const Block<double> block{x, v, contact_block, mass, contact_block};
        const ScanResult<double> bound = bound_block(posed, obstacle, block);
        const auto scan = scan_block<Shape::mesh, true, double>(posed, obstacle.size, block, 0.003, 0.0).result();
        CHECK(bound.gap <= scan.gap);
        CHECK(bound.speed >= scan.speed);
        CHECK(bound.gap >= scan.gap - 2.0 * (obstacle.radius + size * std::sqrt(3.0)));
    }
}

TEST_CASE("an obstacle that is away from a ball stays away on its path") {
    Random random;
    constexpr double distance = 0.1;
    int n_away = 0;
    for (int round = 0; round < 500; ++round) {
        std::vector<double> x(3 * 9);
        for (double& number : x) number = 0.2 * random.uniform();
        const BoundingBall ball(x.data(), 9);
        Contacts contacts;
        contacts.obstacles.push_back({Shape::sphere, {0.1, 0.0, 0.0}, 0.1, {}});
        contacts.paths = random_path(random);
        // It starts far from the ball, and comes to it.
        for (int k = 1; k < 4; ++k) contacts.paths[k] *= 3.0, contacts.paths[k + 3] = -2.0 * contacts.paths[k];
        const double t = random.uniform(0.0, 0.5);
        if (!ball.is_away(contacts, 0, t, distance)) continue;
        ++n_away;
        for (double fraction = 0.0; fraction <= 1.0; fraction += 0.125)
            for (int i = 0; i < 9; ++i) {
                const Vec3<double> offset =
                    Vec3<double>{x[i], x[9 + i], x[18 + i]} - plan::pose_at(contacts.path(0), fraction * t).position;
                CHECK(root(norm2(offset)) - 0.1 > distance);
            }
        x[4] = std::numeric_limits<double>::quiet_NaN();
        CHECK_FALSE(BoundingBall(x.data(), 9).is_away(contacts, 0, t, distance));
    }
    CHECK(n_away > 50);
}

}  // namespace cloth::tests
