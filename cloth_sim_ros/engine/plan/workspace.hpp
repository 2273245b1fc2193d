// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Memory that runs write into, kept from one run to the next.
#pragma once

#include "grid/cells.hpp"
#include "grid/stencils.hpp"
#include "mesh/elements.hpp"

namespace cloth {

/// Particles that one thread looks after, and the listed elements that touch them: those at a border are taken by both
/// sides, so that every particle's sum runs in one order.
template <class T>
struct Partition {
    std::int64_t first = 0, last = 0;  ///< its own particles
    std::int64_t low = 0, high = 0;    ///< those that its elements touch
    std::vector<Elements<T>> lists;
    Array<T> f;
    /// Where hinges are asked for less often than the rest: their forces, and the velocities that they see.
    Array<T> hinge_forces, hinge_velocities;
};
/// What runs write into, kept from one to the next: memory that is new costs more than a short run.
template <class T>
struct Workspace {
    std::vector<Array<T>> state, force_rows, messages;
    Array<T> quads[2], particle_arrays[3], window, contact_masses;
    /// Where rows take their hinges, and where these are asked for less often; of one thread, and of several.
    std::vector<Partition<T>> partitions[2][2];
    /// Halves of hinges' next impulses over masses as foretold, in turn, and quarters of the last ones.
    Array<T> predicted_impulses[3];
    std::vector<RowTable<T>> tables;
    CellTable<T> cells;
    bool has_tables = false;  ///< whether `tables` and `cells` are of the plan's lists
};

/// Runs that are made at once at most: each writes into rooms of its own.
inline constexpr int max_concurrency = 2;

}  // namespace cloth
