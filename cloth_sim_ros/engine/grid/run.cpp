// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of sheets: row loops of springs, hinges and air, and the runs that call them.

#include "grid/run.hpp"

#include "grid/evaluation.hpp"
#include "plan/runs.hpp"

namespace cloth::plan {

template <class T>
RunStatus run_grid(Plan& plan, const Run& run) {
    return grid::GridRun<T>(plan, run).execute();
}
template RunStatus run_grid<float>(Plan&, const Run&);
template RunStatus run_grid<double>(Plan&, const Run&);
RunStatus evaluate_grid(Plan& plan, const Run& run) { return grid::GridForces(plan, run).execute(); }

}  // namespace cloth::plan
