# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Extrapolated leapfrog: high order and error control on top of the cheapest loop."""

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
    """Runs each frame by leapfrog with several step counts and combines the ends so that the leading errors cancel.

    One column is the leapfrog itself, of order 2; K columns have order K + 1. The columns are ordinary leapfrog runs,
    so they cost what the fused loop costs, and the stable step is the leapfrog's. With a tolerance the columns and
    steps are chosen by the error: the difference of the combinations of K + 1 and of K columns estimates the error of
    the latter. A further column is run at least every 16 frames, or 64 where the error is far below its budget, after
    every event and whenever the motion becomes livelier; in between the difference of the columns at hand is scaled by
    what the last judgement said. Without damping, modes near the step limit grow slowly under extrapolation: there the
    estimate grows with them and makes the steps smaller.

    Order 2 to 5. Force evaluations a step of the first column: 1, 2.25, 3.75, 5.75 for 1, 2, 3, 4 columns. For
    damping up to critical.

    Args:
        tolerance: of positions [m], see docs/time_stepping.md; None takes fixed columns and steps.
        step: largest step of the first column without a tolerance [s]; None takes 0.96 of the stability limit.
        columns: most columns, 1 to 4; without a tolerance, the columns.
        work: most work of a frame, in real time by the plan's estimated cost; 0 for no limit.

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
            raise ValueError(f"columns is {columns}; it must be 1 to {MOST_COLUMNS}")
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
