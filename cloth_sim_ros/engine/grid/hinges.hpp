// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Hinges of a regular sheet, evaluated row by row like its springs.
//
// A row owns the elements whose topmost corner it contains. Their forces are summed in three force rows of their own,
// so that the sum of a row does not depend on other forces. Forces on corners further right are shifted there lane by
// lane: each particle's sum has one order, whatever the vector width.
#pragma once

#include "grid/dispatch.hpp"
#include "laws/hinge.hpp"

namespace cloth::grid {

using laws::Altitude, laws::Crossed, laws::law_params, mesh::PowerSums;

/// One row of elements: positions and damping velocities of three rows, and their forces.
template <class T>
struct HingeRow {
    const T *x[3], *v[3];
    T* f[3];
    const T* numbers;
    std::ptrdiff_t pitch, length;
};

/// Operands of the law for the elements of one stencil, from column j on.
template <class Law, class T>
struct HingeOperands {
    using V = vec<T>;
    Vec3<V> d[Law::corners - 1], u[Law::corners] = {};
    typename Law::template Params<V> params;

    CLOTH_INLINE HingeOperands(const HingeRow<T>& at, const Stencil& stencil, int index, std::ptrdiff_t j,
                               bool damped) {
        const auto differ = [&](const T* const(&rows)[3], auto&& load_point, Vec3<V>* to) CLOTH_INLINED {
            const auto point = [&](int c)
                                   CLOTH_INLINED { return load_point(rows[stencil.row[c]] + stencil.column[c] + j); };
            const auto first = point(0);
            for (int c = 1; c < Law::corners; ++c) to[c - 1] = point(c) - first;
        };
        differ(at.x, [&](const T* from) CLOTH_INLINED { return load_position(from, at.pitch); }, d);
        const auto three = [&](const T* from) CLOTH_INLINED {
            return Vec3<V>{load(from), load(from + at.pitch), load(from + 2 * at.pitch)};
        };
        if (damped) differ(at.v, three, u);
        V values[3];
        for (int p = 0; p < Law::params; ++p) values[p] = load(at.numbers + (index * Law::params + p) * at.pitch + j);
        params = law_params<Law, V>(values, nullptr);
    }
};

/// Whether an element has a corner in this row and column.
template <class Law>
constexpr bool has_corner(int row, int column) {
    for (int k = 0; k < n_stencils<Law::corners>; ++k)
        for (int c = 0; c < Law::corners; ++c)
            if (stencil_of<Law::corners>(k).row[c] == row && stencil_of<Law::corners>(k).column[c] == column)
                return true;
    return false;
}

/// Add the forces of a row's elements; record the dissipation if Record. All stencils are evaluated, absent elements
/// with zero coefficients: the particles are loaded once for all stencils, and forces are summed before they are
/// stored.
template <class Law, class T, bool Damped, bool Record>
CLOTH_SCHEDULED void accumulate_hinges(const HingeRow<T>& row, PowerSums* powers) {
    using V = vec<T>;
    constexpr int C = Law::corners;
    const HingeRow<T> at = row;
    Vec3<V> previous[3][3] = {};
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        Vec3<V> sum[3][3] = {};
        const auto add_stencil = [&]<int K>(std::integral_constant<int, K>) CLOTH_INLINED {
            constexpr Stencil stencil = stencil_of<Law::corners>(K);
            const HingeOperands<Law, T> operands(at, stencil, K, j, Damped);
            Vec3<V> f[C];
            Law::force(operands.params, operands.d, operands.u, f + 1, Damped);
            if constexpr (Record) {
                const V dissipation = Law::dissipation(operands.params, operands.d, operands.u);
                for (int k = 0; k < lanes<T>; ++k)
                    powers->dissipation[(j + k) & 15] += static_cast<double>(dissipation[k]);
            }
            f[0] = -f[1];
            for (int c = 2; c < C; ++c) f[0] = f[0] - f[c];
            for (int c = 0; c < C; ++c)
                sum[stencil.row[c]][stencil.column[c]] = sum[stencil.row[c]][stencil.column[c]] + f[c];
        };
        const auto put = [&]<int R>(std::integral_constant<int, R>) CLOTH_INLINED {
            T* const to = at.f[R] + j;
            Vec3<V> f{load(to), load(to + at.pitch), load(to + 2 * at.pitch)};
            const auto shifted = [&]<int N>(std::integral_constant<int, N>) CLOTH_INLINED {
                const Vec3<V> current = sum[R][N], before = previous[R][N];
                previous[R][N] = current;
                return Vec3<V>{shift<N>(before.x, current.x), shift<N>(before.y, current.y),
                               shift<N>(before.z, current.z)};
            };
            if constexpr (has_corner<Law>(R, 0)) f = f + sum[R][0];
            if constexpr (has_corner<Law>(R, 1)) f = f + shifted(std::integral_constant<int, 1>{});
            if constexpr (has_corner<Law>(R, 2)) f = f + shifted(std::integral_constant<int, 2>{});
            store(to, f.x), store(to + at.pitch, f.y), store(to + 2 * at.pitch, f.z);
        };
        [&]<int... K>(std::integer_sequence<int, K...>) CLOTH_INLINED {
            (add_stencil(std::integral_constant<int, K>{}), ...);
        }(std::make_integer_sequence<int, n_stencils<Law::corners>>{});
        put(std::integral_constant<int, 0>{});
        if constexpr (C == 4) put(std::integral_constant<int, 1>{});
        put(std::integral_constant<int, 2>{});
    }
}

/// Process one row of elements, and add its complete sum to the force row of the sheet if the row is `owned`.
/// `hinge_rows`: sums of this row and the next two; the last is cleared here. Dissipation is recorded if `powers` is
/// not null. Hinges are skipped if `multirate`.
template <class T>
inline void add_hinge_row(const std::vector<RowTable<T>>& tables, std::int64_t row, const RowView<T>& at,
                          T* const* hinge_rows, bool owned, PowerSums* powers, bool multirate) {
    std::fill(hinge_rows[2], hinge_rows[2] + 3 * at.pitch, T(0));
    for (const RowTable<T>& table : tables) {
        if (!table.has(row) || (multirate && table.kind != Kind::spring)) continue;
        HingeRow<T> row_data;
        for (int k = 0; k < 3; ++k) {
            row_data.x[k] = at.row[k] + position * at.pitch;
            row_data.v[k] = at.row[k] + damping_velocity * at.pitch;
            row_data.f[k] = hinge_rows[k];
        }
        row_data.numbers = table.of(row);
        row_data.pitch = at.pitch;
        row_data.length = at.length;
        const auto add = [&](auto law) {
            using Law = decltype(law);
            if (table.damped && powers)
                accumulate_hinges<Law, T, true, true>(row_data, powers);
            else if (table.damped)
                accumulate_hinges<Law, T, true, false>(row_data, nullptr);
            else
                accumulate_hinges<Law, T, false, false>(row_data, nullptr);
        };
        switch (table.kind) {
            case Kind::spring: add(Spring{}); break;
            case Kind::crossed: add(Crossed{}); break;
            default: add(Altitude{});
        }
    }
    for (std::ptrdiff_t j = 0; owned && j < 3 * at.pitch; j += lanes<T>)
        store(at.force_rows[0] + j, load(at.force_rows[0] + j) + load(hinge_rows[0] + j));
}

}  // namespace cloth::grid
