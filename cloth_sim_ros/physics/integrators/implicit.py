# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An implicit method for stiff sheets and stiff damping."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.integrators.base import (
    WORK_LIMIT,
    Advance,
    Integrator,
    check_step,
    check_tolerance,
    check_work,
)
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State


class Implicit(Integrator):
    """Two-stage singly diagonally implicit Runge-Kutta (Alexander, SIAM J. Numer. Anal. 14, 1977), gamma = 1 -
    1/sqrt(2).

    Stages at t + gamma h and t + h, the second being the new state: stiffly accurate. Order 2, L-stable, and
    algebraically stable, so that no step makes energy from nowhere. Each stage solves ``M (v - V) = d f(t, X + d v,
    v)``, d = gamma h, by Newton's iteration with a matrix M + d^2 K + d D that is assembled from the forces and
    factorised anew each time: stiff springs that turn by a thousandth make an old one useless. Compression's negative
    stiffness is left out of the matrix, not of the force.

    The error of a step is estimated as ``0.0404 h^2 |v2' - v1'| / (1 - gamma)``: the leading error of the method with
    x''' from the stages' accelerations. In-plane waves that the step does not resolve are damped out, not followed.

    Order 2. Two to six force evaluations and factorisations a step. Any stiffness, any damping.

    Args:
        step: fixed largest step [s].
        tolerance: of positions [m], see docs/time_stepping.md. Without either a frame is one step.
        work: most work of a frame, in real time by the estimated cost; 0 for no limit.

    Raises:
        ValueError: if one of them is not positive, or both are set.
    """

    name = "implicit"
    order = 2
    suits = "any stiffness and damping: sheets too stiff for real time by explicit steps"

    def __init__(self, step: float | None = None, *, tolerance: float | None = None, work: float = WORK_LIMIT) -> None:
        if tolerance is not None and step is not None:
            raise ValueError(
                f"step {step} s and tolerance {tolerance} m are both set: a fixed step holds no tolerance; set one"
            )
        self.step = check_step(step)
        self.tolerance, self.work = check_tolerance(tolerance), check_work(work)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return math.inf

    def advance(
        self,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        book: Book | None = None,
        *,
        strict: bool = False,
        most: float = math.inf,
    ) -> Advance:
        """Advance a state; where it is `strict`, no further than a step that would be flagged.

        ``most`` is what eight or more fixed steps may take, in force evaluations. What Newton's iteration would take
        beyond it is left out: such a step is taken by descent, which has a result in any case, and is flagged.

        Raises:
            MissedError: where it is strict, with contact, and a step has no solution that can be found.
        """
        from cloth_sim_ros.physics.integrators.implicit_run import ImplicitAdvance

        return ImplicitAdvance(self, plan, state, t, duration, book, strict=strict, most=most).run()
