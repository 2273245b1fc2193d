// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Air on a regular sheet's cells, a row at a time: what the cells below a row take from each speed, then the forces on the
// row's particles by that of the four cells around each.
#pragma once

#include "grid_cells.hpp"
#include "list_forces.hpp"

namespace cloth {

/// Zeros between the components of a row of cells, and before the first: what lies left of the first cell.
template <class T>
inline constexpr std::int64_t air_gap = 64 / sizeof(T);
/// What is kept of a row of cells: area vectors, shares across and along.
template <class T>
inline std::int64_t air_row_size(std::int64_t pitch) {
    return air_gap<T> + 5 * (pitch + air_gap<T>);
}

template <class T>
struct AirPlace {
    const T *x[2], *v;  ///< positions of a row and the next one, velocities that damping sees
    const T* part;      ///< of each cell below it, see CellTable
    T* f;
    T *above, *below;   ///< what is kept of the cells above and below the row
    std::ptrdiff_t pitch, apart, length;  ///< from a component to the next, of particles and of cells; see RowPlace
};

/// Along: whether there is drag along the surface.
template <class T, bool Along>
__attribute__((noinline)) void look_at_cells(const AirPlace<T>& place, const double* common) {
    using V = vec<T>;
    const AirPlace<T> at = place;
    const auto air = law_params<Panel<4>, V>(nullptr, common);
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto point = [&](int row, int column) CLOTH_INLINED {
            const T* const from = at.x[row] + column + j;
            return Vec3<V>{load(from), load(from + at.pitch), load(from + 2 * at.pitch)};
        };
        const auto s = Panel<4>::shares(air, load(at.part + j), point(1, 1) - point(0, 0), point(1, 0) - point(0, 1));
        T* const to = at.below + j;
        store(to, s.n.x), store(to + at.apart, s.n.y), store(to + 2 * at.apart, s.n.z);
        store(to + 3 * at.apart, s.across);
        if constexpr (Along) store(to + 4 * at.apart, s.along);
    }
}

/// Add what the air does to a row's particles to their forces, and note the powers if Watched.
template <class T, bool Along, bool Watched>
__attribute__((noinline)) void add_air(const AirPlace<T>& place, const double* common, Powers* powers) {
    using V = vec<T>;
    const AirPlace<T> at = place;
    const auto air = law_params<Panel<4>, V>(nullptr, common);
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto three = [](const T* from, std::ptrdiff_t pitch) CLOTH_INLINED {
            return Vec3<V>{load(from), load(from + pitch), load(from + 2 * pitch)};
        };
        T* const to = at.f + j;
        const Vec3<V> v = three(at.v + j, at.pitch), u = v - air.wind;
        Vec3<V> f = three(to, at.pitch);
        V lost{}, given{};
        const auto take = [&](const T* from) CLOTH_INLINED {
            typename Panel<4>::template Shares<V> s{three(from, at.apart), load(from + 3 * at.apart), V{}};
            if constexpr (Along) s.along = load(from + 4 * at.apart);
            f = Panel<4>::add<Along>(s, u, f);
            if constexpr (!Watched) return;
            lost = lost - dot(v, Panel<4>::add<Along>(s, v, Vec3<V>{}));
            given = given - dot(v, Panel<4>::add<Along>(s, air.wind, Vec3<V>{}));
        };
        take(at.above + j - 1), take(at.above + j), take(at.below + j - 1), take(at.below + j);
        store(to, f.x), store(to + at.pitch, f.y), store(to + 2 * at.pitch, f.z);
        for (int k = 0; Watched && k < lanes<T>; ++k) {
            powers->lost[(j + k) & 15] += static_cast<double>(lost[k]);
            powers->given[(j + k) & 15] += static_cast<double>(given[k]);
        }
    }
}

/// Take one row of a sheet's cells, and add what air does to the row to its forces in the ring if it is the caller's
/// `own`. `kept` has room for two rows of cells, all zeros before the first; rows are taken in order. The powers are noted
/// if there are any.
template <class T>
inline void take_air(const RowPlace<T>& at, const T* part, const double* common, T* kept, std::int64_t row, bool own,
                     Powers* powers) {
    T *const even = kept + air_gap<T>, *const odd = even + air_row_size<T>(at.pitch);
    const AirPlace<T> place{{at.row[0] + position * at.pitch, at.row[1] + position * at.pitch},
                            at.row[0] + seen * at.pitch,
                            part,
                            at.ring[0],
                            row % 2 ? even : odd,
                            row % 2 ? odd : even,
                            at.pitch,
                            at.pitch + air_gap<T>,
                            at.length};
    const auto take = [&]<bool Along>(std::bool_constant<Along>) {
        look_at_cells<T, Along>(place, common);
        if (own && powers)
            add_air<T, Along, true>(place, common, powers);
        else if (own)
            add_air<T, Along, false>(place, common, nullptr);
    };
    if (common[1] > 0.0)
        take(std::true_type{});
    else
        take(std::false_type{});
}

}  // namespace cloth
