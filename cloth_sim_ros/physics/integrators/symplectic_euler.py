# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Symplectic Euler method, a baseline of order 1."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator, accumulate
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators import base
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, UnstableError, check_settings
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit, steps_for
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State

#: Maximum number of attempts of an advance, each with a smaller step.
MAX_ATTEMPTS = 12


class SymplecticEuler(Integrator):
    """Symplectic Euler method: ``v' = v + h a(t, x, v)``, ``x' = x + h v'``.

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
        self.step, _, _ = check_settings(step)

    def step_limit(self, omega2: float, damping_rate: float) -> float:
        return leapfrog_limit(omega2, damping_rate)

    def advance(
        self, plan: Plan, state: State, t: float, duration: float, accumulator: WorkAccumulator | None = None
    ) -> Advance:
        limit, step = self._limit_at(plan, state, t, duration), self.step
        if step is not None:
            base.refuse_step(step, limit, self.name)
        max_step = CONSTANTS.stability_safety * limit if step is None else step
        start = state.shallow_copy()
        state.x, state.v = state.x.copy(), state.v.copy()
        evaluations = rejected = 0
        while True:
            steps = steps_for(duration, max_step)
            h = duration / steps
            self._take_steps(plan, state, t, h, steps, accumulator)
            evaluations += steps
            is_finite = bool(np.isfinite(state.x).all() and np.isfinite(state.v).all())
            if is_finite and (step is not None or h <= self._limit_at(plan, state, t + duration, 0.0)):
                break
            if step is not None:
                raise UnstableError(
                    f"the motion became non-finite at a step of {h} s; its limit was {limit:.6g} s at the start"
                )
            # The motion stiffened.
            state.restore(start)
            max_step = 0.5 * h
            rejected += 1
            if rejected == MAX_ATTEMPTS:
                raise UnstableError(
                    f"no step down to {h:.3g} s kept the motion within its stability limit; reduce stiffness "
                    "or damping, or set integrator auto"
                )
        limited_by = "step" if step is not None else ("frame" if steps == 1 else "stability")
        limit_text = f"{CONSTANTS.stability_safety:g} of the stability limit {limit:.3g} s"
        reason = f"{self.name}: {limit_text if step is None else f'fixed step of {h:.3g} s'}, no tolerance set"
        return Advance(steps, evaluations, h, limit, rejected, self.name, limited_by, reason=reason)

    def _limit_at(self, plan: Plan, state: State, t: float, lookahead: float) -> float:
        """Return the largest stable step [s] at time t, with contact within `lookahead` [s]; or raise NoRoomError."""
        omega2, damping = plan.spectral_bounds(state.x)
        try:
            contact_omega2, contact_damping = plan.predict_contact(t, lookahead, state.x, state.v, state.memory)
        except ValueError as error:
            raise base.NoRoomError(str(error)) from error
        return self.step_limit(omega2 + contact_omega2, damping + contact_damping)

    @staticmethod
    def _take_steps(
        plan: Plan, state: State, t: float, h: float, steps: int, accumulator: WorkAccumulator | None
    ) -> None:
        """Move a state, in place, by equal steps of h [s] from time t [s], after a reset of the accumulator."""
        if accumulator is not None:
            accumulator.reset()
        a = np.empty_like(state.x)
        is_prescribed = plan.prescribed_particles().size > 0
        if is_prescribed:
            impulses = plan.prescribe(t, state.x, state.v)
            if accumulator is not None:
                accumulator.add_gripper_impulses(impulses)
        for k in range(steps):
            plan.accelerations(t + k * h, state.x, state.v, a, state.memory)
            if accumulator is not None:
                accumulate(accumulator, plan, t + k * h, state.x, state.v, h, state.memory)
            state.v += h * a
            state.x += h * state.v
            if is_prescribed:
                plan.prescribe(t + (k + 1) * h, state.x, state.v)
            work = plan.update_after_step(t + (k + 1) * h, h, state)
            if accumulator is not None:
                accumulator.add_dissipation(work)
