// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Contacts of particles in runs against the law of one particle, and Verlet lists against new ones.
#include "contact/queries.hpp"
#include "contact/self_run.hpp"
#include "sheets.hpp"

namespace cloth::tests::self_gaps {

using namespace contact;

namespace {

constexpr double thickness = 0.06, damping = 2.0, duration = 1e-3;

/// Forces, quads, with row sums as fourth numbers; sums of their terms' sizes; and what else a step yields.
struct Step {
    std::vector<double> f, sizes = f;
    double dissipation = 0.0, growth_power = 0.0, approach_speed = 0.0;
};

/// A step by vectors, with the pairs of a list as candidates.
Step by_vectors(const Surface& s, const PairList& triangles, const std::vector<double>& x, const std::vector<double>& v,
                double range, const std::vector<Scaling<double>>& scalings) {
    Step step{std::vector<double>(4 * s.count, 0.0)};
    SurfaceLaw<double> law(thickness, damping);
    law.reduce(&scalings);
    SelfGaps gaps;
    SelfSums sums;
    gaps.set_candidates(s, triangles);
    // The second turn uses the memory of the first one.
    for (int turn = 0; turn < 2; ++turn) {
        std::fill(step.f.begin(), step.f.end(), 0.0);
        step.dissipation = step.growth_power = 0.0;
        gaps.find(x.data(), thickness, range);
        gaps.evaluate(ContactLaw<vec<double>>(thickness, damping), law, v.data());
        step.approach_speed = sums.include(gaps, s.count, thickness, duration);
        sums.finalize(s, law, &step.dissipation, step.growth_power);
        sums.add_forces(gaps, step.f.data());
    }
    return step;
}
/// The same by the law of each particle, with all triangles.
Step by_particles(const Sheet& sheet, const std::vector<double>& v, const std::vector<Scaling<double>>& scalings) {
    const Surface& s = sheet.surface;
    Step step{std::vector<double>(4 * s.count, 0.0)};
    SurfaceLaw<double> law(thickness, damping);
    law.reduce(&scalings);
    const Quads at{sheet.x.data()}, velocity{v.data()};
    Contact<double> m;
    for (Index i = 0; i < s.count; ++i) {
        std::vector<Index> triangles;
        for (std::size_t t = 0; t < s.triangles.size(); ++t)
            if (!s.has(t, i)) triangles.push_back(static_cast<Index>(t));
        law.particle(s, i, triangles.data(), triangles.data() + triangles.size(), at, velocity, m);
        law.forces(m, [&](Index c, Vec3<double> force) {
            const double terms[3] = {force.x, force.y, force.z};
            for (int k = 0; k < 3; ++k) {
                step.f[4 * c + k] += terms[k];
                step.sizes[4 * c + k] += std::sqrt(norm2(force));
            }
        });
        for (const auto& g : m.gaps)
            for (int k = 0; k < 4; ++k)
                if (!k || g.corner[k] != i) step.f[4 * g.corner[k] + 3] += g.sign * s.masses[i] * std::abs(g.weight[k]);
        step.dissipation += law.dissipation(m);
        step.growth_power += law.growth_power(m);
    }
    return step;
}
double largest(const std::vector<double>& numbers) {
    double most = 0.0;
    for (const double a : numbers) most = std::max(most, std::abs(a));
    return most;
}
std::vector<double> random_velocities(const Surface& s, Random& random) {
    std::vector<double> v(4 * s.count, 0.0);
    for (std::size_t k = 0; k < v.size(); ++k)
        if (k % 4 < 3) v[k] = random.uniform();
    return v;
}

}  // namespace

TEST_CASE("contacts by vectors are those of each particle's law") {
    Random random;
    for (const int kind : {1, 2})
        for (const bool joins : {false, true})
            for (const bool reduces : {false, true}) {
                Sheet sheet(12);
                Surface& s = sheet.surface;
                // In any order, and with any first corner.
                for (auto& t : s.triangles) {
                    std::rotate(t.begin(), t.begin() + random.below(3), t.end());
                    std::swap(t, s.triangles[random.below(std::ssize(s.triangles))]);
                }
                s.build_topology();
                sheet.arrange(kind, random);
                for (Index i = 0; i < s.count; ++i) s.masses[i] = random.uniform(0.01, 0.02);
                // Joined particles are next to each other, or far from each other.
                for (const auto& [i, j] : Pairs{{20, 21}, {30, 42}, {50, 100}})
                    if (joins) s.joined[j] = i, s.has_joints = true;
                std::vector<Scaling<double>> scalings;
                for (Index i = 0; i < s.count && reduces; ++i)
                    scalings.push_back({random.uniform(1.0, 3.0), random.uniform(-1.0, 0.0)});
                const std::vector<double> v = random_velocities(s, random);
                SurfacePairs pairs;
                pairs.build(s, sheet.x.data(), 0.08);
                const Step step = by_vectors(s, pairs.triangles, sheet.x, v, thickness, scalings);
                const Step expected = by_particles(sheet, v, scalings);
                REQUIRE(largest(expected.f) > 0.0);
                for (std::size_t k = 0; k < step.f.size(); ++k)
                    CHECK(std::abs(step.f[k] - expected.f[k]) <= 1e-11 * (expected.sizes[k] + (k % 4 == 3)));
                check_close(step.dissipation, expected.dissipation, 1e-9);
                check_close(step.growth_power, expected.growth_power, 1e-9);
                CHECK(step.dissipation > 0.0);
                CHECK((step.growth_power != 0.0) == reduces);
            }
}

TEST_CASE("candidates out of range don't change a bit") {
    Random random;
    for (const int kind : {1, 2}) {
        Sheet sheet(16);
        const Surface& s = sheet.surface;
        sheet.arrange(kind, random);
        const std::vector<double> v = random_velocities(s, random);
        SurfacePairs near, more;
        near.build(s, sheet.x.data(), 1.05 * thickness);
        more.build(s, sheet.x.data(), 2.5 * thickness);
        REQUIRE(more.triangles.size() > near.triangles.size() + 1000);
        const Step first = by_vectors(s, near.triangles, sheet.x, v, 1.05 * thickness, {});
        const Step second = by_vectors(s, more.triangles, sheet.x, v, 1.05 * thickness, {});
        for (std::size_t k = 0; k < first.f.size(); ++k) CHECK(has_same_bits(first.f[k], second.f[k]));
        CHECK(has_same_bits(first.dissipation, second.dissipation));
        CHECK(has_same_bits(first.approach_speed, second.approach_speed));
    }
}

TEST_CASE("particles that come near count by their speed") {
    Sheet sheet(4);
    Random random;
    sheet.arrange(0, random);
    // A particle of its own falls onto the middle of the sheet.
    Surface& s = sheet.surface;
    const Index falling = static_cast<Index>(s.count++);
    s.build_topology();
    s.masses.push_back(0.01);
    sheet.x.resize(4 * s.count, 0.0);
    std::vector<double> v(sheet.x.size(), 0.0);
    v[4 * falling + 2] = -2.0;
    SurfacePairs pairs;
    for (const double height : {1.01 * thickness, thickness + 1.9 * duration, thickness + 2.1 * duration}) {
        sheet.set_position(falling, {0.14, 0.13, height});
        pairs.build(s, sheet.x.data(), 2.0 * thickness);
        const Step step = by_vectors(s, pairs.triangles, sheet.x, v, 2.0 * thickness, {});
        CHECK(largest(step.f) == 0.0);
        check_close(step.approach_speed, height < thickness + 2.0 * duration ? 2.0 : 0.0, 1e-12);
    }
}

TEST_CASE("lists have no pairs where the nearest one is out of range") {
    Sheet sheet(4);
    Random random;
    sheet.arrange(0, random);
    Surface& s = sheet.surface;
    const Index falling = static_cast<Index>(s.count++);
    s.build_topology();
    sheet.x.resize(4 * s.count, 0.0);
    SelfVerletList lists(s, 0, true);
    // The last search found the particle, or did not.
    for (const double first_height : {0.05, 0.2})
        for (const double height : {0.03, 0.05, 0.07}) {
            sheet.set_position(falling, {0.14, 0.13, first_height});
            CHECK(lists.find(sheet.x.data(), 0.03, 0.03));
            CHECK((lists.triangles.size() > 0) == (first_height < 0.06));
            sheet.set_position(falling, {0.14, 0.13, height});
            CHECK(lists.has_no_pairs(sheet.x.data(), 0.03, 0.01) == (height > 0.04));
        }
}

TEST_CASE("no bit of a run depends on the age of its lists") {
    Random random;
    for (const int kind : {1, 2})
        for (const double reduced_gap : {0.01, 0.03}) {
            constexpr Index rows = 12;
            constexpr double d = 0.03;
            Sheet sheet(rows);
            sheet.arrange(kind, random);
            SelfVerletList lists[2] = {{sheet.surface, rows, true}, {sheet.surface, rows, false}};
            std::vector<Vec3<double>> rates;
            for (Index i = 0; i < sheet.surface.count; ++i) rates.push_back(reduced_gap * random.vector());
            SelfRun runs[2] = {{lists[0], d, damping, duration}, {lists[1], d, damping, duration}};
            double most = 0.0;
            for (int step = 0; step < 40; ++step) {
                std::vector<double> v(sheet.x.size(), 0.0);
                for (Index i = 0; i < sheet.surface.count; ++i) {
                    // All move by much, and each about a place of its own.
                    const double swing = std::sin(0.2 * step + i);
                    sheet.set_position(i, sheet.at(i) + Vec3<double>{0.05, 0.0, 0.01} + 0.1 * swing * rates[i]);
                    v[4 * i + 2] = 0.3 * swing;
                }
                std::vector<double> f[2];
                double dissipation[2] = {};
                for (int k = 0; k < 2; ++k) {
                    f[k].assign(sheet.x.size(), 0.0);
                    runs[k].add(step, sheet.x.data(), v.data(), f[k].data(), &dissipation[k]);
                    // A search between the steps, with another margin.
                    if (step % 7 == 3) CHECK(lists[k].find(sheet.x.data(), d, 0.1 * (step % 3) * d));
                }
                most = std::max(most, largest(f[0]));
                for (std::size_t i = 0; i < f[0].size(); ++i) CHECK(has_same_bits(f[0][i], f[1][i]));
                CHECK(has_same_bits(dissipation[0], dissipation[1]));
                if (step % 7 != 3) continue;
                CHECK(lists[0].triangles.first == lists[1].triangles.first);
                CHECK(lists[0].triangles.second == lists[1].triangles.second);
                CHECK(lists[0].edges.first == lists[1].edges.first);
                CHECK(lists[0].edges.second == lists[1].edges.second);
                CHECK(lists[0].has_no_pairs(sheet.x.data(), d, 0.2 * d) ==
                      lists[1].has_no_pairs(sheet.x.data(), d, 0.2 * d));
            }
            CHECK(most > 0.0);
            CHECK(runs[0].finish(sheet.x.data()) == runs[1].finish(sheet.x.data()));
            CHECK(has_same_bits(runs[0].gap(), runs[1].gap()));
            CHECK(has_same_bits(runs[0].bounds().omega2, runs[1].bounds().omega2));
            CHECK(has_same_bits(runs[0].bounds().damping, runs[1].bounds().damping));
        }
}

TEST_CASE("no bit of a run depends on runs that passed the same positions") {
    // A layer moves at another speed than the rest.
    Random random;
    for (const int kind : {1, 2})
        for (const int search : {0, 1, 3, 8}) {
            constexpr Index rows = 12;
            constexpr double d = 0.03;
            Sheet sheet(rows);
            sheet.arrange(kind, random);
            const std::vector<double> start = sheet.x;
            SelfVerletList lists[2] = {{sheet.surface, rows, true}, {sheet.surface, rows, false}};
            double most = 0.0;
            for (int pass = 0; pass < 8; ++pass) {
                SelfRun runs[2] = {{lists[0], d, damping, duration}, {lists[1], d, damping, duration}};
                const double speed = pass % 3 ? 0.008 : 0.006;
                for (int step = 0; step < 24; ++step) {
                    std::vector<double> v(sheet.x.size(), 0.0);
                    for (Index i = 0; i < sheet.surface.count; ++i) {
                        const bool moves = i >= sheet.surface.count / 2;
                        for (int c = 0; c < 3; ++c)
                            sheet.x[4 * i + c] = start[4 * i + c] + (c && moves ? speed * step : 0.0);
                        v[4 * i + 2] = moves ? 0.3 : 0.0;
                    }
                    std::vector<double> f[2];
                    for (int k = 0; k < 2; ++k) {
                        f[k].assign(sheet.x.size(), 0.0);
                        runs[k].add(step, sheet.x.data(), v.data(), f[k].data(), nullptr);
                        if (search && step % search == 0)
                            CHECK(lists[k].find(sheet.x.data(), d, (step % 5 ? 0.1 : 0.8) * d));
                    }
                    most = std::max(most, largest(f[0]));
                    for (std::size_t i = 0; i < f[0].size(); ++i) CHECK(has_same_bits(f[0][i], f[1][i]));
                    if (!search || step % search) continue;
                    CHECK(lists[0].triangles.first == lists[1].triangles.first);
                    CHECK(lists[0].triangles.second == lists[1].triangles.second);
                    CHECK(lists[0].edges.first == lists[1].edges.first);
                    CHECK(lists[0].edges.second == lists[1].edges.second);
                }
                CHECK(has_same_bits(runs[0].gap(), runs[1].gap()));
            }
            CHECK(most > 0.0);
        }
}

TEST_CASE("a surface that returns to earlier positions finds their pairs") {
    // Three parallel triangles. The second one touches the first or the third one, edges included: lists omit no near
    // pair, so no distance shows that they are of other positions.
    constexpr double d = 0.03;
    Surface s;
    s.count = 9;
    s.triangles = {{0, 1, 2}, {3, 4, 5}, {6, 7, 8}};
    s.build_topology();
    s.shortest = 0.1;
    s.masses.assign(9, 0.01), s.inverse.assign(9, 100.0), s.is_free.assign(9, 1);
    const auto positions = [&](double first, double third) {
        std::vector<double> x;
        for (const double height : {first, 0.0, third})
            for (const Vec3<double> p : {Vec3<double>{-0.1, -0.1, 0.0}, {0.2, -0.1, 0.0}, {-0.1, 0.2, 0.0}})
                x.insert(x.end(), {p.x, p.y, p.z + height, 0.0});
        return x;
    };
    SelfVerletList lists(s, 0, true);
    const std::vector<double> v(36, 0.0);
    for (int turn = 0; turn < 6; ++turn) {
        const bool is_first = turn % 2 == 0;
        const std::vector<double> x = is_first ? positions(-0.01, 9.0) : positions(-9.0, 0.01);
        const auto touches = [&](Index i) { return i / 3 == 1 || i / 3 == (is_first ? 0 : 2); };
        if (turn < 4) {
            std::vector<double> f(36, 0.0);
            SelfRun(lists, d, damping, duration).add(0, x.data(), v.data(), f.data(), nullptr);
            for (Index i = 0; i < s.count; ++i) CHECK((f[4 * i + 2] != 0.0) == touches(i));
        }
        CHECK(lists.find(x.data(), d, 0.0));
        CHECK(lists.triangles.size() > 0);
        for (const Index i : lists.triangles.first) CHECK(touches(i));
    }
}

TEST_CASE("edges that alone come near are found in time") {
    // Two triangles that stand on each other, edge on edge.
    constexpr double d = 0.03;
    Surface s;
    s.count = 6;
    s.triangles = {{0, 1, 2}, {3, 4, 5}};
    s.build_topology();
    s.shortest = 0.1;
    s.masses.assign(6, 0.01), s.inverse.assign(6, 100.0), s.is_free.assign(6, 1);
    const auto positions = [](double height) {
        return std::vector<double>{-0.1, 0.0,  0.0,    0.0, 0.1, 0.0, 0.0,    0.0, 0.0, 0.0, -0.2,         0.0,
                                   0.0,  -0.1, height, 0.0, 0.0, 0.1, height, 0.0, 0.0, 0.0, height + 0.2, 0.0};
    };
    const std::vector<double> v(24, 0.0);
    // Without other searches, with one of the middle list, and with one of the outer list.
    for (const double margin : {0.0, 0.2 * d, 1.5 * d}) {
        SelfVerletList lists(s, 0, true);
        SelfRun run(lists, d, damping, duration);
        std::vector<double> f(24, 0.0);
        int n_searches = 0;
        for (double height = 0.2; height > 0.0145; height -= 0.0005) {
            std::fill(f.begin(), f.end(), 0.0);
            run.add(0, positions(height).data(), v.data(), f.data(), nullptr);
            CHECK((f[2] != 0.0) == (height < 0.5 * d));
            if (!(margin > 0.0 && height < 0.1)) continue;
            CHECK(lists.find(positions(height).data(), d, margin));
            CHECK(lists.edges.size() == (height < 0.5 * d + margin ? 1 : 0));
            ++n_searches;
        }
        CHECK(f[2] < 0.0);
        CHECK((n_searches > 0) == (margin > 0.0));
        // At once far from each other and near again.
        for (const double height : {0.3, 0.02, 0.3, 0.02}) {
            CHECK(lists.find(positions(height).data(), d, 0.2 * d));
            CHECK(lists.edges.size() == (height < 0.1 ? 1 : 0));
            CHECK(lists.has_no_pairs(positions(height).data(), d, 0.2 * d) == (height > 0.1));
        }
        // Runs that begin there, in turn.
        for (const double height : {0.0145, 0.3, 0.0145, 0.3, 0.0145}) {
            SelfRun next(lists, d, damping, duration);
            std::fill(f.begin(), f.end(), 0.0);
            next.add(0, positions(height).data(), v.data(), f.data(), nullptr);
            CHECK((f[2] != 0.0) == (height < 0.5 * d));
        }
    }
}

}  // namespace cloth::tests::self_gaps
