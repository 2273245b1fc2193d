// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Where a cloth is and how fast, all of it at once: what is far from that is far from every particle.
#pragma once

#include "plan.hpp"

namespace cloth {

/// The largest speed of particles, anchored ones included.
inline double fastest_of(const double* v, std::int64_t n) {
    using V = vec<double>;
    V most{};
    double square = 0.0;
    std::int64_t i = 0;
    for (; i + lanes<double> <= n; i += lanes<double>)
        most = larger(norm2(Vec3<V>{load(v + i), load(v + n + i), load(v + 2 * n + i)}), most);
    for (; i < n; ++i) square = larger(norm2(Vec3<double>{v[i], v[n + i], v[2 * n + i]}), square);
    for (int k = 0; k < lanes<double>; ++k) square = larger<double>(most[k], square);
    return root(square);
}

/// A ball about all particles, anchored ones included.
struct Extent {
    Vec3<double> middle;
    double radius;
    bool finite = true;  ///< whether all positions are: a place that is no number is beyond no ball

    Extent(const double* x, std::int64_t n) {
        double low[3], high[3];
        for (int c = 0; c < 3; ++c) {
            low[c] = high[c] = x[c * n];
            range(x + c * n, n, low[c], high[c]);
        }
        const Vec3<double> least{low[0], low[1], low[2]}, most{high[0], high[1], high[2]};
        middle = 0.5 * (least + most);
        radius = 0.5 * root(norm2(most - least));
    }
    /// How far all particles are from an obstacle at least [m]; roundings may take `blurred` from that.
    double away(const Obstacle& obstacle, const Placed<double>& placed) const {
        const Vec3<double> way = middle - placed.place;
        if (obstacle.shape == Shape::plane) return dot(placed.rotation[2], way) - radius;
        return root(norm2(way)) - radius - obstacle.radius;
    }
    double blurred(const Placed<double>& placed) const {
        return 64.0 * std::numeric_limits<double>::epsilon() * (root(norm2(middle)) + root(norm2(placed.place)) + radius);
    }
    /// The largest speed as seen from an obstacle, of particles that are no faster than `fastest`.
    double seen(double fastest, const Placed<double>& placed) const {
        return fastest + root(norm2(placed.speed)) +
               root(norm2(placed.spin)) * (root(norm2(middle - placed.place)) + radius);
    }

private:
    void range(const double* from, std::int64_t n, double& least, double& most) {
        using V = vec<double>;
        V low = splat<V>(least), high = splat<V>(most), none{};
        double rest = 0.0;
        std::int64_t i = 0;
        for (; i + lanes<double> <= n; i += lanes<double>) {
            const V a = load(from + i);
            low = smaller(a, low);
            high = larger(a, high);
            none = none + (a - a);
        }
        for (; i < n; ++i) {
            least = smaller(from[i], least), most = larger(from[i], most);
            rest += from[i] - from[i];
        }
        for (int k = 0; k < lanes<double>; ++k) rest += none[k];
        finite = finite && rest == 0.0;
        for (int k = 0; k < lanes<double>; ++k) least = smaller<double>(low[k], least), most = larger<double>(high[k], most);
    }
};

}  // namespace cloth
