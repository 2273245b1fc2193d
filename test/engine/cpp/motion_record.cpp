// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of paths by the velocities that a run records.
#include "plan/motion_record.hpp"

#include <algorithm>
#include <cmath>

#include "samples.hpp"

namespace cloth::tests {

using namespace plan;

namespace {

constexpr std::int64_t n = 5, steps = 24;
constexpr double step = 1e-3, duration = steps * step;

/// Random motion of five particles: velocities at the start and after each step, and positions after each drift.
struct RandomMotion {
    std::vector<Vec3<double>> v[steps + 1], x[steps + 2];

    explicit RandomMotion(Random& random) {
        for (std::int64_t i = 0; i < n; ++i) {
            x[0].push_back(random.vector());
            v[0].push_back(random.vector());
            x[1].push_back(x[0][i] + 0.5 * step * v[0][i]);
            for (std::int64_t k = 1; k <= steps; ++k) {
                v[k].push_back(v[k - 1][i] + 0.3 * random.vector());
                x[k + 1].push_back(x[k][i] + (k < steps ? step : 0.5 * step) * v[k][i]);
            }
        }
    }
    /// Time of positions.
    static double time(std::int64_t k) {
        return k == 0 ? 0.0 : std::min((static_cast<double>(k) - 0.5) * step, duration);
    }
    std::vector<double> rows(const std::vector<Vec3<double>>& a) const {
        std::vector<double> out(3 * n);
        for (std::int64_t i = 0; i < n; ++i) out[i] = a[i].x, out[n + i] = a[i].y, out[2 * n + i] = a[i].z;
        return out;
    }
};

}  // namespace

TEST_CASE("changes of velocities bound by how much two particles leave their paths") {
    Random random;
    for (int sample = 0; sample < 50; ++sample) {
        const RandomMotion motion(random);
        const std::vector<double> x0 = motion.rows(motion.x[0]), v0 = motion.rows(motion.v[0]);
        MotionRecord record;
        record.record({.changes = true});
        record.start<double>(n, steps, step, 2, x0.data(), v0.data(), {});
        CHECK(std::equal(v0.begin(), v0.end(), record.start_velocities<double>()));
        for (std::int64_t k = 0; k < steps; ++k)
            for (std::int64_t i = 0; i < n; ++i) {
                const Vec3<double> change = motion.v[k + 1][i] - motion.v[0][i];
                VelocityBounds<vec<double>> bounds;
                bounds.include(Vec3<vec<double>>{splat<vec<double>>(change.x), splat<vec<double>>(change.y),
                                                 splat<vec<double>>(change.z)});
                record.include_changes<double>(static_cast<int>(i % 2), k, bounds);
            }
        double from_start = 0.0, from_chord = 0.0;
        for (std::int64_t i = 0; i < n; ++i)
            for (std::int64_t j = 0; j < i; ++j)
                for (std::int64_t k = 0; k < steps + 2; ++k) {
                    const auto relative = [&](const auto& a) { return a[i] - a[j]; };
                    const Vec3<double> at = relative(motion.x[k]), start = relative(motion.x[0]);
                    const double t = RandomMotion::time(k);
                    from_start = std::max(from_start, norm2(at - start - t * relative(motion.v[0])));
                    const Vec3<double> chord = relative(motion.x[steps + 1]) - start;
                    from_chord = std::max(from_chord, norm2(at - start - (t / duration) * chord));
                }
        CHECK(std::sqrt(from_start) <= record.max_relative_deviation());
        CHECK(std::sqrt(from_chord) <= 0.5 * duration * record.max_relative_change());
        // They are no more than a few times as large.
        CHECK(std::sqrt(from_start) > 0.2 * record.max_relative_deviation());
    }
}

}  // namespace cloth::tests
