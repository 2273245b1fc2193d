// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Scaling of the contact law to a reduced thickness.
#pragma once

#include "core/algebra.hpp"

namespace cloth::laws {

/// A contact of reduced thickness d / scale, which grows at a relative rate `growth` [1/s]. It is the law of thickness
/// d at gaps and speeds multiplied by `scale`, with the acceleration divided by `scale` and the energy by its square.
/// Therefore squared frequencies and damping rates are those of thickness d. docs/derivations/contact_thickness.md
/// derives it.
template <class V>
struct Scaling {
    V scale, growth;

    CLOTH_INLINE V gap(V gap) const { return scale * gap; }
    /// Closing speed of the scaled gap, by the relative motion [m/s] and by the growth.
    CLOTH_INLINE V closing(V gap, V speed) const { return scale * fma(growth, gap, speed); }
};
template <class V>
inline Scaling<V> full_thickness() {
    return {splat<V>(scalar<V>(1.0)), V{}};
}

}  // namespace cloth::laws
