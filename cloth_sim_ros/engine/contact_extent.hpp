// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Where a cloth is and how fast, all of it at once: what is far from that is far from every particle.
#pragma once

#include "plan.hpp"

namespace cloth {

/// The largest speed of particles, anchored ones included.
inline double max_speed(const double* v, std::int64_t n) {
    using V = vec<double>;
    V max_square{};
    double square = 0.0;
    std::int64_t i = 0;
    for (; i + lanes<double> <= n; i += lanes<double>)
        max_square = larger(norm2(Vec3<V>{load(v + i), load(v + n + i), load(v + 2 * n + i)}), max_square);
    for (; i < n; ++i) square = larger(norm2(Vec3<double>{v[i], v[n + i], v[2 * n + i]}), square);
    for (int k = 0; k < lanes<double>; ++k) square = larger<double>(max_square[k], square);
    return root(square);
}

/// A ball about all particles, anchored ones included.
struct BoundingBall {
    Vec3<double> center;
    double radius;
    bool finite = true;  ///< whether all positions are: a place that is no number is beyond no ball

    BoundingBall(const double* x, std::int64_t n) {
        double low[3], high[3];
        for (int c = 0; c < 3; ++c) {
            low[c] = high[c] = x[c * n];
            range(x + c * n, n, low[c], high[c]);
        }
        const Vec3<double> lower{low[0], low[1], low[2]}, upper{high[0], high[1], high[2]};
        center = 0.5 * (lower + upper);
        radius = 0.5 * root(norm2(upper - lower));
    }
    /// How far all particles are from an obstacle at least [m]; roundings may take `blurred` from that.
    double distance_to(const Obstacle& obstacle, const PosedObstacle<double>& posed) const {
        const Vec3<double> offset = center - posed.position;
        if (obstacle.shape == Shape::plane) return dot(posed.rotation[2], offset) - radius;
        return root(norm2(offset)) - radius - obstacle.radius;
    }
    double rounding_margin(const PosedObstacle<double>& posed) const {
        return 64.0 * std::numeric_limits<double>::epsilon() * (root(norm2(center)) + root(norm2(posed.position)) + radius);
    }
    /// The largest speed as seen from an obstacle, of particles that are no faster than `fastest`.
    double max_relative_speed(double fastest, const PosedObstacle<double>& posed) const {
        return fastest + root(norm2(posed.velocity)) +
               root(norm2(posed.spin)) * (root(norm2(center - posed.position)) + radius);
    }

private:
    void range(const double* from, std::int64_t n, double& min, double& max) {
        using V = vec<double>;
        V low = splat<V>(min), high = splat<V>(max), nan_check{};
        double finite_check = 0.0;
        std::int64_t i = 0;
        for (; i + lanes<double> <= n; i += lanes<double>) {
            const V a = load(from + i);
            low = smaller(a, low);
            high = larger(a, high);
            nan_check = nan_check + (a - a);
        }
        for (; i < n; ++i) {
            min = smaller(from[i], min), max = larger(from[i], max);
            finite_check += from[i] - from[i];
        }
        for (int k = 0; k < lanes<double>; ++k) finite_check += nan_check[k];
        finite = finite && finite_check == 0.0;
        for (int k = 0; k < lanes<double>; ++k) min = smaller<double>(low[k], min), max = larger<double>(high[k], max);
    }
};

}  // namespace cloth
