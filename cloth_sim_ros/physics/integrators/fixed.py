# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Advance by equal steps within the stability limit, without error control."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance, Integrator, NoRoomError, UnstableError, refuse_step
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State

#: Maximum number of attempts of an advance, each with a smaller step.
MAX_ATTEMPTS = 12


def steps_for(duration: float, step: float) -> int:
    """Return the smallest number of equal steps of at most ``step`` [s] that cover a duration [s], up to rounding."""
    return max(1, math.ceil(duration / step * (1.0 - 1e-12)))


def advance_fixed(
    integrator: Integrator,
    run: Callable[[float, int], int],
    plan: Plan,
    state: State,
    t: float,
    duration: float,
    step: float | None,
    accumulator: WorkAccumulator | None,
) -> Advance:
    """Run an explicit method with equal steps.

    Without a given step it takes a safe fraction of the step limit, and a smaller one if the motion stiffens.

    Args:
        integrator: defines step limit and name.
        run: called with step size h [s] and number of steps; advances the state, returns its force evaluations.
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        step: the user's largest step [s], or None.
        accumulator: work accumulator, reset before every attempt; None for none.

    Raises:
        ValueError: if the given step is above the limit.
        UnstableError: if the motion does not stay finite.
    """

    def limit_at(time: float, lookahead: float) -> float:
        """Step limit at a time [s], including contact predicted over a duration [s]."""
        if plan.contact is not None:
            plan.contact.load_state(state)
        omega2, damping = plan.spectral_bounds(state.x)
        try:
            contact = plan.predict_contact(time, lookahead, state.x, state.v)
        except ValueError as error:
            raise NoRoomError(str(error)) from error
        return integrator.step_limit(omega2 + contact[0], damping + contact[1])

    limit = limit_at(t, duration)
    if step is not None:
        refuse_step(step, limit, integrator.name)
    max_step = CONSTANTS.stability_safety * limit if step is None else step
    start = state.shallow_copy()
    state.x, state.v = state.x.copy(), state.v.copy()
    evaluations = 0
    rejected = 0
    while True:
        steps = steps_for(duration, max_step)
        h = duration / steps
        if accumulator is not None:
            accumulator.reset()
        evaluations += run(h, steps)
        is_finite = bool(np.isfinite(state.x).all() and np.isfinite(state.v).all())
        if is_finite and (step is not None or h <= limit_at(t + duration, 0.0)):
            break
        if step is not None:
            raise UnstableError(
                f"the motion became non-finite at a step of {h} s; its limit was {limit:.6g} s at the start"
            )
        state.restore(start)
        max_step = 0.5 * h
        rejected += 1
        if rejected == MAX_ATTEMPTS:
            raise UnstableError(
                f"no step down to {h:.3g} s kept the motion within its stability limit; reduce stiffness "
                "or damping, or set integrator auto"
            )
    limited_by = "step" if step is not None else ("frame" if steps == 1 else "stability")
    step_text = (
        f"fixed step of {h:.3g} s"
        if step is not None
        else f"{CONSTANTS.stability_safety:g} of the stability limit {limit:.3g} s"
    )
    return Advance(
        steps=steps,
        evaluations=evaluations,
        step=h,
        limit=limit,
        rejected=rejected,
        integrator=integrator.name,
        limited_by=limited_by,
        reason=f"{integrator.name}: {step_text}, no tolerance set",
    )
