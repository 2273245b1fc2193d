// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Springs of a regular sheet as data, and the padded tables of the row loops.
#pragma once

#include <map>
#include <string>

#include "core/algebra.hpp"
#include "core/storage.hpp"

namespace cloth::grid {

/// Families of springs by their ends (row, column) relative to the owning row and column.
enum Family : int { right, down, diagonal, antidiagonal, right2, down2 };
inline constexpr int family_count = 6;
struct Ends {
    int row0, column0, row1, column1;
};
inline constexpr Ends family_ends[family_count] = {{0, 0, 0, 1}, {0, 0, 1, 0}, {0, 0, 1, 1},
                                                   {0, 1, 1, 0}, {0, 0, 0, 2}, {0, 0, 2, 0}};
/// Number of lower rows that a spring reaches at most.
inline constexpr int row_reach = 2;

/// Components of a padded row: positions, velocities, damping velocities, previous accelerations and, in single
/// precision, the low parts of positions and velocities: what rounding leaves of them.
enum Slot : int {
    position = 0,
    velocity = 3,
    damping_velocity = 6,
    previous_acceleration = 9,
    low_position = 12,
    low_velocity = 15
};
template <class T>
inline constexpr int components = sizeof(T) == 4 ? 18 : 12;

/// Components of a mass block: xx, yy, zz, xy, xz, yz.
inline constexpr int block_numbers = 6;

/// Low part of a value: what rounding to the high part leaves.
template <class T>
inline T low_part(double value, T high) {
    return static_cast<T>(value - static_cast<double>(high));
}
/// Sum of both parts of a position or velocity at the end of a run; in single precision the change is added to the initial
/// one.
template <class T>
inline double final_sum(double initial, double origin, T high, T low) {
    if constexpr (sizeof(T) == 8) return high;
    const T high0 = static_cast<T>(initial - origin), low0 = low_part(initial - origin, high0);
    return initial + ((static_cast<double>(high) - static_cast<double>(high0)) +
                      (static_cast<double>(low) - static_cast<double>(low0)));
}

/// Positions of a vector of particles.
template <class V>
struct SplitPosition {
    Vec3<V> high, low;
    /// The difference of two high parts is rounded relative to itself, so that the low parts are of use.
    friend CLOTH_INLINE Vec3<V> operator-(const SplitPosition& a, const SplitPosition& b) {
        if constexpr (sizeof(scalar<V>) == 8)
            return a.high - b.high;
        else
            return (a.high - b.high) + (a.low - b.low);
    }
};
/// Load positions; `from`: the first component, components `pitch` numbers apart.
template <class T>
CLOTH_INLINE SplitPosition<vec<T>> load_position(const T* from, std::ptrdiff_t pitch) {
    SplitPosition<vec<T>> x{{load(from), load(from + pitch), load(from + 2 * pitch)}, {}};
    if constexpr (sizeof(T) == 4) {
        const T* const low = from + (low_position - position) * pitch;
        x.low = {load(low), load(low + pitch), load(low + 2 * pitch)};
    }
    return x;
}

/// Slots of a table entry: 1/m, one for free particles, the weights of the families and, in single precision, their
/// weighted corrections.
inline constexpr int inverse_mass = 0, freedom = 1, weights = 2, corrections = weights + family_count;
template <class T>
inline constexpr int table_slots = sizeof(T) == 4 ? corrections + family_count : corrections;

/// Dependence of the forces on velocity.
enum class Mode { position_only, drag, damped };

/// Factors of one step: v += kick a; damping velocity = v + predict a + predict_previous a_previous; x += drift v.
template <class T>
struct StepFactors {
    T kick, predict, predict_previous, drift;
};

template <class T>
struct RowView {
    T* row[3];
    T* force_rows[3];
    const T* entry;
    /// Distance between components of a row, and number of columns rounded up to whole vectors.
    std::ptrdiff_t pitch, length;
    /// Output of accelerations, components `acceleration_pitch` numbers apart, of a row that is only evaluated; null
    /// for one that moves. In double precision only.
    T* accelerations = nullptr;
    std::ptrdiff_t acceleration_pitch = 0;
    /// Mass blocks of the air at the row, six components, or null without.
    T* mass = nullptr;
};

/// Springs of a sheet with the same direction. k_s [N], rest length [m], c [N s/m]; `border`: factor for threads along
/// the border; `parity`: 0 or 1 keeps the cells with even or odd row + column, -1 keeps all.
struct GridFamily {
    bool present = false;
    double stiffness = 0.0, rest_length = 1.0, damping = 0.0, border = 1.0;
    int parity = -1;
    /// Correction of a spring's factor k - k_s / |d| [N/m]. Rounding k_s and k changes the rest length, and all springs
    /// would pull alike.
    template <class T>
    double correction() const {
        return static_cast<double>(static_cast<T>(stiffness)) / rest_length -
               static_cast<double>(static_cast<T>(stiffness / rest_length));
    }
};

struct Grid {
    std::int64_t rows = 0, columns = 0;
    GridFamily families[family_count];

    std::int64_t count() const { return rows * columns; }
    bool damped() const {
        for (const GridFamily& f : families)
            if (f.present && f.damping > 0.0) return true;
        return false;
    }
    /// Factor of a family's spring at a row and column; zero if there is none.
    double weight(int family, std::int64_t row, std::int64_t column) const {
        const GridFamily& f = families[family];
        const Ends e = family_ends[family];
        const int across = std::max(e.column0, e.column1);
        if (!f.present || row + e.row1 >= rows || column + across >= columns) return 0.0;
        if (f.parity >= 0 && (row + column) % 2 != f.parity) return 0.0;
        const bool edge =
            (e.row1 == 0 && (row == 0 || row == rows - 1)) || (across == 0 && (column == 0 || column == columns - 1));
        return edge ? f.border : 1.0;
    }
    /// Families with springs, as bits for `step_row`. Border springs count as present although their weights may be
    /// zero.
    unsigned shape() const {
        unsigned bits = 1u << right | 1u << down;
        for (int f = diagonal; f < family_count; ++f)
            if (families[f].present) bits |= 1u << f;
        if (bits & (1u << right2 | 1u << down2)) bits |= 1u << right2 | 1u << down2;
        return bits;
    }
};

/// Distance between the components of a padded row, in numbers. It covers the neighbours two columns on and is an odd
/// number of cache lines, so that components do not map to the same cache set.
template <class T>
inline std::int64_t row_pitch(std::int64_t columns) {
    constexpr std::int64_t line = 64 / sizeof(T);
    return ((columns + row_reach + line - 1) / line | 1) * line;
}
template <class T>
inline std::int64_t row_length(std::int64_t columns) {
    return (columns + lanes<T> - 1) / lanes<T> * lanes<T>;
}

/// Entries of inverse masses, freedom and weights; equal rows share one. A further entry of zeros is for rows outside
/// the sheet.
template <class T>
struct GridTables {
    std::int64_t pitch = 0;
    Array<T> numbers;
    std::vector<std::int64_t> entry;  ///< offset of each row's entry
    std::int64_t outside = 0;

    GridTables() = default;
    GridTables(const Grid& grid, const double* inverse) : pitch(row_pitch<T>(grid.columns)) {
        const std::int64_t size = table_slots<T> * pitch, padding = 64 / sizeof(T);
        numbers.assign(padding, T(0));
        std::map<std::string, std::int64_t> entries;
        std::vector<T> slots(size);
        const auto store_entry = [&] {
            const std::string key(reinterpret_cast<const char*>(slots.data()), size * sizeof(T));
            const auto [it, added] = entries.try_emplace(key, static_cast<std::int64_t>(numbers.size()));
            if (added) numbers.insert(numbers.end(), slots.begin(), slots.end());
            return it->second;
        };
        outside = store_entry();
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            std::fill(slots.begin(), slots.end(), T(0));
            for (std::int64_t column = 0; column < grid.columns; ++column) {
                const double mass = inverse[row * grid.columns + column];
                slots[inverse_mass * pitch + column] = static_cast<T>(mass);
                slots[freedom * pitch + column] = mass > 0.0 ? T(1) : T(0);
                for (int f = 0; f < family_count; ++f) {
                    const double weight = grid.weight(f, row, column);
                    slots[(weights + f) * pitch + column] = static_cast<T>(weight);
                    if constexpr (sizeof(T) == 4)
                        slots[(corrections + f) * pitch + column] =
                            static_cast<T>(weight * grid.families[f].template correction<T>());
                }
            }
            entry.push_back(store_entry());
        }
        numbers.insert(numbers.end(), padding, T(0));
    }
    const T* of(std::int64_t row) const {
        const bool inside = row >= 0 && row < static_cast<std::int64_t>(entry.size());
        return numbers.data() + (inside ? entry[row] : outside);
    }
};

/// Positions (and velocities) in padded rows, with space for the neighbours of border particles. In single precision
/// positions are relative to the first particle.
template <class T>
struct PaddedRows {
    std::int64_t pitch, stride;
    Array<T> numbers;
    PaddedRows(const Grid& grid, const double* x, const double* v)
        : pitch(row_pitch<T>(grid.columns)), stride((v ? 6 : 3) * pitch) {
        numbers.assign((grid.rows + 2 * row_reach) * stride + 32, T(0));
        const std::int64_t n = grid.count();
        for (std::int64_t row = 0; row < grid.rows; ++row)
            for (int c = 0; c < (v ? 6 : 3); ++c) {
                const double* const from = (c < 3 ? x + c * n : v + (c - 3) * n) + row * grid.columns;
                const double origin = sizeof(T) == 4 && c < 3 ? x[c * n] : 0.0;
                T* const to = at(row, c);
                for (std::int64_t j = 0; j < grid.columns; ++j) to[j] = static_cast<T>(from[j] - origin);
            }
    }
    T* at(std::int64_t row, int component) {
        return numbers.data() + 16 + (row + row_reach) * stride + component * pitch;
    }
    const T* at(std::int64_t row, int component) const { return const_cast<PaddedRows*>(this)->at(row, component); }
};

}  // namespace cloth::grid
