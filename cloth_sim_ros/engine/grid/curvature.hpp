// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Forces of the quadratic hinges of a regular sheet, row by row like its springs.
#pragma once

#include "grid/differences.hpp"
#include "grid/dispatch.hpp"

namespace cloth::grid {

using mesh::PowerSums;

/// Points N columns ahead.
template <int N, class V>
CLOTH_INLINE Vec3<V> shifted_left(const Vec3<V>& a, const Vec3<V>& next) {
    return {shift_left<N>(a.x, next.x), shift_left<N>(a.y, next.y), shift_left<N>(a.z, next.z)};
}
template <int N, class V>
CLOTH_INLINE SplitPosition<V> shifted_left(const SplitPosition<V>& a, const SplitPosition<V>& next) {
    const Vec3<V> low = sizeof(scalar<V>) == 8 ? Vec3<V>{} : shifted_left<N>(a.low, next.low);
    return {shifted_left<N>(a.high, next.high), low};
}

/// Add the forces of a row's differences; record the dissipation if Record. `rows`: sums of forces on this row and the
/// next two. The sum of this row goes to `f`, unless null, and those of the next two are added to and set.
template <class T, bool Damped, bool Record>
CLOTH_SCHEDULED void accumulate_differences(const RowView<T>& row_view, const T* stiffness, T damping_time,
                                            T* const* rows, T* f, PowerSums* powers) {
    using V = vec<T>;
    const RowView<T> at = row_view;
    const std::ptrdiff_t pitch = at.pitch;
    T *const first = rows[0], *const second = rows[1], *const third = rows[2];
    const V time = splat<V>(damping_time), two = splat<V>(2);
    const auto velocity_of = [&](int row, std::ptrdiff_t column) CLOTH_INLINED {
        const T* const from = at.row[row] + damping_velocity * pitch + column;
        return Vec3<V>{load(from), load(from + pitch), load(from + 2 * pitch)};
    };
    // In double precision with damping positions are those a damping time later. In single precision they have low parts,
    // so their differences are rounded less, and those of velocities are separate.
    const auto position_of = [&](int row, std::ptrdiff_t column) CLOTH_INLINED {
        SplitPosition<V> x = load_position(at.row[row] + position * pitch + column, pitch);
        if constexpr (Damped && sizeof(T) == 8) x.high = fma(time, velocity_of(row, column), x.high);
        return x;
    };
    constexpr bool needs_rates = Record || (Damped && sizeof(T) == 4);
    // Points of this row and the next one at the present vector of columns.
    SplitPosition<V> positions[2] = {position_of(0, 0), position_of(1, 0)};
    Vec3<V> velocities[2]{};
    if constexpr (needs_rates) velocities[0] = velocity_of(0, 0), velocities[1] = velocity_of(1, 0);
    Vec3<V> previous_along{}, previous_twist{};
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto three = [&](const T* from) CLOTH_INLINED {
            return Vec3<V>{load(from), load(from + pitch), load(from + 2 * pitch)};
        };
        const auto put = [&](T* to, Vec3<V> a)
                             CLOTH_INLINED { store(to, a.x), store(to + pitch, a.y), store(to + 2 * pitch, a.z); };
        // Differences between neighbours: of the row, of the row below, and downwards. In double precision columns ahead
        // are shifted from the next vector, which takes less time than to load them.
        Vec3<V> right0, right1, below, down0, down1;
        const auto differ = [&](auto* current, auto&& point) CLOTH_INLINED {
            auto x00 = current[0], x10 = current[1], x01 = x00, x02 = x00, x11 = x00;
            if constexpr (sizeof(T) == 8) {
                current[0] = point(0, j + lanes<T>), current[1] = point(1, j + lanes<T>);
                x01 = shifted_left<1>(x00, current[0]), x02 = shifted_left<2>(x00, current[0]);
                x11 = shifted_left<1>(x10, current[1]);
            } else {
                x00 = point(0, j), x10 = point(1, j);
                x01 = point(0, j + 1), x02 = point(0, j + 2), x11 = point(1, j + 1);
            }
            right0 = x01 - x00, right1 = x02 - x01;
            below = x11 - x10;
            down0 = x10 - x00, down1 = point(2, j) - x10;
        };
        const V along_k = load(stiffness + j), down_k = load(stiffness + pitch + j),
                twist_k = load(stiffness + 2 * pitch + j);
        V dissipation{};
        Vec3<V> rates[5]{};
        if constexpr (needs_rates) {
            differ(velocities, velocity_of);
            rates[0] = right0, rates[1] = right1, rates[2] = below, rates[3] = down0, rates[4] = down1;
        }
        if constexpr (Record) {
            dissipation = time * fma(along_k, norm2(right1 - right0),
                                     fma(down_k, norm2(down1 - down0), twist_k * norm2(below - right0)));
        }
        differ(positions, position_of);
        if constexpr (Damped && sizeof(T) == 4) {
            right0 = fma(time, rates[0], right0), right1 = fma(time, rates[1], right1);
            below = fma(time, rates[2], below);
            down0 = fma(time, rates[3], down0), down1 = fma(time, rates[4], down1);
        }
        const Vec3<V> along = along_k * (right1 - right0), down = down_k * (down1 - down0),
                      twisted = twist_k * (below - right0);
        const Vec3<V> along1{shift<1>(previous_along.x, along.x), shift<1>(previous_along.y, along.y),
                             shift<1>(previous_along.z, along.z)},
            along2{shift<2>(previous_along.x, along.x), shift<2>(previous_along.y, along.y),
                   shift<2>(previous_along.z, along.z)};
        const Vec3<V> twists =
            twisted - Vec3<V>{shift<1>(previous_twist.x, twisted.x), shift<1>(previous_twist.y, twisted.y),
                              shift<1>(previous_twist.z, twisted.z)};
        previous_along = along, previous_twist = twisted;
        if (f) put(f + j, three(f + j) + (three(first + j) + (fma(two, along1, -along - along2) - down - twists)));
        put(second + j, three(second + j) + fma(two, down, twists));
        put(third + j, -down);
        if constexpr (Record)
            for (int k = 0; k < lanes<T>; ++k) powers->dissipation[(j + k) & 15] += static_cast<double>(dissipation[k]);
    }
}

/// Process one row of differences, and add its complete sum to the force row of the sheet if the row is `owned`.
/// Dissipation is recorded if `powers` is not null.
template <class T>
inline void add_curvature_row(const CurvatureTable<T>& table, std::int64_t row, const RowView<T>& at, T* const* rows,
                              bool owned, PowerSums* powers) {
    const T time = static_cast<T>(table.time);
    T* const f = owned ? at.force_rows[0] : nullptr;
    if (time > T(0) && powers)
        accumulate_differences<T, true, true>(at, table.of(row), time, rows, f, powers);
    else if (time > T(0))
        accumulate_differences<T, true, false>(at, table.of(row), time, rows, f, nullptr);
    else
        accumulate_differences<T, false, false>(at, table.of(row), time, rows, f, nullptr);
}

}  // namespace cloth::grid
