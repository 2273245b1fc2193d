# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Implicit Runge-Kutta method for stiff sheets and stiff damping."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, check_settings
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State


class Implicit(Integrator):
    """Two-stage singly diagonally implicit Runge-Kutta method of order 2, for any stiffness and damping.

    It is Alexander's (SIAM J. Numer. Anal. 14, 1977), gamma = 1 - 1/sqrt(2). The stages are at
    t + gamma h and t + h; the second one is the new state (stiffly accurate). The method is L-stable and algebraically
    stable, therefore no step creates energy.

    Each stage solves ``M (v - V) = d f(t, X + d v, v)``, d = gamma h, by Newton's iteration. Its matrix
    ``M + d^2 K + d D`` is assembled and factorised in every iteration. An old one is useless once stiff springs have
    turned by a thousandth.
    The negative stiffness of compressed springs is omitted in the matrix, but not in the force.

    The error estimate of a step has two parts (docs/derivations/implicit.md). One is the leading error of positions,
    ``0.0404 h^2 |v2' - v1'| / (1 - gamma)``. The other is what the leading error of velocities displaces later.
    In-plane waves that the step does not resolve are damped.

    Two to six force evaluations and factorisations per step; `Advance.evaluations` counts these alone. The error of
    velocities takes four to twelve force evaluations more. Any stiffness, any damping.

    Args:
        step: largest fixed step [s].
        tolerance: of positions [m], see docs/time_stepping.md. Without step and tolerance a frame is one step.
        work: work limit of a frame, as a multiple of real time by the estimated cost; 0 for no limit.

    Raises:
        ValueError: if one of them is not positive, or both are set.
    """

    name = "implicit"
    order = 2
    suits = "any stiffness and damping: sheets too stiff for real time by explicit steps"

    def __init__(self, step: float | None = None, *, tolerance: float | None = None, work: float = 0.0) -> None:
        self.step, self.tolerance, self.work = check_settings(step, tolerance, work)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return math.inf

    def advance(
        self,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        accumulator: WorkAccumulator | None = None,
        *,
        is_strict: bool = False,
        max_evaluations: float = math.inf,
    ) -> Advance:
        """Advance ``state``, in place, from time t [s] by duration [s]; return a report, as `Integrator.advance` does.

        Args:
            plan: equations of motion.
            state: advanced in place.
            t: time at the start [s].
            duration: time to advance [s].
            accumulator: accumulates work and wrenches of the motion; None for none.
            is_strict: raise instead of taking a step that would be flagged.
            max_evaluations: limit of force evaluations for eight or more fixed steps. Newton's iteration stops there,
                and a descent finishes the step; it always has a result, and the step is flagged.

        Raises:
            ToleranceMissedError: if strict, with contact, and no solution of a step is found.
        """
        from cloth_sim_ros.physics.integrators.implicit_advance import ImplicitAdvance

        return ImplicitAdvance(
            self, plan, state, t, duration, accumulator, is_strict=is_strict, max_evaluations=max_evaluations
        ).run()
