# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolated leapfrog with error control, of order 2 to 5."""

from __future__ import annotations

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.control import explicit
from cloth_sim_ros.physics.control.stability import MOST_COLUMNS
from cloth_sim_ros.physics.integrators.base import (
    WORK_LIMIT,
    Advance,
    Integrator,
    check_step,
    check_tolerance,
    check_work,
)
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State


class Extrapolated(Integrator):
    """Extrapolation of leapfrog runs: combines runs with several step counts so that leading errors cancel.

    One run is the leapfrog itself, of order 2; K combined runs have order K + 1. Runs have the cost and the stable step
    of the leapfrog. With a tolerance, number of runs and steps follow the error. The difference of the combinations of
    K + 1 and K runs is the error estimate of the latter.

    A further run gives an estimate at least every 16 frames, or every 64 if the error is far below its budget. Events
    and faster motion cause an estimate too. Between estimates the error is predicted from the difference of the present
    runs.

    Without damping, modes near the step limit grow slowly under extrapolation. The error estimate grows with them and
    reduces the steps.

    Force evaluations per step of the first run: 1, 2.25, 3.75, 5.75 for 1, 2, 3, 4 runs. For damping up to critical.

    Args:
        tolerance: of positions [m], see docs/time_stepping.md; None for a fixed number of runs and fixed steps.
        step: largest step of the first run without a tolerance [s]; None takes 0.96 of the stability limit.
        columns: maximum number of runs, 1 to 4; without a tolerance, their number.
        work: work limit of a frame, as a multiple of real time by the plan's estimated cost; 0 for no limit.

    Raises:
        ValueError: for a value out of range, or a step together with a tolerance.
    """

    name = "extrapolated"
    suits = "tight tolerances on sheets with damping; explicit, so for stiffness that the step limit allows"

    def __init__(
        self,
        *,
        tolerance: float | None = None,
        step: float | None = None,
        columns: int = MOST_COLUMNS,
        work: float = WORK_LIMIT,
    ) -> None:
        if not 1 <= columns <= MOST_COLUMNS:
            raise ValueError(f"columns is {columns}; it must be from 1 to {MOST_COLUMNS}")
        if tolerance is not None and step is not None:
            raise ValueError(
                f"step {step} s and tolerance {tolerance} m are both set: a fixed step holds no tolerance; set one"
            )
        self.tolerance = check_tolerance(tolerance)
        self.step, self.work = check_step(step), check_work(work)
        self.columns = columns
        self.order = columns + 1

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return leapfrog_limit(omega2, damping_rate)

    def advance(self, plan: Plan, state: State, t: float, duration: float, book: Book | None = None) -> Advance:
        return explicit.advance(self, plan, state, t, duration, book)
