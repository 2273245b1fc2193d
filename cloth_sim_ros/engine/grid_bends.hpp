// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Hinges of a regular sheet, taken by rows as its springs are.
//
// A row owns the elements whose upmost corner it has. Their forces are summed in a ring of three rows of their own, so
// that a row's sum, complete once the row is taken, is the same whatever else acts. Vectors of forces on corners further
// right are moved there lane by lane: each particle's sum runs in one order, whatever the vectors' width.
#pragma once

#include "grid_takers.hpp"
#include "list_forces.hpp"

/// Laws of four corners have more numbers at hand than there are registers: GCC keeps fewer of them in memory where it may
/// put loads next to what needs them, and the loop takes a fifth less time. No bit depends on it: the order in which
/// numbers are loaded and calculated is no order of sums.
#if defined(__AVX2__) && !defined(__clang__)
#define CLOTH_SCHEDULED __attribute__((noinline, optimize("schedule-insns", "sched-pressure")))
#else
#define CLOTH_SCHEDULED __attribute__((noinline))
#endif

namespace cloth {

/// One row of elements: positions and velocities that damping sees begin here, three rows each, and forces go there.
template <class T>
struct BendPlace {
    const T *x[3], *v[3];
    T* f[3];
    const T* numbers;
    std::ptrdiff_t pitch, length;
};

/// What laws are told of elements of one way at columns j and on.
template <class Law, class T>
struct BendSight {
    using V = vec<T>;
    Vec3<V> d[Law::corners - 1], u[Law::corners] = {};
    typename Law::template Params<V> params;

    CLOTH_INLINE BendSight(const BendPlace<T>& at, const Lie& lie, int way, std::ptrdiff_t j, bool damped) {
        const auto differ = [&](const T* const(&rows)[3], Vec3<V>* to) CLOTH_INLINED {
            const auto point = [&](int c) CLOTH_INLINED {
                const T* const from = rows[lie.row[c]] + lie.column[c] + j;
                return Vec3<V>{load(from), load(from + at.pitch), load(from + 2 * at.pitch)};
            };
            const Vec3<V> first = point(0);
            for (int c = 1; c < Law::corners; ++c) to[c - 1] = point(c) - first;
        };
        differ(at.x, d);
        if (damped) differ(at.v, u);
        V number[3];
        for (int p = 0; p < Law::params; ++p) number[p] = load(at.numbers + (way * Law::params + p) * at.pitch + j);
        params = law_params<Law, V>(number, nullptr);
    }
};

/// Whether elements have a corner in this row and column.
template <class Law>
constexpr bool has_corner(int row, int column) {
    for (int k = 0; k < lies<Law>; ++k)
        for (int c = 0; c < Law::corners; ++c)
            if (lie_of<Law>(k).row[c] == row && lie_of<Law>(k).column[c] == column) return true;
    return false;
}

/// Add the forces of a row's elements, and note what damping takes if Watched. All ways are taken, those that are missing with zeros: in one piece the particles'
/// numbers are loaded once for all of them, and their forces are added up before any is stored.
template <class Law, class T, bool Damped, bool Watched>
CLOTH_SCHEDULED void add_bends(const BendPlace<T>& place, Powers* powers) {
    using V = vec<T>;
    constexpr int C = Law::corners;
    const BendPlace<T> at = place;
    Vec3<V> last[3][3] = {};
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        Vec3<V> sum[3][3] = {};
        const auto take = [&]<int K>(std::integral_constant<int, K>) CLOTH_INLINED {
            constexpr Lie lie = lie_of<Law>(K);
            const BendSight<Law, T> sight(at, lie, K, j, Damped);
            Vec3<V> f[C];
            Law::force(sight.params, sight.d, sight.u, f + 1, Damped);
            if constexpr (Watched) {
                const V lost = Law::lost(sight.params, sight.d, sight.u);
                for (int k = 0; k < lanes<T>; ++k) powers->lost[(j + k) & 15] += static_cast<double>(lost[k]);
            }
            f[0] = -f[1];
            for (int c = 2; c < C; ++c) f[0] = f[0] - f[c];
            for (int c = 0; c < C; ++c) sum[lie.row[c]][lie.column[c]] = sum[lie.row[c]][lie.column[c]] + f[c];
        };
        const auto put = [&]<int R>(std::integral_constant<int, R>) CLOTH_INLINED {
            T* const to = at.f[R] + j;
            Vec3<V> f{load(to), load(to + at.pitch), load(to + 2 * at.pitch)};
            const auto moved = [&]<int N>(std::integral_constant<int, N>) CLOTH_INLINED {
                const Vec3<V> now = sum[R][N], before = last[R][N];
                last[R][N] = now;
                return Vec3<V>{shift<N>(before.x, now.x), shift<N>(before.y, now.y), shift<N>(before.z, now.z)};
            };
            if constexpr (has_corner<Law>(R, 0)) f = f + sum[R][0];
            if constexpr (has_corner<Law>(R, 1)) f = f + moved(std::integral_constant<int, 1>{});
            if constexpr (has_corner<Law>(R, 2)) f = f + moved(std::integral_constant<int, 2>{});
            store(to, f.x), store(to + at.pitch, f.y), store(to + 2 * at.pitch, f.z);
        };
        [&]<int... K>(std::integer_sequence<int, K...>) CLOTH_INLINED {
            (take(std::integral_constant<int, K>{}), ...);
        }(std::make_integer_sequence<int, lies<Law>>{});
        put(std::integral_constant<int, 0>{});
        if constexpr (C == 4) put(std::integral_constant<int, 1>{});
        put(std::integral_constant<int, 2>{});
    }
}

/// Take one row of a sheet's elements: add its sum, now complete, to the forces in the sheet's ring if the row is the
/// caller's `own`. `ring` has this row's sums, the next one's and those of the one after; the last is begun here. What
/// damping takes is noted in `powers` if there are any. Hinges are left out where they are `sparse`.
template <class T>
inline void take_bends(const std::vector<RowTable<T>>& tables, std::int64_t row, const RowPlace<T>& at, T* const* ring,
                       bool own, Powers* powers, bool sparse) {
    std::fill(ring[2], ring[2] + 3 * at.pitch, T(0));
    for (const RowTable<T>& table : tables) {
        if (!table.has(row) || (sparse && table.kind != Kind::spring)) continue;
        BendPlace<T> place;
        for (int k = 0; k < 3; ++k) {
            place.x[k] = at.row[k] + position * at.pitch;
            place.v[k] = at.row[k] + seen * at.pitch;
            place.f[k] = ring[k];
        }
        place.numbers = table.of(row);
        place.pitch = at.pitch;
        place.length = at.length;
        const auto add = [&](auto law) {
            using Law = decltype(law);
            if (table.damped && powers)
                add_bends<Law, T, true, true>(place, powers);
            else if (table.damped)
                add_bends<Law, T, true, false>(place, nullptr);
            else
                add_bends<Law, T, false, false>(place, nullptr);
        };
        switch (table.kind) {
            case Kind::spring: add(Spring{}); break;
            case Kind::crossed: add(Crossed{}); break;
            default: add(Altitude{});
        }
    }
    for (std::ptrdiff_t j = 0; own && j < 3 * at.pitch; j += lanes<T>)
        store(at.ring[0] + j, load(at.ring[0] + j) + load(ring[0] + j));
}

}  // namespace cloth
