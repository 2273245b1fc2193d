// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Memory that runs write into, kept from one run to the next.
#pragma once

#include "grid/cells.hpp"
#include "grid/differences.hpp"
#include "grid/stencils.hpp"
#include "mesh/elements.hpp"

namespace cloth::plan {

using grid::CellTable, grid::CurvatureTable, grid::RowTable, mesh::Elements;

/// Particles of one thread, and the listed elements that touch them. Elements at a border are evaluated on both sides,
/// so that the sum of each particle has one order.
template <class T>
struct Partition {
    std::int64_t first = 0, last = 0;  ///< own particles
    std::int64_t low = 0, high = 0;    ///< particles that its elements touch
    std::vector<Elements<T>> lists;
    Array<T> f;
    /// Mass blocks of the air, two quads a particle, see mesh/added_mass.hpp.
    Array<T> mass_blocks;
    /// Forces of multirate hinges, and the velocities for their damping.
    Array<T> hinge_forces, hinge_velocities;
};
/// Memory of a run, kept for the next one: new memory costs more than a short run.
template <class T>
struct Workspace {
    std::vector<Array<T>> state, force_rows, messages;
    Array<T> quads[2], particle_arrays[4], middle_velocities, window, contact_masses;
    /// By whether hinges are multirate, and by whether there are several threads.
    std::vector<Partition<T>> partitions[2][2];
    /// Predicted halves of the next hinge impulses over masses, alternating, and quarters of the last ones.
    Array<T> predicted_impulses[3];
    std::vector<RowTable<T>> tables;
    CellTable<T> cells, mass_cells;
    CurvatureTable<T> curvature;
    bool has_tables = false;  ///< whether tables and cells are up to date with the lists of the plan
};

/// Maximum number of concurrent runs; each has a workspace of its own.
inline constexpr int max_concurrency = 2;

}  // namespace cloth::plan
