# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fallback rule: work limit of a frame, and implicit steps that finish it.

A motion may be too fast for the work limit, and a user's force may grow without bound. Explicit steps then add
arbitrary energy. The descent steps of the implicit method only decrease it.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.physics.integrators.columns import SUMS
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Fallback, restart
from cloth_sim_ros.physics.state import State

#: Force evaluations reserved to finish a frame: ten per step, at most half of the limit.
FINISHED = 10.0 * CONSTANTS.last_steps


def within_reach(plan: Plan) -> bool:
    """Return True if the sheet is small enough for the implicit method.

    A frame of a larger sheet would take half a minute and gigabytes of memory.
    """
    return plan.model.particle_count <= CONSTANTS.implicit


def whole_work(plan: Plan, work: float, duration: float, met: float = 0.0, every: int = 1) -> float:
    """Return the force evaluations of an advance within a work limit; infinite without a limit.

    Args:
        plan: equations of motion.
        work: limit as a multiple of real time by the plan's estimated cost; 0 for none.
        duration: of the advance [s].
        met: estimated time that contact adds to a force evaluation [ns].
        every: multirate ratio.
    """
    if work == 0.0:
        return math.inf
    return work * duration / (1e-9 * plan.cost(every) * plan.model.particle_count + 1e-9 * met)


def work_cap(
    plan: Plan,
    whole: float,
    duration: float,
    longest: float,
    fallen: float,
    met: float = 0.0,
    limit: float = math.inf,
) -> tuple[float, float]:
    """Return the limit of force evaluations by explicit steps, and the reserve of the fallback; no clock is read.

    Each consecutive fallback halves the limit of the next frame. With contact, single runs of explicit steps finish a
    frame, and the reserve is twice their work. Implicit steps would be slower, because contact couples distant
    particles in their matrix, and they have no friction.

    Args:
        plan: equations of motion.
        whole: force evaluations of the frame, see `evaluation_budget`.
        duration: of the advance [s].
        longest: longest stable step since the last restart, without contact [s].
        fallen: consecutive frames with a fallback.
        met: estimated time that contact adds to a force evaluation [ns].
        limit: predicted step limit with contact [s].
    """
    if whole == math.inf:
        return math.inf, math.inf
    runs = CONSTANTS.work * duration / longest
    most = math.ldexp(whole, -int(fallen))
    if met:
        single = CONSTANTS.trust * SUMS[2] * duration / (CONSTANTS.safety * limit) if limit else math.inf
        kept = max(min(single, 0.5 * whole), runs)
        return math.ldexp(max(whole - kept, kept), -int(fallen)), kept
    # Without implicit steps, explicit ones get all of the work.
    return max(most - FINISHED, 0.5 * most) if within_reach(plan) else max(most, runs), FINISHED


def part_cost(plan: Plan, met: float = 0.0) -> float:
    """Return the cost of the engine calls of one part, in force evaluations: four calls for a run and its result.

    Args:
        plan: equations of motion.
        met: estimated time that contact adds to a force evaluation [ns].
    """
    return 4e3 * CONSTANTS.call / (plan.step_cost * plan.model.particle_count + met)


def finish(
    plan: Plan, state: State, t: float, duration: float, book: Book | None, *, instead_of: str, most: float
) -> Advance:
    """Advance by a few implicit steps; the result is flagged.

    Args:
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        book: work accumulator; None for none.
        instead_of: name of the integrator whose steps were abandoned.
        most: remaining force evaluations of the frame. Steps without a solution within them become descent steps; these
            take at least 64 evaluations in all.

    Raises:
        UnstableError: if the motion does not stay finite.
    """
    if plan.contact is not None:
        # The abandoned steps have moved the jaws.
        plan.contact.take(state)
    if not math.isfinite(plan.energy(t, state.x, state.v)):
        raise UnstableError(f"{instead_of}: not finite even by the smallest steps, from a motion without finite energy")
    from cloth_sim_ros.physics.integrators.implicit import Implicit

    fallen = Fallback.of(state).fallen
    done = Implicit(duration / CONSTANTS.last_steps).advance(plan, state, t, duration, book, most=most)
    # The controller states no longer describe the motion.
    restart(state)
    Fallback(min(64.0, fallen + 1.0)).store(state)
    why = f"{instead_of}: finer steps exceed the frame's work limit"
    return done._replace(
        flagged=max(1, done.flagged), reason=f"{why}: implicit, order 2, step {done.step:.3g} s for this frame"
    )
