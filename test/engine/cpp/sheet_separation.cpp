// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bound of a sheet's separation from itself against all pairs.
#include "contact/sheet_separation.hpp"

#include <algorithm>

#include "contact/obstacles.hpp"
#include "contact/self_contact.hpp"
#include "samples.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

enum Shape { flat, arch, wrinkled, folded, crumpled };

/// A sheet with a spacing of 0.1 m, alternating diagonals, positions and velocities (3, n).
struct MovingSheet {
    Surface surface;
    Index rows, columns;
    std::vector<double> x, v;
    SheetSeparation<double> separation;
    SheetSeparation<float> single;

    MovingSheet(Index r, Index c) : rows(r), columns(c) {
        surface.count = rows * columns;
        for (Index i = 0; i + 1 < rows; ++i)
            for (Index j = 0; j + 1 < columns; ++j) {
                const Index a = i * columns + j, b = a + 1, d = a + columns, e = d + 1;
                if ((i + j) % 2) {
                    surface.triangles.push_back({a, d, b});
                    surface.triangles.push_back({b, d, e});
                } else {
                    surface.triangles.push_back({a, e, b});
                    surface.triangles.push_back({d, e, a});
                }
            }
        surface.build_topology();
        x.assign(3 * surface.count, 0.0), v.assign(3 * surface.count, 0.0);
        separation.set(surface, rows, columns, 0.1, 0.1);
        single.set(surface, rows, columns, 0.1, 0.1);
    }
    void set(std::vector<double>& a, Index i, Vec3<double> p) {
        a[i] = p.x, a[surface.count + i] = p.y, a[2 * surface.count + i] = p.z;
    }
    void arrange(Shape shape, double speed, Random& random) {
        const Vec3<double> spin = random.vector(), drift = random.vector();
        for (Index i = 0; i < surface.count; ++i) {
            const double a = 0.1 * (i % columns), b = 0.1 * static_cast<double>(i / columns);
            Vec3<double> p{a, b, 0.0};
            if (shape == arch) p = {a, 0.3 * std::sin(b / 0.3), 0.3 * std::cos(b / 0.3)};
            if (shape == wrinkled) p = Vec3<double>{a, b, 0.06 * std::sin(9.0 * a)} + 0.015 * random.vector();
            if (shape == folded) p = {a, std::min(b, 1.0 - b), b > 0.5 ? 0.04 : 0.0};
            if (shape == crumpled) p = 0.3 * random.vector();
            set(x, i, p);
            set(v, i, speed * (drift + cross(spin, p) + 0.3 * random.vector()));
        }
    }
    /// Whether all pairs are found to stay `needed` apart for a duration.
    bool stays_apart(double duration, double needed) {
        return separation.separated_motions(x.data(), {{v.data(), duration}}, needed) == 1;
    }
    /// The same in single precision.
    bool stays_apart_in_single(double duration, double needed) {
        return single.separated_motions(x.data(), {{v.data(), duration}}, needed) == 1;
    }
    Vec3<double> at(Index i, double t) const {
        const std::int64_t n = surface.count;
        return {x[i] + t * v[i], x[n + i] + t * v[n + i], x[2 * n + i] + t * v[2 * n + i]};
    }
    /// Least distance of all pairs that share no particle, while all move at constant velocities.
    double min_distance(double duration) const {
        double square = 1e30;
        for (const double t : {0.0, 0.25 * duration, 0.5 * duration, 0.75 * duration, duration}) {
            for (const auto& c : surface.triangles)
                for (Index i = 0; i < surface.count; ++i)
                    if (i != c[0] && i != c[1] && i != c[2])
                        square =
                            std::min(square, near_triangle(at(i, t), at(c[0], t), at(c[1], t), at(c[2], t)).square);
            for (const auto& a : surface.edges)
                for (const auto& b : surface.edges)
                    if (a[0] != b[0] && a[0] != b[1] && a[1] != b[0] && a[1] != b[1])
                        square =
                            std::min(square, near_segments(at(a[0], t), at(a[1], t), at(b[0], t), at(b[1], t)).square);
        }
        return std::sqrt(square);
    }
};

}  // namespace

TEST_CASE("pairs that are found to stay apart do so, now, later and before") {
    Random random;
    int n_apart = 0, n_unclear = 0, n_apart_in_single = 0;
    for (const auto& [rows, columns] : {std::pair<Index, Index>{2, 2}, {2, 9}, {9, 2}, {5, 12}, {11, 10}})
        for (const Shape shape : {flat, arch, wrinkled, folded, crumpled})
            for (const double speed : {0.0, 0.2, 2.0}) {
                MovingSheet sheet(rows, columns);
                REQUIRE(sheet.separation.applies());
                sheet.arrange(shape, speed, random);
                for (const double duration : {0.02, -0.02}) {
                    const double distance = sheet.min_distance(duration);
                    for (const double needed : {0.004, 0.02, 0.05, distance}) {
                        const bool is_apart = sheet.stays_apart(duration, needed);
                        ++(is_apart ? n_apart : n_unclear);
                        if (is_apart) CHECK(distance >= needed);
                        const bool is_apart_in_single = sheet.stays_apart_in_single(duration, needed);
                        n_apart_in_single += is_apart_in_single;
                        // Single precision shows nothing that double precision would not.
                        CHECK(is_apart_in_single <= is_apart);
                        CHECK_FALSE(sheet.stays_apart(duration, 1.00001 * distance));
                    }
                }
            }
    // Neither is a matter of course.
    CHECK(n_apart > 120);
    CHECK(n_apart_in_single > n_apart - 10);
    CHECK(n_unclear > 100);
}

TEST_CASE("two cells of layers that touch nowhere else are found near each other") {
    constexpr Index rows = 8, columns = 8, half = columns / 2;
    int n_clear = 0;
    for (Index r = 0; r + 1 < rows; ++r)
        for (Index c = 0; c + 1 < half; ++c)
            for (Index r2 = 0; r2 + 1 < rows; ++r2)
                for (Index c2 = half; c2 + 1 < columns; ++c2) {
                    MovingSheet sheet(rows, columns);
                    for (Index i = 0; i < rows * columns; ++i) {
                        // Columns are folded, 0.3 m apart. A cell of each half is bent to the middle, one above the other.
                        const Index row = i / columns, column = i % columns;
                        const bool is_upper = column >= half;
                        const auto is_corner_of = [&](Index a, Index b) {
                            return (row == a || row == a + 1) && (column == b || column == b + 1);
                        };
                        Vec3<double> p{0.1 * (is_upper ? columns - 1 - column : column), 0.1 * row,
                                       is_upper ? 0.3 : 0.0};
                        if (is_corner_of(r, c)) p.z = 0.15;
                        if (is_corner_of(r2, c2))
                            p = {0.1 * c + 0.03 + 0.04 * (1 + c2 - column), 0.1 * r + 0.03 + 0.04 * (row - r2), 0.16};
                        sheet.set(sheet.x, i, p);
                    }
                    n_clear += sheet.stays_apart(0.0, 0.004) && sheet.stays_apart_in_single(0.0, 0.004);
                    CHECK_FALSE(sheet.stays_apart(0.0, 0.012));
                    CHECK_FALSE(sheet.stays_apart_in_single(0.0, 0.012));
                }
    // The work limit ends the other searches.
    CHECK(n_clear > 100);
}

TEST_CASE("a sheet that is far from itself is found so, and one near itself is not") {
    Random random;
    MovingSheet sheet(11, 10);
    for (const Shape shape : {flat, arch, wrinkled}) {
        sheet.arrange(shape, 0.0, random);
        CHECK(sheet.stays_apart(0.0, 0.02));
    }
    sheet.arrange(folded, 0.0, random);
    CHECK(sheet.stays_apart(0.0, 0.0347));
    CHECK_FALSE(sheet.stays_apart(0.0, 0.035));
    // Both halves approach each other at 1 m/s.
    for (Index i = 0; i < sheet.surface.count; ++i) sheet.set(sheet.v, i, {0.0, 0.0, i / 10 > 5 ? -0.5 : 0.5});
    CHECK(sheet.stays_apart(0.01, 0.02));
    CHECK_FALSE(sheet.stays_apart(0.03, 0.02));
}

TEST_CASE("in any direction, no speed closes the distance of pairs that are found to stay apart") {
    Random random;
    int n_apart = 0, n_along = 0;
    for (int k = 0; k < 40; ++k)
        for (const Shape shape : {flat, arch, wrinkled, crumpled})
            for (const double speed : {0.1, 0.5, 2.0}) {
                MovingSheet sheet(3, 4);
                sheet.arrange(shape, speed, random);
                const std::int64_t n = sheet.surface.count;
                const std::vector<double>& v = sheet.v;
                const auto at = [&](Index i) { return sheet.at(i, 0.0); };
                const auto velocity = [&](Index i) { return Vec3<double>{v[i], v[n + i], v[2 * n + i]}; };
                const double duration = 0.01;
                // Of all pairs, the distance less the way of their nearest points relative to each other.
                double least = 1e30;
                const auto include = [&](double square, Vec3<double> relative_velocity) {
                    least = std::min(least, std::sqrt(square) - duration * std::sqrt(norm2(relative_velocity)));
                };
                for (const auto& c : sheet.surface.triangles)
                    for (Index i = 0; i < n; ++i) {
                        if (i == c[0] || i == c[1] || i == c[2]) continue;
                        const auto nearest = near_triangle(at(i), at(c[0]), at(c[1]), at(c[2]));
                        Vec3<double> relative = velocity(i);
                        for (int corner = 0; corner < 3; ++corner)
                            relative = relative - nearest.weight[corner] * velocity(c[corner]);
                        include(nearest.square, relative);
                    }
                for (const auto& a : sheet.surface.edges)
                    for (const auto& b : sheet.surface.edges) {
                        if (a[0] == b[0] || a[0] == b[1] || a[1] == b[0] || a[1] == b[1]) continue;
                        const auto nearest = near_segments(at(a[0]), at(a[1]), at(b[0]), at(b[1]));
                        include(nearest.square, velocity(a[0]) + nearest.first * (velocity(a[1]) - velocity(a[0])) -
                                                    velocity(b[0]) -
                                                    nearest.second * (velocity(b[1]) - velocity(b[0])));
                    }
                for (const double needed : {0.004, 0.01, 0.02, 0.03, 0.05, 0.06}) {
                    const SheetMotion motion{v.data(), duration, nullptr, true};
                    const bool is_apart = sheet.separation.separated_motions(sheet.x.data(), {motion}, needed);
                    if (is_apart) CHECK(least >= needed);
                    if (sheet.single.separated_motions(sheet.x.data(), {motion}, needed)) CHECK(is_apart);
                    n_apart += is_apart;
                    n_along += !is_apart && sheet.stays_apart(duration, needed);
                }
            }
    CHECK(n_apart > 30);
    CHECK(n_along > 3);
}

TEST_CASE("motions are found separated together as they are one by one") {
    Random random;
    int n_mixed = 0;
    for (const Shape shape : {flat, arch, wrinkled, folded, crumpled})
        for (const double speed : {0.2, 1.0, 5.0}) {
            MovingSheet sheet(5, 12), other(5, 12);
            other.arrange(shape, 5.2 - speed, random);
            sheet.arrange(shape, speed, random);
            const double* const x = sheet.x.data();
            const SheetMotion first{other.v.data(), 0.01}, second{sheet.v.data(), -0.01};
            for (const double needed : {0.004, 0.01, 0.02, 0.05}) {
                unsigned alone = 0;
                for (int k = 0; k < 2; ++k)
                    alone |= sheet.separation.separated_motions(x, {k ? second : first}, needed) << k;
                CHECK(sheet.separation.separated_motions(x, {first, second}, needed) == alone);
                if (sheet.separation.is_clear(x, needed)) CHECK(sheet.stays_apart(0.0, needed));
                n_mixed += alone && alone != 3;
            }
        }
    CHECK(n_mixed > 3);
}

TEST_CASE("a part that passed another in a frame has not stayed separated") {
    Random random;
    MovingSheet sheet(11, 10);
    sheet.arrange(folded, 0.0, random);
    SelfContact self;
    self.surface = sheet.surface;
    self.set_sheet(11, 10, 0.1, 0.1);
    const double thickness = 0.004, duration = 0.02;
    CHECK(self.stays_separated(sheet.x.data(), sheet.v.data(), thickness, duration));
    const auto stayed = [&](double height, double middle_height, double deviation) {
        std::vector<double> middle = sheet.x, x = sheet.x;
        for (Index i = 60; i < sheet.surface.count; ++i) middle[2 * 110 + i] = middle_height, x[2 * 110 + i] = height;
        const std::vector<double> none(sheet.surface.count), deviations(sheet.surface.count, deviation);
        const double *const start = sheet.x.data(), *const end = x.data();
        const bool first = self.stayed_separated(start, middle.data(), end, {deviations, none}, thickness),
                   second = self.stayed_separated(start, middle.data(), end, {none, deviations}, thickness);
        return first && second;
    };
    CHECK(stayed(0.04, 0.04, 0.0));
    // From rest to rest, beyond the other half; and back.
    CHECK_FALSE(stayed(-0.04, 0.0, 0.0));
    CHECK_FALSE(stayed(0.04, -0.04, 0.0));
    // Its path deviates to where the other half is.
    CHECK(stayed(0.04, 0.04, 0.001));
    CHECK_FALSE(stayed(0.04, 0.04, 0.018));
}

TEST_CASE("a sheet has not stayed separated if two of its particles together may leave their paths") {
    Random random;
    MovingSheet sheet(11, 10);
    sheet.arrange(flat, 0.0, random);
    SelfContact self;
    self.surface = sheet.surface;
    self.set_sheet(11, 10, 0.1, 0.1);
    std::vector<double> x = sheet.x;
    CHECK(self.stayed_separated(sheet.x.data(), x.data(), 0.06, 0.004));
    CHECK_FALSE(self.stayed_separated(sheet.x.data(), x.data(), 0.07, 0.004));
    // A fold to the height of the other half, where it ends.
    for (Index i = 60; i < sheet.surface.count; ++i) sheet.set(x, i, sheet.at(109 - i, 0.0));
    CHECK_FALSE(self.stayed_separated(sheet.x.data(), x.data(), 0.0, 0.004));
}

TEST_CASE("single precision separates a sheet far from the origin as one at it") {
    Random random;
    MovingSheet sheet(11, 10);
    sheet.arrange(wrinkled, 0.2, random);
    CHECK(sheet.stays_apart_in_single(0.01, 0.02));
    for (double& coordinate : sheet.x) coordinate += 1e5;
    CHECK(sheet.stays_apart_in_single(0.01, 0.02));
}

TEST_CASE("layers whose boxes overlap everywhere end the search") {
    Random random;
    MovingSheet sheet(65, 65);
    sheet.arrange(flat, 0.0, random);
    // Folded in the middle, 8 mm apart, tilted by 45 degrees.
    for (Index i = 0; i < sheet.surface.count; ++i) {
        const double a = 0.1 * (i % 65), b = 0.1 * static_cast<double>(i / 65);
        const double along = std::min(b, 6.4 - b), height = b > 3.2 ? 0.008 : 0.0;
        sheet.set(sheet.x, i, {a, (along - height) * 0.7071, (along + height) * 0.7071});
    }
    CHECK_FALSE(sheet.stays_apart(0.0, 0.007));
}

TEST_CASE("numbers that are not finite are not clear") {
    Random random;
    MovingSheet sheet(5, 6);
    sheet.arrange(flat, 0.0, random);
    sheet.x[7] = std::numeric_limits<double>::quiet_NaN();
    CHECK_FALSE(sheet.stays_apart(0.01, 0.01));
    sheet.arrange(flat, 0.0, random);
    sheet.v[2 * 30 + 7] = std::numeric_limits<double>::infinity();
    CHECK_FALSE(sheet.stays_apart(0.01, 0.01));
}

TEST_CASE("a surface whose triangles are not halves of cells gets no bound") {
    MovingSheet sheet(4, 5);
    for (const auto& triangle : {std::array<Index, 3>{0, 2, 5}, std::array<Index, 3>{0, 1, 6}}) {
        Surface surface = sheet.surface;
        surface.triangles.push_back(triangle);
        sheet.separation.set(surface, 4, 5, 0.1, 0.1);
        CHECK_FALSE(sheet.separation.applies());
    }
    // Both diagonals of a cell.
    Surface surface;
    surface.count = 4;
    surface.triangles = {{0, 1, 2}, {0, 1, 3}};
    sheet.separation.set(surface, 2, 2, 0.1, 0.1);
    CHECK_FALSE(sheet.separation.applies());
}

}  // namespace cloth::tests
