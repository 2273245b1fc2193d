// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Added mass of air on the cells of a sheet, row by row: each cell adds its mass and its forces to the rows of its
// corners.
#pragma once

#include "grid/air.hpp"
#include "laws/added_mass.hpp"

namespace cloth::grid {

using laws::AddedMass, laws::law_params;

template <class T>
CLOTH_INLINE Sym3<vec<T>> load_block(const T* from, std::ptrdiff_t pitch) {
    return {load(from),
            load(from + pitch),
            load(from + 2 * pitch),
            load(from + 3 * pitch),
            load(from + 4 * pitch),
            load(from + 5 * pitch)};
}
template <class T>
CLOTH_INLINE void store_block(T* to, std::ptrdiff_t pitch, const Sym3<vec<T>>& b) {
    store(to, b.xx), store(to + pitch, b.yy), store(to + 2 * pitch, b.zz);
    store(to + 3 * pitch, b.xy), store(to + 4 * pitch, b.xz), store(to + 5 * pitch, b.yz);
}

/// Process the cells below a row: add their forces to the force rows of this row and the next one, and their mass to
/// `mass_rows` of this row, which is complete then; the blocks of the next row are set. `panel_share`: see CellTable.
/// Drag: whether `cells` has the data of `add_air_row`.
template <class T, bool Drag>
CLOTH_SCHEDULED void compute_mass_row(const RowView<T>& row_view, const T* panel_share, const double* common,
                                      const T* cells, T* const* mass_rows) {
    using V = vec<T>;
    const RowView<T> at = row_view;
    const auto air = law_params<AddedMass<4>, V>(nullptr, common);
    const std::ptrdiff_t pitch = at.pitch;
    const V full_share = AddedMass<4>::share(air);
    Vec3<V> previous[2]{};
    Sym3<V> previous_block{};
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto point = [&](int row, int column, int slot) CLOTH_INLINED {
            const T* const from = at.row[row] + slot * pitch + column + j;
            return Vec3<V>{load(from), load(from + pitch), load(from + 2 * pitch)};
        };
        const auto shifted = [](Vec3<V>& before, Vec3<V> current) CLOTH_INLINED {
            const Vec3<V> r{shift<1>(before.x, current.x), shift<1>(before.y, current.y),
                            shift<1>(before.z, current.z)};
            before = current;
            return r;
        };
        const auto add = [&](T* to, Vec3<V> f) CLOTH_INLINED {
            store(to + j, load(to + j) + f.x);
            store(to + pitch + j, load(to + pitch + j) + f.y);
            store(to + 2 * pitch + j, load(to + 2 * pitch + j) + f.z);
        };
        const Vec3<V> a = point(1, 1, position) - point(0, 0, position),
                      b = point(1, 0, position) - point(0, 1, position);
        const auto cell = [&]() CLOTH_INLINED {
            if constexpr (!Drag) return AddedMass<4>::normal(a, b);
            const T* const from = cells + j;
            const std::ptrdiff_t cell_pitch = pitch + air_gap<T>;
            return AddedMass<4>::normal(a, b, {load(from), load(from + cell_pitch), load(from + 2 * cell_pitch)},
                                        load(from + area_length * cell_pitch));
        }();
        const V share = select(load(panel_share + j) > V{}, full_share, V{});
        const Vec3<V> u[4] = {point(0, 0, damping_velocity) - air.wind, point(0, 1, damping_velocity) - air.wind,
                              point(1, 1, damping_velocity) - air.wind, point(1, 0, damping_velocity) - air.wind};
        Vec3<V> f[4];
        AddedMass<4>::add(share, cell, u, f);
        add(at.force_rows[0], f[0] + shifted(previous[0], f[1]));
        add(at.force_rows[1], f[3] + shifted(previous[1], f[2]));
        const Sym3<V> m = AddedMass<4>::block(share, cell), before = previous_block;
        previous_block = m;
        const Sym3<V> both{m.xx + shift<1>(before.xx, m.xx), m.yy + shift<1>(before.yy, m.yy),
                           m.zz + shift<1>(before.zz, m.zz), m.xy + shift<1>(before.xy, m.xy),
                           m.xz + shift<1>(before.xz, m.xz), m.yz + shift<1>(before.yz, m.yz)};
        const Sym3<V> above = load_block<T>(mass_rows[0] + j, pitch);
        store_block<T>(mass_rows[0] + j, pitch,
                       {above.xx + both.xx, above.yy + both.yy, above.zz + both.zz, above.xy + both.xy,
                        above.xz + both.xz, above.yz + both.yz});
        store_block<T>(mass_rows[1] + j, pitch, both);
    }
}

/// See `compute_mass_row`. `cells`: data of `add_air_row` of the cells below the row, or null.
/// `panel_share`: null without cells.
template <class T>
inline void add_mass_row(const RowView<T>& at, const T* panel_share, const double* common, const T* cells,
                         T* const* mass_rows) {
    if (!panel_share)
        std::fill_n(mass_rows[1], block_numbers * at.pitch, T(0));
    else if (cells)
        compute_mass_row<T, true>(at, panel_share, common, cells, mass_rows);
    else
        compute_mass_row<T, false>(at, panel_share, common, nullptr, mass_rows);
}

}  // namespace cloth::grid
