# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fallback rule: work limit of a frame, and implicit steps that finish it.

A motion may be too fast for the work limit, and a user's force may grow without bound. Explicit steps then add
arbitrary energy. The descent steps of the implicit method only decrease it.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import FallbackState, reset_step_control
from cloth_sim_ros.physics.state.state import State

#: Force evaluations reserved to finish a frame: ten per step, at most half of the limit.
FALLBACK_EVALUATIONS = 10.0 * CONSTANTS.implicit_finish_steps


def is_implicit_feasible(plan: Plan) -> bool:
    """Return True if the sheet is small enough for the implicit method.

    A frame of a larger sheet would take half a minute and gigabytes of memory.
    """
    return plan.model.particle_count <= CONSTANTS.implicit_max_particles


def evaluation_budget(plan: Plan, work: float, duration: float, contact_time: float = 0.0, ratio: int = 1) -> float:
    """Return the force evaluations of an advance within a work limit; infinite without a limit.

    Args:
        plan: equations of motion.
        work: limit as a multiple of real time by the plan's estimated cost; 0 for none.
        duration: of the advance [s].
        contact_time: estimated time that contact adds to a force evaluation [ns].
        ratio: multirate ratio.
    """
    if work == 0.0:
        return math.inf
    return work * duration / (1e-9 * plan.multirate_step_cost(ratio) * plan.model.particle_count + 1e-9 * contact_time)


def work_cap(
    plan: Plan,
    budget: float,
    duration: float,
    max_step: float,
    fallback_count: float,
    contact_time: float = 0.0,
    limit: float = math.inf,
) -> tuple[float, float]:
    """Return the limit of force evaluations by explicit steps, and the reserve of the fallback; no clock is read.

    Each consecutive fallback halves the limit of the next frame. With contact, single runs of explicit steps finish a
    frame, and the reserve is twice their work. Implicit steps would be slower, because contact couples distant
    particles in their matrix, and they have no friction.

    Args:
        plan: equations of motion.
        budget: force evaluations of the frame, see `evaluation_budget`.
        duration: of the advance [s].
        max_step: longest stable step since the last restart, without contact [s].
        fallback_count: consecutive frames with a fallback.
        contact_time: estimated time that contact adds to a force evaluation [ns].
        limit: predicted step limit with contact [s].
    """
    if budget == math.inf:
        return math.inf, math.inf
    min_cap = CONSTANTS.min_work_cap * duration / max_step
    cap = math.ldexp(budget, -int(fallback_count))
    if contact_time:
        step = CONSTANTS.stability_safety * limit
        single_run_work = CONSTANTS.estimate_trust_factor * RATIO_SUMS[2] * duration / step if limit else math.inf
        reserve = max(min(single_run_work, 0.5 * budget), min_cap)
        return math.ldexp(max(budget - reserve, reserve), -int(fallback_count)), reserve
    # Without implicit steps, explicit ones get all of the work.
    if is_implicit_feasible(plan):
        return max(cap - FALLBACK_EVALUATIONS, 0.5 * cap), FALLBACK_EVALUATIONS
    return max(cap, min_cap), FALLBACK_EVALUATIONS


def part_call_work(plan: Plan, contact_time: float = 0.0) -> float:
    """Return the cost of the engine calls of one part, in force evaluations: four calls for a run and its result.

    Args:
        plan: equations of motion.
        contact_time: estimated time that contact adds to a force evaluation [ns].
    """
    return 4e3 * CONSTANTS.engine_call_time / (plan.step_cost * plan.model.particle_count + contact_time)


def finish_implicitly(
    plan: Plan,
    state: State,
    t: float,
    duration: float,
    accumulator: WorkAccumulator | None,
    *,
    instead_of: str,
    max_evaluations: float,
) -> Advance:
    """Advance by a few implicit steps; the result is flagged.

    Args:
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        accumulator: work accumulator; None for none.
        instead_of: name of the integrator whose steps were abandoned.
        max_evaluations: remaining force evaluations of the frame. Steps without a solution within them become descent
            steps; these take at least 64 evaluations in all.

    Raises:
        UnstableError: if the motion does not stay finite.
    """
    if plan.contact is not None:
        # The abandoned steps have moved the jaws.
        plan.contact.load_state(state)
    if not math.isfinite(plan.energy(t, state.x, state.v)):
        raise UnstableError(f"{instead_of}: not finite even by the smallest steps, from a motion without finite energy")
    from cloth_sim_ros.physics.integrators.implicit import Implicit

    fallback_count = FallbackState.load(state).fallback_count
    implicit = Implicit(duration / CONSTANTS.implicit_finish_steps)
    result = implicit.advance(plan, state, t, duration, accumulator, max_evaluations=max_evaluations)
    # The controller states no longer describe the motion.
    reset_step_control(state)
    FallbackState(min(64.0, fallback_count + 1.0)).store(state)
    explanation = f"{instead_of}: finer steps exceed the frame's work limit"
    reason = f"{explanation}: implicit, order 2, step {result.step:.3g} s for this frame"
    return result._replace(flagged=max(1, result.flagged), reason=reason)
