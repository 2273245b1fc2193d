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

/// Add blocks that bound stiffness [N/m] and damping [N s/m], each (6, n), and the transverse part of the stiffness of
/// springs to `transverse` (n) unless null.
inline void add_list_bounds(const List& list, const double* x, std::int64_t n, double* stiff, double* damp,
                            double* transverse = nullptr) {
    if (is_mass(list.kind) && !list.has_wind()) return;
    with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        for (std::int64_t e = 0; e < list.count; ++e) {
            const ElementState<Law> s(list, e, x, nullptr, n);
            Bound<double> bound[Law::corners];
            Law::bounds(s.params, s.d, bound);
            for (int i = 0; i < Law::corners; ++i) {
                const std::int64_t p = list.corners[e * list.width + i];
                const Sym3<double>& k = bound[i].stiff;
                const double isotropic = bound[i].isotropic;
                if (stiff)
                    add_block(stiff, n, p, {k.xx + isotropic, k.yy + isotropic, k.zz + isotropic, k.xy, k.xz, k.yz});
                if (damp && list.damped) add_block(damp, n, p, bound[i].damp);
                if (transverse) transverse[p] += bound[i].transverse;
            }
        }
    });
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
