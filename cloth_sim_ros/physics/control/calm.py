# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fast path of an advance: one run with the previous choice, without an error estimate.

It equals the first attempt of `explicit`, without the preparations for further attempts. For a small cloth these would
cost a fraction of its steps. It makes no decision of its own. A rejected attempt leaves the state unchanged, and
`explicit` reuses its run.
"""

from __future__ import annotations

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.book_ends import note_runs
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.choice import Choice, Options, asides, binds, reason
from cloth_sim_ros.physics.control.error import is_of, predicted_of_one
from cloth_sim_ros.physics.control.fallback import part_cost, whole_work, work_cap
from cloth_sim_ros.physics.control.hinges import HingeRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.touch import TouchRule
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.integrators.columns import SUMS, Ran
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Energy, Error, Fallback, Hinges, Noise, Precision, Stability, Touch
from cloth_sim_ros.physics.state import State

#: Keys of controllers whose state the fast path leaves unchanged.
_NOT_ASKED = (Precision.key, Energy.key)


def attempt(
    options: Options, plan: Plan, state: State, t: float, duration: float, book: Book | None
) -> Advance | Ran | None:
    """Advance a state by the fast path if it applies.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        state: advanced in place if the attempt is accepted.
        t: time at the start [s].
        duration: time to advance [s].
        book: work accumulator; None for none.

    Returns:
        The result; the run of a rejected attempt; or None without an attempt.
    """
    if options.tolerance is None or not _is_known(plan, state):
        return None
    stability, error = Stability.of(state), Error.of(state)
    if stability.omega2 < 0.0 or error.wait <= 0.0 or not is_of(error, duration):
        return None
    bare = limit = options.step_limit(stability.omega2, stability.damping)
    contact, touch, near = plan.contact, None, 0.0
    if contact is not None:
        touch = TouchRule(options, plan, Touch.of(state), stability)
        near = touch.look_ahead(t, duration, state)
        limit = touch.limit_ahead(t, duration, state)
    longest = min(CONSTANTS.safety * limit, duration)
    columns = min(int(error.columns), options.columns)
    if columns > 1 or not longest > 0.0 or steps_for(duration, CONSTANTS.part) > 1:
        return None
    refine = error.refine
    every, least = 1, 1.0
    bent = Hinges.of(state) if plan.bends else None
    if bent is not None and bent.every > 1.0:
        # The damping of the fastest waves is relevant to combinations alone.
        hinges = HingeRule(plan, bent, allowed=not near > 0.0)
        hinges.keep(longest, duration)
        every, least = hinges.within(longest, duration)
        if every != hinges.memory.every:
            return None
    steps = -(-steps_for(duration, longest / max(refine, least)) // every) * every
    stability.longest = max(stability.longest, min(bare, duration))
    if not _fits(options, plan, duration, (bare, limit), stability.longest, max(refine, least), steps, near, every):
        return None
    if touch is not None and touch.is_brief(longest, duration):
        return None
    budget = CONSTANTS.share * duration * options.tolerance
    choice, finest = Choice(1, refine, False), duration / steps
    narrow = _narrows(plan, state, duration, budget, choice)
    if book is not None:
        book.restart()
    if contact is not None:
        contact.take(state)
    made = plan.runs(
        t,
        duration,
        (state.x, state.v),
        (steps,),
        weights=(1.0,),
        narrow=narrow,
        powers=book is not None and book.powers,
        touches=book is not None and book.obstacle_count > 0,
        every=every,
    )
    runs, result = made
    assert result is not None
    x, v, told = result
    here = predicted_of_one(error, told.activity) if told.finite else budget
    harder = False
    if touch is None or contact is None:
        met = options.step_limit(told.omega2, told.damping)
    else:
        reached, gap, own = runs[0].met
        met, touch.held = touch.limit_after(reached, own, told), contact.held(gap)
        harder = touch.is_harder(touch.held)
    harder = harder or (every > 1 and hinges.exceed(every * finest, told))
    if not told.finite or harder or not here <= budget or not finest <= (met or 0.5 * finest):
        return Ran(state.x, t, duration, steps, narrow, every, made)
    stability.omega2, stability.damping = told.omega2, told.damping
    error.wait = max(0.0, error.wait - 1.0)
    if book is not None:
        note_runs(book, plan, state, t, duration, runs, (steps,), (1.0,))
    state.x, state.v = x, v
    if touch is not None and contact is not None:
        contact.pass_on(state, t + duration, runs, (1.0,))
        touch.store(state, judged=False)
    if every > 1:
        hinges.told = told.hinges
        hinges.memory.store(state)
    stability.store(state)
    error.store(state)
    return Advance(
        steps,
        steps + 1,
        finest,
        limit,
        0,
        options.name,
        binds(options, choice, steps, finest),
        here,
        0,
        reason(options, choice, steps, finest) + asides(every, narrow),
    )


def _is_known(plan: Plan, state: State) -> bool:
    """True if the state has every controller state and explicit steps finished the previous frame."""
    memory = state.memory
    for key in _NOT_ASKED:
        stored = memory.get(key)
        if stored is None or not stored.size:
            return False
    if plan.contact is not None and Touch.key not in memory:
        return False
    noise = memory.get(Noise.key)
    return (noise is None or noise.size > 0) and (Fallback.key not in memory or Fallback.of(state).fallen == 0.0)


def _fits(
    options: Options,
    plan: Plan,
    duration: float,
    limits: tuple[float, float],
    most: float,
    refine: float,
    steps: int,
    near: float,
    every: int,
) -> bool:
    """True if an attempt with an error estimate fits the work limit of the frame; otherwise `explicit` must decide.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        duration: of the advance [s].
        limits: longest stable step without and with contact [s].
        most: largest stable step without contact since the last restart [s].
        refine: refinement of the steps.
        steps: number of steps of the attempt.
        near: estimated time that contact adds to a force evaluation [ns].
        every: multirate ratio.
    """
    bare, limit = limits
    cap, _ = work_cap(plan, whole_work(plan, options.work, duration, near, every), duration, most, 0.0, near, limit)
    longest = min(CONSTANTS.safety * limit, duration)
    work = steps * SUMS[2] + (2 + part_cost(plan, near))
    return work <= cap and duration / bare <= cap and duration * refine <= cap / SUMS[2] * longest


def _narrows(plan: Plan, state: State, duration: float, budget: float, choice: Choice) -> bool:
    """True if the run uses single precision."""
    precision = Precision.of(state)
    if precision.rounding < 0.0:
        return False
    return PrecisionRule(plan, precision, Noise.of(state), duration, budget).narrows(state, choice)
