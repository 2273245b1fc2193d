// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs of a plan, and the force loop of its lists. Each is compiled once: grid/run.cpp, mesh/run.cpp.
#pragma once

#include "plan/plan.hpp"

namespace cloth::plan {

using mesh::PowerSums;

/// Execute a run of a regular sheet, or evaluate its forces once at x0 and v0.
template <class T>
RunStatus run_grid(Plan& plan, const Run& run);
RunStatus evaluate_grid(Plan& plan, const Run& run);

/// The same without a grid.
template <class T>
RunStatus run_lists(Plan& plan, const Run& run);
RunStatus evaluate_lists(Plan& plan, const Run& run);

/// Add the forces of all elements at positions x and velocities v to f, all quads by particle, and the mass of carried
/// air to `mass`, two quads by particle; null for lists without. Plastic lengths of the elements move to the end of the
/// step, `half_step` [s] later; 0 keeps them.
template <class T>
void add_forces(const List& list, Elements<T>& elements, const T* x, const T* v, T* f, PowerSums* powers,
                T* mass = nullptr, T half_step = T(0));

}  // namespace cloth::plan
