// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Drag of air on the cells of a sheet, row by row: first the coefficients of the cells below a row, then the forces on
// the particles of the row from the four cells around each.
#pragma once

#include "grid/cells.hpp"
#include "laws/panel.hpp"

namespace cloth::grid {

using laws::law_params, laws::Panel, mesh::PowerSums;

/// Zeros between the components of a row of cells, and before the first, for reads left of the first cell.
template <class T>
inline constexpr std::int64_t air_gap = 64 / sizeof(T);
/// Data of a row of cells: area vectors and their lengths, normal and tangential coefficients.
enum AirSlot : int { area_vector, normal_drag = 3, tangential_drag, area_length, air_slots };
template <class T>
inline std::int64_t air_row_size(std::int64_t pitch) {
    return air_gap<T> + air_slots * (pitch + air_gap<T>);
}
/// Data of the cells below a row in two rows of cells.
template <class T>
inline T* air_cells(T* cell_rows, std::int64_t pitch, std::int64_t row) {
    return cell_rows + air_gap<T> + (row & 1) * air_row_size<T>(pitch);
}

template <class T>
struct AirRow {
    const T *x[2], *v;     ///< positions of a row and the next one, damping velocities
    const T* panel_share;  ///< share of a corner in each cell below, see CellTable
    T* f;
    T *above, *below;                          ///< data of the cells above and below the row
    std::ptrdiff_t pitch, cell_pitch, length;  ///< distances between components, of particles and of cells; see RowView
};

/// Tangential: whether there is drag along the surface. Lengths: whether lengths of area vectors are stored.
template <class T, bool Tangential, bool Lengths>
CLOTH_SCHEDULED void compute_cells(const AirRow<T>& row, const double* common) {
    using V = vec<T>;
    const AirRow<T> at = row;
    const auto air = law_params<Panel<4>, V>(nullptr, common);
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto point = [&](int row, int column) CLOTH_INLINED {
            const T* const from = at.x[row] + column + j;
            return Vec3<V>{load(from), load(from + at.pitch), load(from + 2 * at.pitch)};
        };
        const auto s =
            Panel<4>::shares(air, load(at.panel_share + j), point(1, 1) - point(0, 0), point(1, 0) - point(0, 1));
        T* const to = at.below + j;
        store(to, s.n.x), store(to + at.cell_pitch, s.n.y), store(to + 2 * at.cell_pitch, s.n.z);
        store(to + normal_drag * at.cell_pitch, s.across);
        if constexpr (Tangential) store(to + tangential_drag * at.cell_pitch, s.along);
        if constexpr (Lengths) store(to + area_length * at.cell_pitch, s.length);
    }
}

/// Add the drag to the forces of a row's particles; record the powers if Record.
template <class T, bool Tangential, bool Record>
CLOTH_SCHEDULED void add_air(const AirRow<T>& row, const double* common, PowerSums* powers) {
    using V = vec<T>;
    const AirRow<T> at = row;
    const auto air = law_params<Panel<4>, V>(nullptr, common);
    for (std::ptrdiff_t j = 0; j < at.length; j += lanes<T>) {
        const auto three = [](const T* from, std::ptrdiff_t pitch) CLOTH_INLINED {
            return Vec3<V>{load(from), load(from + pitch), load(from + 2 * pitch)};
        };
        T* const to = at.f + j;
        const Vec3<V> v = three(at.v + j, at.pitch), u = v - air.wind;
        Vec3<V> f = three(to, at.pitch);
        V dissipation{}, external{};
        const auto add_cell = [&](const T* from) CLOTH_INLINED {
            typename Panel<4>::template DragShares<V> s{};
            s.n = three(from, at.cell_pitch), s.across = load(from + normal_drag * at.cell_pitch);
            if constexpr (Tangential) s.along = load(from + tangential_drag * at.cell_pitch);
            f = Panel<4>::add<Tangential>(s, u, f);
            if constexpr (!Record) return;
            dissipation = dissipation - dot(v, Panel<4>::add<Tangential>(s, v, Vec3<V>{}));
            external = external - dot(v, Panel<4>::add<Tangential>(s, air.wind, Vec3<V>{}));
        };
        add_cell(at.above + j - 1), add_cell(at.above + j), add_cell(at.below + j - 1), add_cell(at.below + j);
        store(to, f.x), store(to + at.pitch, f.y), store(to + 2 * at.pitch, f.z);
        for (int k = 0; Record && k < lanes<T>; ++k) {
            powers->dissipation[(j + k) & 15] += static_cast<double>(dissipation[k]);
            powers->external[(j + k) & 15] += static_cast<double>(external[k]);
        }
    }
}

/// Process one row of cells, and add the drag to the force row if the row is `owned`. `cell_rows` holds two rows of
/// cells, zero before the first. Rows are processed in order. Lengths of area vectors are stored if `has_mass`. Powers
/// are recorded if `powers` is not null.
template <class T>
inline void add_air_row(const RowView<T>& at, const T* panel_share, const double* common, T* cell_rows,
                        std::int64_t row, bool owned, bool has_mass, PowerSums* powers) {
    const AirRow<T> row_data{{at.row[0] + position * at.pitch, at.row[1] + position * at.pitch},
                             at.row[0] + damping_velocity * at.pitch,
                             panel_share,
                             at.force_rows[0],
                             air_cells(cell_rows, at.pitch, row + 1),
                             air_cells(cell_rows, at.pitch, row),
                             at.pitch,
                             at.pitch + air_gap<T>,
                             at.length};
    const auto process = [&]<bool Along>(std::bool_constant<Along>) {
        if (has_mass)
            compute_cells<T, Along, true>(row_data, common);
        else
            compute_cells<T, Along, false>(row_data, common);
        if (owned && powers)
            add_air<T, Along, true>(row_data, common, powers);
        else if (owned)
            add_air<T, Along, false>(row_data, common, nullptr);
    };
    if (common[1] > 0.0)
        process(std::true_type{});
    else
        process(std::false_type{});
}

}  // namespace cloth::grid
