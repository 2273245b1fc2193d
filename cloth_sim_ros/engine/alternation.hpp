// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Whether weak springs of a sheet may be taken at every second step only: the stability of that on an endless sheet.
//
// Impulses at every second step push fast waves in time with their own swing: a wave that turns by about a quarter in a
// step grows, unless damping takes more of it (the resonance of multiple-time-step methods; Schlick, Molecular Modeling
// and Simulation, 2nd ed., ch. 14). On a flat, evenly stretched, endless sheet every wave keeps to itself, so two steps
// are a matrix on x, v and the last two accelerations of one wave, of size 8 within the sheet's plane and 4 across.
#pragma once

#include <array>

#include "grid.hpp"
#include "held.hpp"

namespace cloth {

/// Waves along each axis that are looked at; even stretches at which the sheet has to be stable; shares of the step limit
/// that are tried.
inline constexpr int waves_along = 10;
inline constexpr double tried_stretches[2] = {1.0, 1.1}, tried_shares[4] = {0.96, 0.94, 0.92, 0.9};
/// Squarings of a matrix, and the size of the power relative to the number of steps, at which a wave counts as growing:
/// by some 5e-7 in two steps.
inline constexpr int squarings = 26;
inline constexpr double grown = 1e6;

/// Stiffness [1/s^2] and damping [1/s] of a wave, of the strong families and of the weak ones: within the plane, and
/// across it (where nothing is damped).
struct Wave {
    double stiffness[2][2][2] = {}, damping[2][2][2] = {}, across[2] = {};
};

inline Wave wave_of(const Grid& grid, double mass, double stretch, double down_step, double right_step) {
    Wave w;
    const double along_rows = grid.families[right].rest, along_columns = grid.families[down].rest;
    for (int f = 0; f < family_count; ++f) {
        const GridFamily& family = grid.families[f];
        if (!family.present) continue;
        const Ends e = family_ends[f];
        const int rows = e.row1 - e.row0, columns = e.column1 - e.column0;
        const double way[2] = {stretch * columns * along_rows, stretch * rows * along_columns};
        const double square = way[0] * way[0] + way[1] * way[1], length = root(square);
        // 4 sin^2 of half the phase, from sines and cosines by their series.
        const double phase = 0.5 * (down_step * rows + right_step * columns);
        const TurnFactors turn(phase * phase);
        const double sine = phase * turn.first, size = 4.0 * sine * sine / mass;
        const double side = family.stiffness * (1.0 / family.rest - 1.0 / length);
        const double axis = family.stiffness / family.rest - side;
        const int kind = family.weak ? 1 : 0;
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) {
                const double part = way[i] * way[j] / square;
                w.stiffness[kind][i][j] += size * (axis * part + (i == j ? side : 0.0));
                w.damping[kind][i][j] += size * family.damping * part;
            }
        w.across[kind] += size * side;
    }
    return w;
}

template <std::size_t N>
using Matrix = std::array<std::array<double, N>, N>;

template <std::size_t N>
inline Matrix<N> operator*(const Matrix<N>& a, const Matrix<N>& b) {
    Matrix<N> c{};
    for (std::size_t i = 0; i < N; ++i)
        for (std::size_t k = 0; k < N; ++k)
            for (std::size_t j = 0; j < N; ++j) c[i][j] = fma(a[i][k], b[k][j], c[i][j]);
    return c;
}

/// The leapfrog step on x, h v and h^2 times the accelerations of the last two steps, each of Axes numbers; stiffness in
/// units of 1/h^2 and damping of 1/h, so that all entries are of one size.
template <int Axes>
inline Matrix<4 * Axes> step_matrix(const double (&stiffness)[Axes][Axes], const double (&damping)[Axes][Axes]) {
    Matrix<4 * Axes> m{};
    for (int i = 0; i < Axes; ++i) {
        auto& a = m[2 * Axes + i];
        for (int j = 0; j < Axes; ++j) {
            a[j] = -stiffness[i][j];
            a[Axes + j] = -0.5 * stiffness[i][j] - damping[i][j];
            a[2 * Axes + j] = a[3 * Axes + j] = -0.25 * damping[i][j];
        }
        auto &x = m[i], &v = m[Axes + i];
        for (int j = 0; j < 4 * Axes; ++j) {
            const double one = j == Axes + i ? 1.0 : 0.0;
            v[j] = one + a[j];
            x[j] = (j == i ? 1.0 : 0.0) + 0.5 * one + 0.5 * v[j];
        }
        m[3 * Axes + i][2 * Axes + i] = 1.0;
    }
    return m;
}

/// Whether powers of a matrix stay bounded: by squaring it.
template <std::size_t N>
inline bool stays(Matrix<N> m) {
    double bound = grown;
    for (int k = 0; k < squarings; ++k) {
        m = m * m;
        bound *= 2.0;  // what drifts freely grows with time
        double size = 0.0;
        for (const auto& row : m)
            for (double entry : row) size = larger(size, absolute(entry));
        if (!(size <= bound)) return false;
    }
    return true;
}

template <int Axes>
inline bool wave_stays(const double (&strong)[Axes][Axes], const double (&weak)[Axes][Axes],
                       const double (&fast)[Axes][Axes], const double (&slow)[Axes][Axes], double h) {
    double alone[Axes][Axes], both[Axes][Axes], damping[Axes][Axes], more[Axes][Axes];
    for (int i = 0; i < Axes; ++i)
        for (int j = 0; j < Axes; ++j) {
            alone[i][j] = h * h * strong[i][j];
            both[i][j] = h * h * (strong[i][j] + 2.0 * weak[i][j]);
            damping[i][j] = h * fast[i][j];
            more[i][j] = h * (fast[i][j] + 2.0 * slow[i][j]);
        }
    return stays<4 * Axes>(step_matrix<Axes>(alone, damping) * step_matrix<Axes>(both, more));
}

/// Share of the leapfrog's step limit up to which weak families may be taken at every second step; 0 where they may not,
/// or nothing is known of it. `mass` is that of a particle within the sheet [kg].
inline double stable_share(const Grid& grid, double mass) {
    bool known = grid.families[right].present && grid.families[down].present && grid.has_weak();
    for (const GridFamily& family : grid.families) known = known && !(family.present && family.parity >= 0);
    if (!known) return 0.0;
    constexpr double pi = 3.141592653589793;
    std::vector<Wave> found[2];
    double limits[2];
    for (int s = 0; s < 2; ++s) {
        for (int i = -waves_along; i < waves_along; ++i)
            for (int j = 0; j < waves_along; ++j)
                found[s].push_back(wave_of(grid, mass, tried_stretches[s], (i + 0.5) * pi / waves_along,
                                           (j + 0.5) * pi / waves_along));
        // The largest step of plain leapfrog: h^2 K / 4 + h D / 2 has no eigenvalue above 1; by bisection.
        const auto fits = [&](double h) {
            for (const Wave& w : found[s]) {
                double m[2][2];
                for (int i = 0; i < 2; ++i)
                    for (int j = 0; j < 2; ++j)
                        m[i][j] = 0.25 * h * h * (w.stiffness[0][i][j] + w.stiffness[1][i][j]) +
                                  0.5 * h * (w.damping[0][i][j] + w.damping[1][i][j]);
                const double mean = 0.5 * (m[0][0] + m[1][1]), half = 0.5 * (m[0][0] - m[1][1]);
                if (!(mean + root(half * half + m[0][1] * m[0][1]) <= 1.0)) return false;
            }
            return true;
        };
        double low = 0.0, high = 1.0;
        while (fits(high) && high < 1e6) high *= 2.0;
        for (int k = 0; k < 60; ++k) {
            const double middle = 0.5 * (low + high);
            (fits(middle) ? low : high) = middle;
        }
        limits[s] = low;
    }
    for (double share : tried_shares) {
        bool good = true;
        for (int s = 0; s < 2 && good; ++s)
            for (const Wave& w : found[s]) {
                const double strong[1][1] = {{w.across[0]}}, weak[1][1] = {{w.across[1]}}, none[1][1] = {{0.0}};
                const double h = share * limits[s];
                good = wave_stays<2>(w.stiffness[0], w.stiffness[1], w.damping[0], w.damping[1], h) &&
                       wave_stays<1>(strong, weak, none, none, h);
                if (!good) break;
            }
        if (good) return share;
    }
    return 0.0;
}

}  // namespace cloth
