// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Angle by which springs turn in a step. A spring of rest length above 0 turns its force round as its ends pass each
// other. Steps that do not resolve this sample the force before and after it only. So do the normals of panels, and the
// vectors by whose length hinges divide.
#pragma once

#include "grid/queries.hpp"
#include "mesh/queries.hpp"

namespace cloth::plan {

/// Squared angle by which the vector of a spring turns in a step, at its shortest length. The vector changes steadily
/// from `start` to `end` in a number of steps, and half a step before and after.
template <class V>
CLOTH_INLINE V turn2(Vec3<V> start, Vec3<V> end, double steps) {
    const auto all = [](double a) { return splat<V>(scalar<V>(a)); };
    const Vec3<V> change = end - start;
    const V change2 = norm2_plus(change, scalar<V>(laws::min_length2)), half_step = all(0.5 / steps);
    const V nearest = smaller(larger(-dot(start, change) / change2, -half_step), all(1.0) + half_step);
    return norm2(change) / (all(steps * steps) * norm2_plus(fma(nearest, change, start), scalar<V>(laws::min_length2)));
}

inline double list_turn2(const List& list, const double* x0, const double* x, std::int64_t n, std::int64_t steps) {
    double largest = 0.0;
    for (std::int64_t e = 0; e < list.count; ++e) {
        const mesh::ElementState<laws::Spring> start(list, e, x0, nullptr, n), end(list, e, x, nullptr, n);
        largest = std::max(largest, turn2(start.d[0], end.d[0], static_cast<double>(steps)));
    }
    return largest;
}

/// Vectors by whose common length a panel or a hinge divides, and what else adds to its square.
struct Divisor {
    Vec3<double> vectors[3] = {};
    double floor2 = 0.0;

    Divisor(const List& list, std::int64_t e, const double* x, std::int64_t n) {
        const std::int64_t* const p = list.corners.data() + e * list.width;
        const Vec3<double> a = particle(x, n, p[0]), b = particle(x, n, p[1]) - a, c = particle(x, n, p[2]) - a;
        if (list.width == 3) {
            vectors[0] = cross(b, c);
            return;
        }
        const Vec3<double> d = particle(x, n, p[3]) - a;
        if (list.kind == mesh::Kind::crossed) {
            const double share = laws::CrossedAreas::parallel * norm2(b);
            vectors[0] = cross(b, d - c), floor2 = share * share;
        } else if (list.kind == mesh::Kind::altitude) {
            vectors[0] = cross(c, d), vectors[1] = cross(d, b), vectors[2] = cross(b, c);
        } else {
            vectors[0] = cross(c, d - b);
        }
    }
};

/// Squared angle by which a divisor turns in a step if it falls below half of its length between the ends, else 0.
inline double vanishing_turn2(const Divisor& start, const Divisor& end, double steps) {
    double change2 = 0.0, approach = 0.0, start2 = 0.0, end2 = 0.0, least2 = larger(start.floor2, end.floor2);
    for (int k = 0; k < 3; ++k) {
        const Vec3<double> change = end.vectors[k] - start.vectors[k];
        change2 += norm2(change), approach -= dot(start.vectors[k], change);
        start2 += norm2(start.vectors[k]), end2 += norm2(end.vectors[k]);
    }
    if (!(change2 > 0.0)) return 0.0;
    const double half_step = 0.5 / steps, nearest = smaller(larger(approach / change2, -half_step), 1.0 + half_step),
                 most2 = smaller(start2 + start.floor2, end2 + end.floor2);
    for (int k = 0; k < 3; ++k) least2 += norm2(fma(nearest, end.vectors[k] - start.vectors[k], start.vectors[k]));
    if (least2 > 0.25 * most2) return 0.0;
    return change2 / (steps * steps * larger(least2, 1e-30 * change2));
}

/// Whether elements of a kind divide by a length that may vanish.
inline bool has_divisor(mesh::Kind kind) {
    return mesh::is_panel(kind) || mesh::is_mass(kind) || kind == mesh::Kind::crossed || kind == mesh::Kind::altitude;
}
inline double vanishing_turn2(const List& list, const double* x0, const double* x, std::int64_t n, double steps) {
    double largest = 0.0;
    for (std::int64_t e = 0; e < list.count; ++e)
        largest = larger(vanishing_turn2(Divisor(list, e, x0, n), Divisor(list, e, x, n), steps), largest);
    return largest;
}

inline double grid_turn2(const Grid& grid, const GridTables<double>& tables, const double* x0, const double* x,
                         std::int64_t steps) {
    using V = vec<double>;
    const grid::PaddedRows<double> start(grid, x0, nullptr), end(grid, x, nullptr);
    const std::int64_t length = grid::row_length<double>(grid.columns);
    V lanes_of{};
    for (int f = 0; f < grid::family_count; ++f) {
        if (!grid.families[f].present) continue;
        const grid::Ends e = grid::family_ends[f];
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            const double* const weight = tables.of(row) + (grid::weights + f) * tables.pitch;
            for (std::int64_t j = 0; j < length; j += lanes<double>) {
                const auto vector = [&](const grid::PaddedRows<double>& at) {
                    return grid::padded_point(at, row + e.row1, j + e.column1, 0) -
                           grid::padded_point(at, row + e.row0, j + e.column0, 0);
                };
                const V square = turn2(vector(start), vector(end), static_cast<double>(steps));
                lanes_of = larger(lanes_of, select(load(weight + j) > V{}, square, V{}));
            }
        }
    }
    double largest = 0.0;
    for (int lane = 0; lane < lanes<double>; ++lane) largest = std::max(largest, double(lanes_of[lane]));
    return largest;
}

}  // namespace cloth::plan
