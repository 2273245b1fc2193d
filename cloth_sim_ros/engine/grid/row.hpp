// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Row loop of a regular sheet: forces of the springs of one row, and one leapfrog step of its particles.
//
// A row owns the springs that lead from it to the right and down. Their forces on this row and the next two are summed
// in three force rows. Rows are processed in order and none looks back. Therefore the force on a row is complete when
// its own springs are done, and its particles move at once: a step reads and writes each number once.
#pragma once

#include "grid/added_mass.hpp"
#include "laws/spring.hpp"

namespace cloth::grid {

using laws::Spring;

template <class T>
struct GridConstants {
    typename Spring::template Params<T> families[family_count];
    T drag, body_acceleration[3];
};
/// Add the force rows and the forces of the row's own springs, and advance the row by one step if it is `owned`;
/// otherwise only add the forces on the rows below. Families: a set of bits, one for each that exists. Air: whether the
/// row carries air along.
template <class T, unsigned Families, Mode M, bool Air>
inline void step_row(const RowView<T>& at, const GridConstants<T>& constants, const StepFactors<T>& motion,
                     bool owned) {
    using V = vec<T>;
    constexpr auto has = [](Family family) { return (Families >> family & 1) != 0; };
    constexpr bool damped = M == Mode::damped, uses_velocity = M != Mode::position_only;
    const std::ptrdiff_t pitch = at.pitch;
    const V none{};
    Vec3<V> previous01{none, none, none}, previous02 = previous01, previous11 = previous01;

    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto point = [&](int row, int column, int slot) CLOTH_INLINED {
            const T* from = at.row[row] + slot * pitch + j + column;
            return Vec3<V>{load(from), load(from + pitch), load(from + 2 * pitch)};
        };
        const auto position_of = [&](int row, int column) CLOTH_INLINED {
            return load_position(at.row[row] + position * pitch + j + column, pitch);
        };
        // Force on the first end of a family's springs.
        const auto spring_force = [&](Family family, const SplitPosition<V>& x0, Vec3<V> p0) CLOTH_INLINED {
            const Ends e = family_ends[family];
            const Vec3<V> d = position_of(e.row1, e.column1) - x0;
            Vec3<V> u{none, none, none};
            if constexpr (damped) u = point(e.row1, e.column1, damping_velocity) - p0;
            const auto& c = constants.families[family];
            const typename Spring::template Params<V> params{splat<V>(c.ks), splat<V>(c.k), splat<V>(c.c)};
            const T* const entry = at.entry + family * pitch + j;
            const V q = Spring::factor(params, d, u, damped), weight = load(entry + weights * pitch);
            if constexpr (sizeof(T) == 8)
                return (q * weight) * d;
            else
                return fma(q, weight, load(entry + corrections * pitch)) * d;
        };
        const auto add = [&](T* to, Vec3<V> f) CLOTH_INLINED {
            store(to + j, load(to + j) + f.x);
            store(to + pitch + j, load(to + pitch + j) + f.y);
            store(to + 2 * pitch + j, load(to + 2 * pitch + j) + f.z);
        };
        const auto shifted = [&]<int N>(Vec3<V>& previous, Vec3<V> current, std::integral_constant<int, N>)
                                 CLOTH_INLINED {
                                     const Vec3<V> r{shift<N>(previous.x, current.x), shift<N>(previous.y, current.y),
                                                     shift<N>(previous.z, current.z)};
                                     previous = current;
                                     return r;
                                 };
        constexpr std::integral_constant<int, 1> by_one;
        constexpr std::integral_constant<int, 2> by_two;

        const SplitPosition<V> x = position_of(0, 0);
        Vec3<V> p{none, none, none};
        if constexpr (uses_velocity) p = point(0, 0, damping_velocity);

        Vec3<V> force{load(at.force_rows[0] + j), load(at.force_rows[0] + pitch + j),
                      load(at.force_rows[0] + 2 * pitch + j)};
        if constexpr (has(down2)) {
            const Vec3<V> f = spring_force(down2, x, p);
            force = force + f;
            store(at.force_rows[2] + j, -f.x);
            store(at.force_rows[2] + pitch + j, -f.y);
            store(at.force_rows[2] + 2 * pitch + j, -f.z);
        } else {
            for (int c = 0; c < 3; ++c) store(at.force_rows[2] + c * pitch + j, none);
        }
        Vec3<V> below, right_neighbor{none, none, none};
        {
            const Vec3<V> f = spring_force(down, x, p);
            force = force + f;
            below = -f;
        }
        if constexpr (has(diagonal)) {
            const Vec3<V> f = spring_force(diagonal, x, p);
            force = force + f;
            below = below - shifted(previous11, f, by_one);
        }
        if constexpr (has(antidiagonal)) {
            const SplitPosition<V> x1 = position_of(0, 1);
            Vec3<V> p1{none, none, none};
            if constexpr (damped) p1 = point(0, 1, damping_velocity);
            const Vec3<V> f = spring_force(antidiagonal, x1, p1);
            right_neighbor = f;
            below = below - f;
        }
        add(at.force_rows[1], below);
        if (!owned) {
            continue;
        }
        {
            const Vec3<V> f = spring_force(right, x, p);
            force = force + f;
            right_neighbor = right_neighbor - f;
            force = force + shifted(previous01, right_neighbor, by_one);
        }
        if constexpr (has(right2)) {
            const Vec3<V> f = spring_force(right2, x, p);
            force = force + f;
            force = force - shifted(previous02, f, by_two);
        }

        const V mass = load(at.entry + inverse_mass * pitch + j), free = load(at.entry + freedom * pitch + j);
        const V drag = splat<V>(constants.drag);
        const V kick = splat<V>(motion.kick), drift = splat<V>(motion.drift);
        const auto acceleration = [&](int c, V f, V damping_v) CLOTH_INLINED {
            V field = splat<V>(constants.body_acceleration[c]);
            if constexpr (uses_velocity) field = fma(-drag, damping_v, field);
            return fma(free, field, mass * f);
        };
        const auto finish = [&](int c, V a) CLOTH_INLINED {
            T* const x_c = at.row[0] + c * pitch + j;
            if (sizeof(T) == 8 && at.accelerations) {
                store(at.accelerations + c * at.acceleration_pitch + j, a);
                return;
            }
            V v, low_v{};
            if constexpr (sizeof(T) == 8) {
                v = fma(kick, a, load(x_c + velocity * pitch));
            } else {
                // Kahan summation: constant accelerations would be rounded with one sign in each step.
                const V v_old = load(x_c + velocity * pitch);
                const V increment = fma(kick, a, load(x_c + low_velocity * pitch));
                v = v_old + increment;
                low_v = increment - (v - v_old);
                store(x_c + low_velocity * pitch, low_v);
            }
            store(x_c + velocity * pitch, v);
            if constexpr (uses_velocity) {
                const V previous_a = load(x_c + previous_acceleration * pitch);
                store(x_c + previous_acceleration * pitch, a);
                store(x_c + damping_velocity * pitch,
                      fma(splat<V>(motion.predict), a, fma(splat<V>(motion.predict_previous), previous_a, v)));
            }
            const V x_old = c == 0 ? x.high.x : c == 1 ? x.high.y : x.high.z;
            if constexpr (sizeof(T) == 8) {
                store(x_c, fma(drift, v, x_old));
            } else {
                // Kahan summation: the low part keeps what rounding leaves of the position.
                const V increment = fma(drift, v, fma(drift, low_v, load(x_c + low_position * pitch)));
                const V end = x_old + increment;
                store(x_c + low_position * pitch, increment - (end - x_old));
                store(x_c, end);
            }
        };
        if constexpr (Air) {
            const Vec3<V> a = laws::accelerated(
                load_block<T>(at.mass + j, pitch), mass,
                {acceleration(0, force.x, p.x), acceleration(1, force.y, p.y), acceleration(2, force.z, p.z)});
            finish(0, a.x), finish(1, a.y), finish(2, a.z);
        } else {
            finish(0, acceleration(0, force.x, p.x));
            finish(1, acceleration(1, force.y, p.y));
            finish(2, acceleration(2, force.z, p.z));
        }
    }
}

}  // namespace cloth::grid
