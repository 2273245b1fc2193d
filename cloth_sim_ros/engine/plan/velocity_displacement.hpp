// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Displacement that a velocity error causes later, by the Lanczos method (docs/derivations/time_stepping.md).
//
// With the stiffness K and A = M^-1 K, an error e of the velocities displaces particles by sin(t sqrt A) / sqrt A e.
// Within a time T its envelope is y = (A + 1/T^2)^(-1/2) e. After k steps from e, the Lanczos method approximates it by
// y = |e| Q f(H) e1 with the basis Q, the tridiagonal matrix H and f(a) = (max(a, 0) + 1/T^2)^(-1/2). In the norm of
// the masses this is a lower bound (Gauss's rule). With the last diagonal entry chosen so that H has the eigenvalue 0
// it is an upper bound (Radau's rule; Golub and Meurant, Matrices, Moments and Quadrature, 2010).
#pragma once

#include <algorithm>
#include <limits>

#include "laws/bound.hpp"
#include "plan/frame.hpp"
#include "plan/queries.hpp"

namespace cloth::plan {

/// Maximum number of steps, and the ratio of the bounds at which they end.
inline constexpr int max_lanczos_steps = 8;
inline constexpr double bounds_agree = 1.5;
/// Largest factor on the lower bound.
inline constexpr double max_reserve = 2.0;
/// Largest change of an element's vectors over which a difference of forces is taken, relative to their lengths. Across
/// a spring without tension, of length l and frequency w, a change c adds the false stiffness (w c/l)^2/2. The least
/// factor on the increment bounds rounding where corners coincide.
inline constexpr double max_relative_change = 1e-4, least_increment_factor = 1e-6;

/// Largest change of an element's vectors between positions x and y, (3, n), relative to their lengths.
inline double relative_change(const Plan& plan, const double* x, const double* y) {
    double square = 0.0;
    for (const List& list : plan.lists)
        for (std::int64_t e = 0; e < list.count && list.width > 2; ++e) {
            const std::int64_t* const p = list.corners.data() + e * list.width;
            for (int k = 1; k < list.width; ++k) {
                const Vec3<double> before = particle(x, plan.count, p[k]) - particle(x, plan.count, p[0]),
                                   after = particle(y, plan.count, p[k]) - particle(y, plan.count, p[0]);
                square = larger(norm2(after - before) / larger(norm2(before), laws::min_length2), square);
            }
        }
    return larger(turn_in_step(plan, x, y, 1, 1), root(square));
}

/// Inner product of vectors (3, n) weighted with masses, and with the mass blocks (6, n) of the air unless null. Eight
/// partial sums make the order of additions independent of the vector width.
inline double mass_product(const Plan& plan, const double* a, const double* b, const double* air) {
    constexpr std::int64_t n_sums = 8;
    const std::int64_t n = plan.count;
    double sums[n_sums] = {}, total = 0.0;
    for (int c = 0; c < 3; ++c) {
        const double *const p = a + c * n, *const q = b + c * n, *const m = plan.masses.data();
        std::int64_t i = 0;
        for (; i + n_sums <= n; i += n_sums)
            for (std::int64_t k = 0; k < n_sums; ++k) sums[k] = fma(m[i + k] * p[i + k], q[i + k], sums[k]);
        for (std::int64_t k = 0; i + k < n; ++k) sums[k] = fma(m[i + k] * p[i + k], q[i + k], sums[k]);
    }
    for (double sum : sums) total += sum;
    for (std::int64_t i = 0; air && i < n; ++i) {
        total += dot(particle(a, n, i), product(block_of(air, n, i), particle(b, n, i)));
    }
    return total;
}

/// Last diagonal entry with which a tridiagonal matrix of `size` + 1 rows has the eigenvalue 0; 0 if the first `size`
/// rows have eigenvalues below 0.
inline double radau_entry(const double* diagonal, const double* off_diagonal, int size) {
    double pivot = diagonal[0];
    for (int i = 1; i < size && pivot > 0.0; ++i)
        pivot = diagonal[i] - off_diagonal[i - 1] * off_diagonal[i - 1] / pivot;
    return pivot > 0.0 ? off_diagonal[size - 1] * off_diagonal[size - 1] / pivot : 0.0;
}

/// A number of the lower bound, and the same one of the upper bound.
using Bounds = CappedVector<double, 16>::type;

/// First columns of f(H) for the first `size` rows of a symmetric tridiagonal matrix, and for one row more, by cyclic
/// Jacobi rotations. Each rotation waits for the one before; therefore both matrices are rotated at once.
inline void envelope_columns(const double* diagonal, const double* off_diagonal, int size, double inverse_time2,
                             Bounds* column) {
    constexpr int most = max_lanczos_steps + 1;
    constexpr Bounds none = {}, one = {1.0, 1.0};
    Bounds h[most][most] = {}, u[most][most] = {};
    for (int i = 0; i <= size; ++i) {
        h[i][i] = Bounds{i < size ? diagonal[i] : 0.0, diagonal[i]};
        u[i][i] = one;
        if (i < size) h[i][i + 1] = h[i + 1][i] = Bounds{i + 1 < size ? off_diagonal[i] : 0.0, off_diagonal[i]};
    }
    constexpr int max_sweeps = 30;
    for (int sweep = 0; sweep < max_sweeps; ++sweep) {
        Bounds off = none, largest = none;
        for (int i = 0; i <= size; ++i) {
            largest = larger(largest, absolute(h[i][i]));
            for (int j = 0; j < i; ++j) off = larger(off, absolute(h[i][j]));
        }
        const auto finished = off <= 1e-15 * largest;
        if (!any(~finished)) break;
        for (int p = 0; p <= size; ++p)
            for (int q = p + 1; q <= size; ++q) {
                const auto is_zero = finished | (h[p][q] == none);
                const Bounds theta = (h[q][q] - h[p][p]) / (2.0 * h[p][q]);
                const Bounds slope = select(theta < none, -one, one) / (absolute(theta) + root(theta * theta + 1.0));
                const Bounds t = select(is_zero, none, slope), c = 1.0 / root(t * t + 1.0), s = t * c;
                const auto rotate = [&](Bounds& a, Bounds& b) {
                    const Bounds old = a;
                    a = c * old - s * b;
                    b = s * old + c * b;
                };
                for (int i = 0; i <= size; ++i) rotate(h[i][p], h[i][q]);
                for (int i = 0; i <= size; ++i) rotate(h[p][i], h[q][i]);
                for (int i = 0; i <= size; ++i) rotate(u[i][p], u[i][q]);
            }
    }
    std::fill(column, column + size + 1, none);
    for (int k = 0; k <= size; ++k) {
        const Bounds f = u[0][k] / root(larger(h[k][k], none) + inverse_time2);
        for (int i = 0; i <= size; ++i) column[i] += f * u[i][k];
    }
}

struct DisplacementEstimate {
    double displacement = 0.0;  ///< of the particle with the largest one [m]
    int evaluations = 0;        ///< force evaluations: one, and one more for each Lanczos step
};

/// Estimate the displacement that velocity errors (3, n) [m/s] cause within a time [s], at positions x: the geometric
/// mean of the bounds, at most `max_reserve` times the lower one. Contact, friction of bending, grips and forces in
/// Python are left out, because what they hold now may fly; without a part of K the result is larger.
inline DisplacementEstimate velocity_displacement(Plan& plan, double t, const double* x, const double* errors,
                                                  double time) {
    DisplacementEstimate estimate;
    const std::int64_t n = plan.count, size = 3 * n;
    Array<double> blocks(plan.has_added_mass() ? 6 * n : 0);
    const double* const air = blocks.empty() ? nullptr : blocks.data();
    if (air) mass_blocks(plan, x, blocks.data());
    const double first_norm = root(mass_product(plan, errors, errors, air)), inverse_time2 = 1.0 / (time * time);
    if (first_norm == 0.0) return estimate;
    if (!(first_norm < std::numeric_limits<double>::infinity())) return {std::numeric_limits<double>::infinity(), 0};
    double extent = 0.0;
    for (int c = 0; c < 3; ++c) {
        const auto [low, high] = std::minmax_element(x + c * n, x + (c + 1) * n);
        extent = larger(extent, *high - *low);
    }
    // Over this displacement [m] the difference of forces is exact to about 1e-5 N of the largest one in a sheet of
    // N x N particles. Smooth vectors have a smaller error, because neighbours move alike.
    const double increment = 1e-5 * (extent > 0.0 ? extent : 1.0);
    plan.lanczos_memory.resize((max_lanczos_steps + 6) * size);
    double *const at = plan.lanczos_memory.data(), *const here = at + size, *const there = here + size,
                  *const zeros = there + size, *const sum = zeros + size;
    std::fill(zeros, zeros + size, 0.0);
    elastic_accelerations(plan, t, x, zeros, here);
    const auto basis = [&](int k) { return sum + (k + 1) * size; };
    double diagonal[max_lanczos_steps + 1], off_diagonal[max_lanczos_steps];
    Bounds column[max_lanczos_steps + 1];
    const auto displacement = [&](int bound, int count) {
        for (std::int64_t i = 0; i < size; ++i) sum[i] = first_norm * column[0][bound] * basis(0)[i];
        for (int j = 1; j < count; ++j)
            for (std::int64_t i = 0; i < size; ++i) sum[i] = fma(first_norm * column[j][bound], basis(j)[i], sum[i]);
        return largest_distance(sum, zeros, n);
    };
    for (std::int64_t i = 0; i < size; ++i) basis(0)[i] = errors[i] / first_norm;
    for (int k = 0; k < max_lanczos_steps; ++k) {
        const double* const q = basis(k);
        double* const next = basis(k + 1);
        double scale = increment / largest_distance(q, zeros, n);
        const auto move = [&] {
            for (std::int64_t i = 0; i < size; ++i) at[i] = fma(scale, q[i], x[i]);
        };
        move();
        const double change = relative_change(plan, x, at);
        if (change > max_relative_change) {
            scale *= larger(max_relative_change / change, least_increment_factor);
            move();
        }
        const double slope = 1.0 / scale;
        elastic_accelerations(plan, t, at, zeros, there);
        for (std::int64_t i = 0; i < size; ++i) next[i] = slope * (here[i] - there[i]);
        diagonal[k] = mass_product(plan, next, q, air);
        for (std::int64_t i = 0; i < size; ++i) {
            next[i] = fma(-diagonal[k], q[i], next[i]);
            if (k) next[i] = fma(-off_diagonal[k - 1], basis(k - 1)[i], next[i]);
        }
        off_diagonal[k] = root(mass_product(plan, next, next, air));
        for (std::int64_t i = 0; i < size; ++i) next[i] /= off_diagonal[k];
        diagonal[k + 1] = radau_entry(diagonal, off_diagonal, k + 1);
        envelope_columns(diagonal, off_diagonal, k + 1, inverse_time2, column);
        const double lower = displacement(0, k + 1);
        estimate = {lower, k + 2};
        if (off_diagonal[k] < 1e-8 * (absolute(diagonal[k]) + inverse_time2)) break;
        const double upper = diagonal[k + 1] > 0.0 ? displacement(1, k + 2) : lower;
        if (upper > lower) estimate.displacement = smaller(root(lower) * root(upper), max_reserve * lower);
        if (upper <= bounds_agree * lower) break;
    }
    return estimate;
}

}  // namespace cloth::plan
