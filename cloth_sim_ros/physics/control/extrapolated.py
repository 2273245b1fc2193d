# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolated leapfrog with error control, of order 2 to 5."""

from __future__ import annotations

from cloth_sim_ros.physics.control.explicit import ExplicitIntegrator
from cloth_sim_ros.physics.control.stability import MAX_COMBINED_RUNS
from cloth_sim_ros.physics.integrators.base import check_settings
from cloth_sim_ros.physics.old_names import with_old_arguments, with_old_names


@with_old_names(columns="n_runs")
class Extrapolated(ExplicitIntegrator):
    """Integrator `extrapolated`: combines leapfrog runs with several step counts so that leading errors cancel.

    One run is the leapfrog itself, of order 2; K combined runs have order K + 1. Runs have the cost and the stable step
    of the leapfrog. With a tolerance, number of runs and steps follow the error. The difference of the combinations of
    K + 1 and K runs is the error estimate of the latter.

    A further run gives an estimate at least every 0.25 s, or every second if the error is far below its budget. Events
    and faster motion cause an estimate too. Between estimates the error is predicted from the difference of the present
    runs.

    Without damping, modes near the step limit grow slowly under extrapolation. The error estimate grows with them and
    reduces the steps.

    Force evaluations per step of the first run: 1, 2.25, 3.75, 5.75 for 1, 2, 3, 4 runs. For damping up to critical.

    Args:
        tolerance: of positions [m], see docs/time_stepping.md; None for a fixed number of runs and fixed steps.
        step: largest step of the first run without a tolerance [s]; None takes 0.96 of the stability limit.
        n_runs: maximum number of runs, 1 to 4; without a tolerance, their number.
        work: work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.

    Raises:
        ValueError: for a value out of range, or a step together with a tolerance.
    """

    name = "extrapolated"
    suits = "tight tolerances on sheets with damping; explicit, so for stiffness that the step limit allows"

    @with_old_arguments(columns="n_runs")
    def __init__(
        self,
        *,
        tolerance: float | None = None,
        step: float | None = None,
        n_runs: int = MAX_COMBINED_RUNS,
        work: float = 0.0,
    ) -> None:
        if not 1 <= n_runs <= MAX_COMBINED_RUNS:
            raise ValueError(f"n_runs is {n_runs}; it must be from 1 to {MAX_COMBINED_RUNS}")
        self.step, self.tolerance, self.work = check_settings(step, tolerance, work)
        self.n_runs, self.order = n_runs, n_runs + 1
