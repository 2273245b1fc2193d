// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Forces of listed elements. Operands are gathered for a vector of elements at a time. Forces are added one element
// after the other, so that sums have one order whatever the vector width.
#pragma once

#include "mesh/dispatch.hpp"

namespace cloth::mesh {

/// Operands of a law for a vector of elements.
template <class Law, class V>
struct Operands {
    Vec3<V> d[Law::corners - 1], u[Law::corners];
};

/// Batch size of laws with more than two corners: all elements of a batch are gathered, then all forces are calculated,
/// then all are added. Their calculation takes longer than the processor's look-ahead, so gathering would not overlap
/// with it.
inline constexpr std::int64_t batch_size = 64;

/// Whether a law gives its corners mass.
template <class Law>
inline constexpr bool has_mass = requires { Law::carries_mass; };
/// Whether a law has a plastic length, which follows the motion.
template <class Law>
inline constexpr bool has_plastic_length = requires { Law::has_plastic_length; };

/// A batch by component: operands, later forces.
template <class Law, class V>
struct Batch {
    using T = scalar<V>;
    static constexpr int n_differences = Law::corners - 1,
                         n_velocities = Law::absolute_velocities ? Law::corners : n_differences;
    alignas(64) T d[n_differences][3][batch_size], u[n_velocities][3][batch_size];
    /// Mass blocks of a law that has them: diagonal and other entries.
    alignas(64) T mass[has_mass<Law> ? 2 : 1][3][has_mass<Law> ? batch_size : 1];

    static CLOTH_INLINE void put(Vec3<V> a, T (*to)[batch_size], std::int64_t k) {
        store_as(to[0] + k, a.x), store_as(to[1] + k, a.y), store_as(to[2] + k, a.z);
    }
    static CLOTH_INLINE Vec3<V> get(const T (*from)[batch_size], std::int64_t k) {
        return {load_as<V>(from[0] + k), load_as<V>(from[1] + k), load_as<V>(from[2] + k)};
    }
};

/// Force loop of one list, with positions x, velocities v and forces f as quads. Powers are recorded if Record. Mass
/// blocks are added to `mass`, two quads a particle (mesh/added_mass.hpp), by laws that have them. Plastic lengths move
/// to the end of the step, `half_step` [s] later; 0 keeps them.
template <class Law, class T, bool Damped, bool Record>
class ForceLoop {
    static constexpr int C = Law::corners;
    // The more a law calculates, the more wider vectors gain; gathering loses with them.
    using V = typename CappedVector<T, C == 2 ? 32 : 8 * sizeof(T)>::type;
    static constexpr int L = sizeof(V) / sizeof(T);
    static constexpr bool absolute = Law::absolute_velocities, central = requires { Law::central; };
    static constexpr int n_forces = absolute ? C : C - 1;

public:
    ForceLoop(Elements<T>& list, const double* common, const T* x, const T* v, T* f, PowerSums* powers, T* mass,
              T half_step)
        : common_(common), x_(x), v_(v), f_(f), mass_(mass), powers_(powers), count_(list.count),
          half_step_(half_step) {
        for (int c = 0; c < C; ++c) corner_[c] = list.corner[c].data();
        for (int p = 0; p < Law::params; ++p) param_[p] = list.param[p].data();
        if constexpr (has_plastic_length<Law>) plastic_length_ = list.param[0].data();
    }

    CLOTH_INLINE void add() const {
        if constexpr (C == 2) {
            for (std::int64_t e = 0; e < count_; e += L) {
                Operands<Law, V> operands;
                quad<T> difference[L];
                const auto store_difference = [&](int, Vec3<V> d, const quad<T>* rows) CLOTH_INLINED {
                    operands.d[0] = d;
                    for (int k = 0; k < L; ++k) difference[k] = rows[k];
                };
                gather(e, store_difference, [&](int, Vec3<V> u) CLOTH_INLINED { operands.u[0] = u; });
                if constexpr (central)
                    scatter_central(e, operands, difference);
                else
                    scatter(e, forces(e, operands).d);
            }
        } else {
            Batch<Law, V> batch;
            for (std::int64_t begin = 0; begin < count_; begin += batch_size) {
                const std::int64_t size = std::min(batch_size, count_ - begin);
                for (std::int64_t k = 0; k < size; k += L) {
                    const auto store_difference = [&](int c, Vec3<V> d, const quad<T>*)
                                                      CLOTH_INLINED { batch.put(d, batch.d[c], k); };
                    gather(begin + k, store_difference,
                           [&](int c, Vec3<V> u) CLOTH_INLINED { batch.put(u, batch.u[c], k); });
                }
                for (std::int64_t k = 0; k < size; k += L) {
                    Operands<Law, V> operands;
                    for (int c = 0; c < C - 1; ++c) operands.d[c] = batch.get(batch.d[c], k);
                    for (int c = 0; Damped && c < n_forces; ++c) operands.u[c] = batch.get(batch.u[c], k);
                    const CornerForces g = forces(begin + k, operands);
                    for (int c = 0; c < n_forces; ++c) batch.put(g.d[c], batch.u[c], k);
                    if constexpr (has_mass<Law>) {
                        const Sym3<V> b = Law::block(Law::share(params(begin + k)), Law::normal(operands.d));
                        batch.put({b.xx, b.yy, b.zz}, batch.mass[0], k),
                            batch.put({b.xy, b.xz, b.yz}, batch.mass[1], k);
                    }
                }
                for (std::int64_t k = 0; k < size; k += L) {
                    Vec3<V> g[C];
                    for (int c = 0; c < n_forces; ++c) g[c] = batch.get(batch.u[c], k);
                    scatter(begin + k, g);
                    if constexpr (has_mass<Law>)
                        scatter_mass(begin + k, batch.get(batch.mass[0], k), batch.get(batch.mass[1], k));
                }
            }
        }
    }

private:
    struct CornerForces {
        Vec3<V> d[C];
    };

    /// Gather the operands of elements from e on: call d(corner, vectors, quads) for each difference and u(corner,
    /// vectors) for each velocity.
    template <class D, class U>
    CLOTH_INLINE void gather(std::int64_t e, D&& d, U&& u) const {
        quad<T> rows[L];
        const auto vectors = [&]() CLOTH_INLINED {
            Vec3<V> r;
            deinterleave(rows, r.x, r.y, r.z);
            return r;
        };
        const auto differ = [&](const T* from, int c) CLOTH_INLINED {
            for (int k = 0; k < L; ++k)
                rows[k] = load4(from + std::size_t{corner_[c][e + k]}) - load4(from + std::size_t{corner_[0][e + k]});
        };
        for (int c = 1; c < C; ++c) {
            differ(x_, c);
            d(c - 1, vectors(), rows);
            if constexpr (Damped && !absolute) {
                differ(v_, c);
                u(c - 1, vectors());
            }
        }
        for (int c = 0; absolute && c < C; ++c) {
            for (int k = 0; k < L; ++k) rows[k] = load4(v_ + std::size_t{corner_[c][e + k]});
            u(c, vectors());
        }
    }
    CLOTH_INLINE typename Law::template Params<V> params(std::int64_t e) const {
        V numbers[max_params];
        for (int p = 0; p < Law::params; ++p) numbers[p] = load_as<V>(param_[p] + e);
        return law_params<Law, V>(numbers, common_);
    }
    CLOTH_INLINE CornerForces forces(std::int64_t e, const Operands<Law, V>& operands) const {
        const auto numbers = params(e);
        CornerForces g;
        Law::force(numbers, operands.d, operands.u, g.d, Damped);
        record_powers(e, numbers, operands);
        if constexpr (has_plastic_length<Law>)
            if (half_step_ > T(0)) drag(e, numbers, operands);
        return g;
    }
    CLOTH_INLINE void drag(std::int64_t e, const typename Law::template Params<V>& numbers,
                           const Operands<Law, V>& operands) const {
        const V next = Law::drag(numbers, operands.d, operands.u, splat<V>(half_step_));
        store_as<V>(plastic_length_ + e, next);
        if constexpr (Record) {
            const V work = Law::plastic_work(numbers, next);
            const double per_step = 0.5 / static_cast<double>(half_step_);
            for (int k = 0; k < L; ++k) powers_->dissipation[(e + k) & 15] += per_step * static_cast<double>(work[k]);
        }
    }
    /// Forces of a central law: a number times the gathered quad, without deinterleaving.
    CLOTH_INLINE void scatter_central(std::int64_t e, const Operands<Law, V>& operands,
                                      const quad<T>* differences) const {
        const auto numbers = params(e);
        const V factor = Law::factor(numbers, operands.d[0], operands.u[0], Damped);
        record_powers(e, numbers, operands);
        T factors[L];
        store_as<V>(factors, factor);
        for (int k = 0; k < L; ++k) {
            T *const first_force = f_ + std::size_t{corner_[0][e + k]}, *const second_force =
                                                                            f_ + std::size_t{corner_[1][e + k]};
            const quad<T> q{factors[k], factors[k], factors[k], factors[k]};
            store4(first_force, quad<T>(fma(q, differences[k], load4(first_force))));
            store4(second_force, quad<T>(fma(-q, differences[k], load4(second_force))));
        }
    }
    CLOTH_INLINE void scatter(std::int64_t e, const Vec3<V>* g) const {
        quad<T> out[C][L];
        for (int c = 0; c < n_forces; ++c) interleave(g[c].x, g[c].y, g[c].z, out[absolute ? c : c + 1]);
        for (int k = 0; k < L; ++k) {
            if constexpr (!absolute) {
                out[0][k] = -out[1][k];
                for (int c = 2; c < C; ++c) out[0][k] = out[0][k] - out[c][k];
            }
            for (int c = 0; c < C; ++c) {
                T* const to = f_ + std::size_t{corner_[c][e + k]};
                store4(to, quad<T>(load4(to) + out[c][k]));
            }
        }
    }
    /// Add a mass block to every corner.
    CLOTH_INLINE void scatter_mass(std::int64_t e, Vec3<V> diagonal, Vec3<V> off_diagonal) const {
        quad<T> rows[2][L];
        interleave(diagonal.x, diagonal.y, diagonal.z, rows[0]);
        interleave(off_diagonal.x, off_diagonal.y, off_diagonal.z, rows[1]);
        for (int k = 0; k < L; ++k)
            for (int c = 0; c < C; ++c) {
                T* const to = mass_ + 2 * std::size_t{corner_[c][e + k]};
                store4(to, quad<T>(load4(to) + rows[0][k]));
                store4(to + 4, quad<T>(load4(to + 4) + rows[1][k]));
            }
    }
    CLOTH_INLINE void record_powers([[maybe_unused]] std::int64_t e,
                                    [[maybe_unused]] const typename Law::template Params<V>& numbers,
                                    [[maybe_unused]] const Operands<Law, V>& operands) const {
        if constexpr (Record && Damped) {
            const V dissipation = Law::dissipation(numbers, operands.d, operands.u);
            for (int k = 0; k < L; ++k) powers_->dissipation[(e + k) & 15] += static_cast<double>(dissipation[k]);
            if constexpr (absolute) {
                const V power = Law::external_power(numbers, operands.d, operands.u);
                for (int k = 0; k < L; ++k) powers_->external[(e + k) & 15] += static_cast<double>(power[k]);
            }
        }
    }

    const double* common_;
    const std::uint32_t* corner_[C];
    const T* param_[max_params] = {};
    const T *x_, *v_;
    T *f_, *mass_, *plastic_length_ = nullptr;
    PowerSums* powers_;
    std::int64_t count_;
    T half_step_;
};

}  // namespace cloth::mesh
