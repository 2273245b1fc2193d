# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rule of the fallback: the cap of a frame's work, and the steps that finish a frame which explicit ones can't
follow within it.

A sheet may be too violent for what its work may cost, and a force of the caller's own may grow beyond all bounds. A
motion that meets such a place is kicked by whatever the step makes of it. The implicit method's safe steps only go
where the energy falls.
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

#: Force evaluations that finishing a frame is counted with: ten a step. Of the cap they are left over, by half at most.
FINISHED = 10.0 * CONSTANTS.last_steps


def within_reach(plan: Plan) -> bool:
    """Whether the implicit method comes into question for a sheet of this size: a frame of a larger one would take half
    a minute and gigabytes.
    """
    return plan.model.particle_count <= CONSTANTS.implicit


def whole_work(plan: Plan, work: float, duration: float, met: float = 0.0, every: int = 1) -> float:
    """Return the force evaluations that the work of an advance is worth; infinite where it has no limit.

    Args:
        plan: equations of motion.
        work: limit in real time by the plan's estimated cost; 0 for none.
        duration: of the advance [s].
        met: estimated time that contact adds to a force evaluation [ns].
        every: force evaluations in which hinges are asked for once.
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
    """Return the most force evaluations of an advance by explicit steps, and those beside that are left over to finish
    it; counts, never a clock.

    What could not be followed in the frames before is tried with half the effort in each further one. Where the cloth
    touches, explicit steps by single runs finish a frame, for which that is left over twice: implicit steps would take
    longer, for contact couples what is far apart in their matrix, and they follow no friction.

    Args:
        plan: equations of motion.
        whole: force evaluations that its work is worth, see `whole_work`.
        duration: of the advance [s].
        longest: longest stable step since the last restart, contact aside [s].
        fallen: frames in a row that could not be followed.
        met: estimated time that contact adds to a force evaluation [ns].
        limit: longest step that contact lets expect [s].
    """
    if whole == math.inf:
        return math.inf, math.inf
    runs = CONSTANTS.work * duration / longest
    most = math.ldexp(whole, -int(fallen))
    if met:
        single = CONSTANTS.trust * SUMS[2] * duration / (CONSTANTS.safety * limit) if limit else math.inf
        kept = max(min(single, 0.5 * whole), runs)
        return math.ldexp(max(whole - kept, kept), -int(fallen)), kept
    # Where implicit steps are out of reach, explicit ones are all that there is.
    return max(most - FINISHED, 0.5 * most) if within_reach(plan) else max(most, runs), FINISHED


def part_cost(plan: Plan, met: float = 0.0) -> float:
    """Return what the calls of one part of a frame cost, in force evaluations, to which contact adds so much
    [ns]: a run and what is asked of its result, four calls.
    """
    return 4e3 * CONSTANTS.call / (plan.step_cost * plan.model.particle_count + met)


def finish(
    plan: Plan, state: State, t: float, duration: float, book: Book | None, *, instead_of: str, most: float
) -> Advance:
    """Advance by a few implicit steps; at least one is flagged.

    Args:
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        book: notes the motion.
        instead_of: name of the integrator whose steps were given up.
        most: force evaluations that are left of the frame's work: what can't be solved within them is taken as a step
            that has no solution is, 64 evaluations in all at least.

    Raises:
        UnstableError: if the motion does not stay finite.
    """
    if plan.contact is not None:
        # Pads are still where the steps that were given up had laid them.
        plan.contact.take(state)
    if not math.isfinite(plan.energy(t, state.x, state.v)):
        raise UnstableError(f"{instead_of}: not finite even by the smallest steps, from a motion without finite energy")
    from cloth_sim_ros.physics.integrators.implicit import Implicit

    fallen = Fallback.of(state).fallen
    done = Implicit(duration / CONSTANTS.last_steps).advance(plan, state, t, duration, book, most=most)
    # What was known of the motion is true no longer.
    restart(state)
    Fallback(min(64.0, fallen + 1.0)).store(state)
    why = f"{instead_of}: finer steps exceed the frame's work limit"
    return done._replace(
        flagged=max(1, done.flagged), reason=f"{why}: implicit, order 2, step {done.step:.3g} s for this frame"
    )
