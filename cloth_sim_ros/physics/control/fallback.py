# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fallback: implicit steps that finish a frame.

A motion may be too fast for the work limit, and a user's force may grow without bound. Explicit steps then add
arbitrary energy. The descent steps of the implicit method only decrease it.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import FallbackState, StabilityState, reset_step_control
from cloth_sim_ros.physics.state.state import State

#: Force evaluations reserved to finish a frame: ten per step, at most half of the limit.
FALLBACK_EVALUATIONS = 10.0 * CONSTANTS.implicit_finish_steps


def is_implicit_feasible(plan: Plan) -> bool:
    """Return True if the sheet has few enough particles for the implicit method.

    A frame of a larger sheet would take half a minute and gigabytes of memory.
    """
    return plan.model.particle_count <= CONSTANTS.implicit_max_particles


def finish_implicitly(
    plan: Plan,
    state: State,
    t: float,
    duration: float,
    accumulator: WorkAccumulator | None,
    *,
    instead_of: str,
    max_evaluations: float,
    max_time: float = math.inf,
) -> Advance:
    """Advance a state by a few implicit steps; flag the report, reset step control, count the fallback.

    Each iteration factorises a matrix, which takes long for a large sheet. If not even the least number of iterations
    fits the time, descents use the blocks of single particles instead, which bound that matrix.

    Args:
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        accumulator: work accumulator; None for none.
        instead_of: name of the integrator whose steps were abandoned.
        max_evaluations: remaining force evaluations of the frame. Steps without a solution within them become descent
            steps; these take at least 64 evaluations in all.
        max_time: longest time by estimated cost [s].

    Raises:
        UnstableError: if the motion does not stay finite.
    """
    if not math.isfinite(plan.energy(t, state.x, state.v, state.memory)):
        raise UnstableError(f"{instead_of}: not finite even by the smallest steps, from a motion without finite energy")
    from cloth_sim_ros.physics.integrators.implicit import Implicit
    from cloth_sim_ros.physics.integrators.implicit_advance import DESCENT_ITERATIONS, ImplicitAdvance
    from cloth_sim_ros.physics.integrators.stage_matrix import iteration_cost

    fallback_count = FallbackState.load(state).fallback_count
    implicit = Implicit(duration / CONSTANTS.implicit_finish_steps)
    max_iterations = max_time / (1e-9 * iteration_cost(plan.model))
    result = ImplicitAdvance(
        implicit,
        plan,
        state,
        t,
        duration,
        accumulator,
        max_evaluations=min(max_evaluations, max_iterations),
        factorizes=max_iterations >= DESCENT_ITERATIONS * CONSTANTS.implicit_finish_steps,
    ).run()
    # The controller states no longer describe the motion. The least work limit of a frame is in runs with the longest
    # stable steps. A frame in a deformed shape must not define them, or the limit grows with the stiffness.
    max_step = StabilityState.load(state).max_step
    reset_step_control(state)
    StabilityState(max_step=max_step).store(state)
    FallbackState(min(64.0, fallback_count + 1.0)).store(state)
    explanation = f"{instead_of}: finer steps exceed the frame's work limit"
    reason = f"{explanation}: implicit, order 2, step {result.step:.3g} s for this frame"
    return result._replace(flagged=max(1, result.flagged), reason=reason)
