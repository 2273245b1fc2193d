// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Queries of listed elements: energy, power, bounds, derivative product. Elements are evaluated in the order of the
// list; positions and velocities are (3, n) by component.
#pragma once

#include "mesh/dispatch.hpp"

namespace cloth::mesh {

using laws::Bound;

inline double list_energy(const List& list, const double* x, std::int64_t n) {
    return with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        double total = 0.0;
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, nullptr, n);
            total += Law::energy(s.params, s.d);
        }
        return total;
    });
}

/// Call `visit` with the law of a list, if it is one of added mass.
template <class F>
inline void with_added_mass(const List& list, F&& visit) {
    if (list.kind == Kind::mass3) visit(laws::AddedMass<3>{});
    if (list.kind == Kind::mass4) visit(laws::AddedMass<4>{});
}

/// Kinetic energy of the air that a list carries along, v'Mv / 2.
inline double list_air_energy(const List& list, const double* x, const double* v, std::int64_t n) {
    double total = 0.0;
    with_added_mass(list, [&](auto law) {
        using Law = decltype(law);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, v, n);
            total += Law::kinetic_energy(s.params, s.d, s.u);
        }
    });
    return total;
}

/// Add the mass blocks [kg] of a list to blocks (6, n).
inline void add_list_mass(const List& list, const double* x, std::int64_t n, double* blocks) {
    with_added_mass(list, [&](auto law) {
        using Law = decltype(law);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, nullptr, n);
            const Sym3<double> block = Law::block(Law::share(s.params), Law::normal(s.d));
            for (int c = 0; c < Law::corners; ++c) add_block(blocks, n, list.corners[e * list.width + c], block);
        }
    });
}

/// Power of damping, and power of the wind [W].
inline void list_power(const List& list, const double* x, const double* v, std::int64_t n, double& dissipation,
                       double& external) {
    if (!list.damped || is_mass(list.kind)) return;
    with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, v, n);
            dissipation += Law::dissipation(s.params, s.d, s.u);
            if constexpr (Law::absolute_velocities) external += Law::external_power(s.params, s.d, s.u);
        }
    });
}

/// Blocks that bound stiffness [N/m] and damping [N s/m]. A particle has 12 numbers: xx, yy, zz, xy, xz, yz of stiffness,
/// then xz, yz, xx, yy, zz, xy of damping.
class BoundSums {
public:
    /// Start from blocks (6, n).
    BoundSums(const double* stiff, const double* damp, std::int64_t n) : numbers_(size * n, 0.0), n_(n) {
        visit_numbers([&](int at, int row, bool of_damp) {
            const double* const from = of_damp ? damp : stiff;
            for (std::int64_t i = 0; from && i < n_; ++i) numbers_[size * i + at] = from[row * n_ + i];
        });
    }
    /// Add the bounds of the elements from `first` on at their corners, in the list's order.
    template <class Law>
    CLOTH_INLINE void add(const List& list, std::int64_t first, const Bound<vec<double>>* bounds) {
        using V = vec<double>;
        quad<double> rows[Law::corners][3][lanes<double>];
        for (int c = 0; c < Law::corners; ++c) {
            const Sym3<V>&k = bounds[c].stiff, &damp = bounds[c].damp;
            const V i = bounds[c].isotropic;
            interleave(k.xx + i, k.yy + i, k.zz + i, rows[c][0], k.xy);
            interleave(k.xz, k.yz, list.damped ? damp.xz : V{}, rows[c][1], list.damped ? damp.yz : V{});
            if (list.damped) interleave(damp.xx, damp.yy, damp.zz, rows[c][2], damp.xy);
        }
        const int n_lanes = static_cast<int>(std::min<std::int64_t>(lanes<double>, list.count - first));
        for (int lane = 0; lane < n_lanes; ++lane)
            for (int c = 0; c < Law::corners; ++c) {
                double* const to = numbers_.data() + size * list.corners[(first + lane) * Law::corners + c];
                for (int q = 0; q < (list.damped ? 3 : 2); ++q)
                    store4(to + 4 * q, quad<double>(load4(to + 4 * q) + rows[c][q][lane]));
            }
    }
    /// Write them back, to blocks that are not null.
    void store(double* stiff, double* damp) const {
        visit_numbers([&](int at, int row, bool of_damp) {
            double* const to = of_damp ? damp : stiff;
            for (std::int64_t i = 0; to && i < n_; ++i) to[row * n_ + i] = numbers_[size * i + at];
        });
    }

private:
    static constexpr int size = 12;
    template <class F>
    static void visit_numbers(F&& visit) {
        constexpr int stiff_at[6] = {0, 1, 2, 3, 4, 5}, damp_at[6] = {8, 9, 10, 11, 6, 7};
        for (int row = 0; row < 6; ++row) visit(stiff_at[row], row, false), visit(damp_at[row], row, true);
    }
    Array<double> numbers_;
    std::int64_t n_;
};

/// Add blocks that bound stiffness [N/m] and damping [N s/m], each (6, n) or null, and the transverse part of the
/// stiffness of springs to `transverse` (n) unless null. Laws are evaluated for vectors of elements.
inline void add_list_bounds(const List& list, const double* x, std::int64_t n, double* stiff, double* damp,
                            double* transverse = nullptr) {
    if (!list.count || (is_mass(list.kind) && !list.has_wind())) return;
    BoundSums sums(stiff, damp, n);
    with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        using V = vec<double>;
        constexpr int C = Law::corners, L = lanes<double>;
        for (std::int64_t first = 0; first < list.count; first += L) {
            alignas(64) double coordinates[C][3][L], numbers[max_params][L];
            for (int k = 0; k < L; ++k) {
                // Beyond the end the last element is repeated.
                const std::int64_t e = std::min(first + k, list.count - 1);
                for (int c = 0; c < C; ++c)
                    for (int axis = 0; axis < 3; ++axis)
                        coordinates[c][axis][k] = x[axis * n + list.corners[e * C + c]];
                for (int i = 0; i < Law::params; ++i) numbers[i][k] = list.params[e * Law::params + i];
            }
            const auto point = [&](int c) {
                return Vec3<V>{load(coordinates[c][0]), load(coordinates[c][1]), load(coordinates[c][2])};
            };
            Vec3<V> d[C - 1];
            for (int c = 1; c < C; ++c) d[c - 1] = point(c) - point(0);
            V params[max_params];
            for (int i = 0; i < Law::params; ++i) params[i] = load(numbers[i]);
            Bound<V> bounds[C];
            Law::bounds(law_params<Law, V>(params, list.common), d, bounds);
            sums.add<Law>(list, first, bounds);
            for (int k = 0; transverse && k < L && first + k < list.count; ++k)
                for (int c = 0; c < C; ++c) transverse[list.corners[(first + k) * C + c]] += bounds[c].transverse[k];
        }
    });
    sums.store(stiff, damp);
}

/// Add (df/dx) dx + (df/dv) dv to out (3, n), by the law on dual numbers.
inline void add_list_product(const List& list, const double* x, const double* v, const double* dx, const double* dv,
                             std::int64_t n, double* out) {
    with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        constexpr int C = Law::corners, n_velocities = Law::absolute_velocities ? C : C - 1;
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, v, n), along(list, e, dx, dv, n);
            Vec3<Dual> d[C - 1], u[C], f[C];
            for (int c = 0; c < C - 1; ++c) d[c] = with_slope(s.d[c], along.d[c]);
            for (int c = 0; c < n_velocities; ++c) u[c] = with_slope(s.u[c], along.u[c]);
            Dual numbers[max_params];
            for (int p = 0; p < Law::params; ++p) numbers[p] = {list.params[e * list.numbers + p], 0.0};
            Law::force(law_params<Law, Dual>(numbers, list.common), d, u, f, list.damped);
            Vec3<double> reaction{};
            const auto add = [&](int corner, Vec3<double> g) {
                const std::int64_t p = list.corners[e * list.width + corner];
                out[p] += g.x;
                out[n + p] += g.y;
                out[2 * n + p] += g.z;
            };
            for (int c = 0; c < n_velocities; ++c) {
                const Vec3<double> g = slope_of(f[c]);
                add(Law::absolute_velocities ? c : c + 1, g);
                reaction = reaction - g;
            }
            if (!Law::absolute_velocities) add(0, reaction);
        }
    });
}

}  // namespace cloth::mesh
