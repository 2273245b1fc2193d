// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Joint: a spring without rest length (S4).
#pragma once

#include "laws/bound.hpp"

namespace cloth::laws {

/// S4, a joint: F = -k s - c ds/dt on the far end, s its position relative to the near end.
struct Joint {
    static constexpr int corners = 2, params = 2;
    static constexpr bool absolute_velocities = false;
    /// k [N/m], c [N s/m].
    template <class V>
    struct Params {
        V k, c;
    };

    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, Vec3<V>* f, bool damped) {
        f[0] = -(p.k * d[0]);
        if (damped) f[0] = f[0] - p.c * u[0];
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        return splat<V>(0.5) * p.k * norm2(d[0]);
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>*, const Vec3<V>* u) {
        return p.c * norm2(u[0]);
    }
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>*, Bound<V>* b) {
        const V two = splat<V>(2);
        b[0] = b[1] = {outer(V{}, Vec3<V>{}, two * p.k), outer(V{}, Vec3<V>{}, two * p.c), splat<V>(1), V{}};
    }
};

}  // namespace cloth::laws
