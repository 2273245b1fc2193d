# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fast path of an advance: one run with the previous choice, without an error estimate.

It equals the first attempt of `explicit`, without the preparations for further attempts. For a small cloth these would
cost a fraction of its steps. It makes no decision of its own. A rejected attempt leaves the state unchanged, and
`explicit` reuses its run.
"""

from __future__ import annotations

from cloth_sim_ros.physics.accounting.end_corrections import accumulate_runs
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.contact_step_limit import ContactStepLimit
from cloth_sim_ros.physics.control.error import count_down, is_for_duration, predict_single_run_error
from cloth_sim_ros.physics.control.fallback import evaluation_budget, part_call_work, work_cap
from cloth_sim_ros.physics.control.history import load_history, store_history
from cloth_sim_ros.physics.control.multirate import MultirateRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.step_choice import ExplicitSettings, StepChoice, describe_details
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS, PrecomputedRun
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state import controller_state
from cloth_sim_ros.physics.state.controller_state import (
    ContactState,
    ErrorState,
    FallbackState,
    StabilityState,
)
from cloth_sim_ros.physics.state.state import State

#: Keys of controllers whose state the fast path leaves unchanged.
_UNCHANGED_KEYS = (controller_state.PrecisionState.key, controller_state.EnergyState.key)


def try_advance(
    options: ExplicitSettings, plan: Plan, state: State, t: float, duration: float, book: WorkAccumulator | None
) -> Advance | PrecomputedRun | None:
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
    if options.tolerance is None or not _has_history(plan, state):
        return None
    stability, error = StabilityState.load(state), ErrorState.load(state)
    if stability.omega2 < 0.0 or error.time_until_estimate <= 0.0 or not is_for_duration(error, duration):
        return None
    sheet_limit = limit = options.step_limit(stability.omega2, stability.damping)
    contact, contact_limit, contact_time = plan.contact, None, 0.0
    if contact is not None:
        contact_limit = ContactStepLimit(options, plan, ContactState.load(state), stability)
        contact_time = contact_limit.predict(t, duration, state)
        limit = contact_limit.predicted_limit(t, duration, state)
    max_step = min(CONSTANTS.stability_safety * limit, duration)
    n_runs = min(int(error.n_runs), options.n_runs)
    if n_runs > 1 or not max_step > 0.0 or steps_for(duration, CONSTANTS.max_interval) > 1:
        return None
    refinement = error.refinement
    ratio, min_refinement = 1, 1.0
    multirate_state = controller_state.MultirateState.load(state) if plan.has_hinges else None
    if multirate_state is not None and multirate_state.ratio > 1.0:
        # The damping of the fastest waves is relevant to combinations alone.
        multirate = MultirateRule(plan, multirate_state, allowed=not contact_time > 0.0)
        multirate.keep(max_step, duration)
        ratio, min_refinement = multirate.ratio_within(max_step, duration)
        if ratio != multirate.memory.ratio:
            return None
    steps = -(-steps_for(duration, max_step / max(refinement, min_refinement)) // ratio) * ratio
    stability.max_step = max(stability.max_step, min(sheet_limit, duration))
    evaluations = evaluation_budget(plan, options.work, duration, contact_time, ratio)
    cap, _ = work_cap(plan, evaluations, duration, stability.max_step, 0.0, contact_time, limit)
    work = steps * RATIO_SUMS[2] + (2 + part_call_work(plan, contact_time))
    # An attempt with an error estimate must fit the work limit of the frame; otherwise `explicit` must decide.
    fits = work <= cap and duration / sheet_limit <= cap
    if not (fits and duration * max(refinement, min_refinement) <= cap / RATIO_SUMS[2] * max_step):
        return None
    if contact_limit is not None and contact_limit.should_halve(max_step, duration):
        return None
    budget = CONSTANTS.error_budget_fraction * duration * options.tolerance
    choice, step = StepChoice(1, refinement, False), duration / steps
    single_precision = _uses_single_precision(plan, state, duration, budget, choice)
    if book is not None:
        book.reset()
    if contact is not None:
        contact.load_state(state)
    result = plan.runs(
        t,
        duration,
        (state.x, state.v),
        (steps,),
        weights=(1.0,),
        single_precision=single_precision,
        record_power=book is not None and book.record_power,
        record_obstacles=book is not None and book.obstacle_count > 0,
        multirate=ratio,
        history=load_history(state, duration),
    )
    runs, combined = result
    assert combined is not None
    x, v, summary = combined
    predicted_error = predict_single_run_error(error, summary.activity, steps, step) if summary.is_finite else budget
    is_rejected = False
    if contact_limit is None or contact is None:
        limit_after = options.step_limit(summary.omega2, summary.damping)
    else:
        energy, min_gap, self_contact = runs[0].contact_summary
        limit_after = contact_limit.limit_of_run(energy, self_contact, summary)
        contact_limit.contact_energy = contact.contact_energy(min_gap)
        is_rejected = contact_limit.exceeds_known_energy(contact_limit.contact_energy)
    is_rejected = is_rejected or (ratio > 1 and multirate.exceeds_limit(ratio * step, summary))
    if not summary.is_finite or is_rejected or not predicted_error <= budget or not step <= (limit_after or 0.5 * step):
        return PrecomputedRun(state.x, t, duration, steps, single_precision, ratio, result)
    stability.omega2, stability.damping = summary.omega2, summary.damping
    count_down(error)
    store_history(state, state.v)
    if book is not None:
        accumulate_runs(book, plan, state, t, duration, runs, (steps,), (1.0,))
    state.x, state.v = x, v
    if contact_limit is not None and contact is not None:
        contact.commit(state, t + duration, runs, (1.0,))
        contact_limit.store(state, has_estimate=False)
    if ratio > 1:
        multirate.bounds = summary.hinge_bounds
        multirate.memory.store(state)
    stability.store(state)
    error.store(state)
    limited_by = choice.limiting_factor(options, steps, step)
    text = choice.describe(options, steps, step) + describe_details(ratio, single_precision)
    return Advance(steps, steps + 1, step, limit, 0, options.name, limited_by, predicted_error, 0, text)


def _has_history(plan: Plan, state: State) -> bool:
    """True if the state has every controller state and explicit steps finished the previous frame."""
    memory = state.memory
    for key in _UNCHANGED_KEYS:
        record = memory.get(key)
        if record is None or not record.size:
            return False
    if plan.contact is not None and ContactState.key not in memory:
        return False
    noise = memory.get(controller_state.RoundingNoiseState.key)
    has_fallback = FallbackState.key in memory and FallbackState.load(state).fallback_count != 0.0
    return (noise is None or noise.size > 0) and not has_fallback


def _uses_single_precision(plan: Plan, state: State, duration: float, budget: float, choice: StepChoice) -> bool:
    """True if the run uses single precision."""
    precision = controller_state.PrecisionState.load(state)
    if precision.rounding < 0.0:
        return False
    rule = PrecisionRule(plan, precision, controller_state.RoundingNoiseState.load(state), duration, budget)
    return rule.allows_single_precision(state, choice)
