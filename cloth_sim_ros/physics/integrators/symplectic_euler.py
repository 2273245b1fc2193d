# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Symplectic Euler method, a baseline of order 1."""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator, accumulate
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, check_step
from cloth_sim_ros.physics.integrators.fixed import advance_fixed
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State


class SymplecticEuler(Integrator):
    """``v' = v + h a(t, x, v)``, ``x' = x + h v'``.

    Order 1. One force evaluation per step. Stable for ``h^2 w^2 / 4 + h c / 2 <= 1`` (characteristic polynomial; the
    damping force uses the velocity of the previous step).

    Args:
        step: fixed largest step [s]; None takes 0.96 of the stability limit.

    Raises:
        ValueError: if the step is not positive.
    """

    name = "symplectic_euler"
    order = 1
    suits = "a baseline to compare with; any damping within its limit"

    def __init__(self, step: float | None = None) -> None:
        self.step = check_step(step)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        if omega2 == 0.0 and damping_rate == 0.0:
            return float("inf")
        half = 0.5 * damping_rate
        return 2.0 / (half + math.sqrt(half * half + omega2))

    def advance(
        self, plan: Plan, state: State, t: float, duration: float, accumulator: WorkAccumulator | None = None
    ) -> Advance:
        a = np.empty_like(state.x)

        def run(h: float, steps: int) -> int:
            for k in range(steps):
                if plan.contact is not None:
                    plan.contact.load_state(state)
                plan.accelerations(t + k * h, state.x, state.v, a)
                if accumulator is not None:
                    accumulate(accumulator, plan, t + k * h, state.x, state.v, h)
                state.v += h * a
                state.x += h * state.v
                if plan.contact is not None:
                    plan.contact.update_after_step(t + (k + 1) * h, h, state)
            return steps

        return advance_fixed(self, run, plan, state, t, duration, self.step, accumulator)
