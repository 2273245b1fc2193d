# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One advance by explicit steps within the work limit of a frame, with a fallback."""

from __future__ import annotations

import math

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control import fallback, fast_path
from cloth_sim_ros.physics.control.advance_context import AdvanceContext
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.contact_step_limit import ContactStepLimit
from cloth_sim_ros.physics.control.energy import EnergyRule
from cloth_sim_ros.physics.control.error import ErrorRule, is_for_duration
from cloth_sim_ros.physics.control.history import load_history, store_history
from cloth_sim_ros.physics.control.interval import Interval
from cloth_sim_ros.physics.control.multirate import MultirateRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.control.step_choice import ExplicitSettings, StepChoice, describe_details
from cloth_sim_ros.physics.integrators.base import Advance, NoRoomError, UnstableError, refuse_step, refuse_unbounded
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS, PrecomputedRun
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state import controller_state
from cloth_sim_ros.physics.state.controller_state import (
    HISTORY_KEYS,
    ContactState,
    ErrorState,
    FallbackState,
    StabilityState,
)
from cloth_sim_ros.physics.state.state import State


def advance(
    options: ExplicitSettings, plan: Plan, state: State, t: float, duration: float, accumulator: WorkAccumulator | None
) -> Advance:
    """Advance a state by a duration: by the fast path, else by `ExplicitAdvance`."""
    result = fast_path.try_advance(options, plan, state, t, duration, accumulator)
    if isinstance(result, Advance):
        return result
    return ExplicitAdvance(options, plan, state, t, duration, accumulator, result).run()


class ExplicitAdvance:
    """One advance of a state by a duration.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        state: advanced in place.
        t: time at the start [s].
        duration: time to advance [s].
        accumulator: work accumulator; None for none.
        precomputed_run: run of a rejected fast path; None for none.
    """

    def __init__(
        self,
        options: ExplicitSettings,
        plan: Plan,
        state: State,
        t: float,
        duration: float,
        accumulator: WorkAccumulator | None,
        precomputed_run: PrecomputedRun | None = None,
    ) -> None:
        self._options, self._plan, self._state, self._accumulator = options, plan, state, accumulator
        self._t, self._duration, self._start_velocities = t, duration, state.v
        self._has_history = StabilityState.key in state.memory
        self._memory = memory = StabilityState.load(state)
        stability = StabilityRule(plan, memory, state, duration)
        refuse_unbounded(memory.omega2, memory.damping)
        #: Longest stable step without contact [s].
        self._sheet_limit = limit = options.step_limit(memory.omega2, memory.damping)
        error, precision = ErrorState.load(state), controller_state.PrecisionState.load(state)
        noise = controller_state.RoundingNoiseState.load(state)
        if not is_for_duration(error, duration):
            # The recorded errors belong to frames of another length.
            error = ErrorState(n_runs=error.n_runs, refinement=error.refinement, duration=duration)
            for key in HISTORY_KEYS:
                state.memory.pop(key, None)
            precision, noise = controller_state.PrecisionState(), controller_state.RoundingNoiseState()
        n_runs, last_refinement, has_tolerance = options.n_runs, 0.0, options.tolerance is not None
        if has_tolerance:
            n_runs = min(int(error.n_runs), n_runs)
        elif error.time_until_estimate <= 0.0:
            # Larger steps than the energy rule required are tried periodically.
            last_refinement, error.refinement = error.refinement, max(1.0, 0.5 * error.refinement)
        estimates_error, budget = has_tolerance and error.time_until_estimate <= 0.0, math.inf
        if options.tolerance is not None:
            budget = CONSTANTS.error_budget_fraction * duration * options.tolerance
        # A fixed step of a running simulation was stable at its start.
        proven_step = options.step if options.step is not None and self._has_history else 0.0
        memory.max_step = max(memory.max_step, min(max(limit, proven_step), duration))
        self._fallback_count = FallbackState.load(state).fallback_count
        contact = ContactState() if plan.contact is None else ContactState.load(state)
        contact_limit = ContactStepLimit(options, plan, contact, memory)
        contact_time = contact_limit.predict(t, duration, state)
        # Waves of contact may have any frequency, without damping.
        allows_multirate = has_tolerance and stability.is_damped and not contact_time > 0.0
        multirate = MultirateRule(plan, controller_state.MultirateState.load(state), allowed=allows_multirate)
        max_step = min(CONSTANTS.stability_safety * limit, duration)
        if estimates_error:
            multirate.choose(state.x, max_step, duration, n_runs)
        else:
            multirate.keep(max_step, duration)
        # The recorded error is valid for the same multirate ratio only.
        estimates_error = estimates_error or (has_tolerance and multirate.ratio != multirate.memory.ratio)
        self._context = AdvanceContext(
            options=options,
            plan=plan,
            state=state,
            accumulator=accumulator,
            stability=memory,
            energy=EnergyRule(plan, controller_state.EnergyState.load(state), last_refinement),
            precision=PrecisionRule(plan, precision, noise, duration, budget),
            multirate=multirate,
            contact_limit=contact_limit,
            duration=duration,
            max_evaluations=math.inf,
            part_call_work=fallback.part_call_work(plan, contact_time),
            may_touch=contact_time > 0.0,
            precomputed_run=precomputed_run,
            history=load_history(state, duration),
        )
        rule = ErrorRule(error, stability, budget, options.n_runs, state)
        choice = StepChoice(n_runs, error.refinement, estimates_error)
        self._interval = Interval(self._context, t, duration, choice, rule)
        self._limit = self._interval.limit
        #: Limit of force evaluations of the frame.
        self._max_evaluations = fallback.evaluation_budget(plan, options.work, duration, contact_time, multirate.ratio)
        limits = duration, memory.max_step, self._fallback_count, contact_time, self._limit
        work, self._reserve = fallback.work_cap(plan, self._max_evaluations, *limits)
        self._grant_work(work)

    def _grant_work(self, work: float) -> None:
        """Grant the interval further work, in force evaluations."""
        context = self._context
        context.max_evaluations = context.evaluations + context.call_work + work
        if self._options.tolerance is not None:
            # An attempt with an error estimate must fit.
            self._interval.max_first_steps = work / RATIO_SUMS[2]

    def run(self) -> Advance:
        """Advance the state and return the result.

        Raises:
            UnstableError: if no step within the work limit is stable.
            StepLimitError: if a fixed step exceeds the limit at the start.
        """
        options, state, context, interval = self._options, self._state, self._context, self._interval
        if options.step is not None and options.step > self._limit and not self._has_history:
            refuse_step(options.step, self._limit, options.name)
        # Even the longest stable steps may exceed the work limit of the frame.
        context.abandoned = self._duration / self._sheet_limit > context.max_evaluations and context.has_fallback
        fits = interval.fits_budget(interval.choice.n_runs, interval.choice.refinement)
        if options.tolerance is not None and not fits:
            # The previous choice exceeds the limit: the attempt has as many runs as fit, and steps that leave work for
            # a second attempt.
            n_runs = interval.choice.n_runs
            while n_runs > 1 and not interval.fits_budget(n_runs, 1.0):
                n_runs -= 1
            work = interval.estimate_work(n_runs, 1.0)
            max_refinement = context.max_evaluations / work / CONSTANTS.max_refinement_factor
            interval.choice = StepChoice(n_runs, max(1.0, min(interval.choice.refinement, max_refinement)), True)
        if interval.choice.estimates_error and not context.abandoned:
            if fits:
                context.evaluations += context.precision.measure(self._t, state, interval.max_step, interval.choice)
                interval.choice = context.clamp(interval.choice, interval.estimate_work, 0.0)
            context.precision.update_kinetic_energy(state)
        error = self._integrate()
        if error is None and context.has_explicit_fallback:
            error = self._integrate_fallback()
        if error is None:
            return self._finish_implicitly()
        interval = self._interval
        if interval.n_pieces > 1:
            interval.rule.record_halving(interval.choice.n_runs, self._mean_refinement())
        for memory in (self._memory, interval.rule.memory, context.precision.memory, context.energy.memory):
            memory.store(state)
        if options.tolerance is not None:
            store_history(state, self._start_velocities)
        if self._plan.has_hinges:
            context.multirate.memory.ratio = float(context.multirate.ratio)
            context.multirate.memory.store(state)
        if context.precision.noise.power >= 0.0 or controller_state.RoundingNoiseState.key in state.memory:
            context.precision.noise.store(state)
        context.contact_limit.store(state, has_estimate=interval.choice.estimates_error or interval.n_pieces > 1)
        if self._fallback_count or context.in_fallback:
            FallbackState(min(64.0, self._fallback_count + 1.0) if context.in_fallback else 0.0).store(state)
        flagged = int(options.tolerance is not None and error > interval.rule.budget)
        limited_by = interval.choice.limiting_factor(options, interval.first_run_steps, interval.min_step)
        return Advance(
            steps=interval.steps,
            evaluations=context.evaluations,
            step=interval.min_step,
            limit=self._limit,
            rejected=context.rejected,
            integrator=options.name,
            limited_by="work" if context.exhausted else limited_by,
            error=error if options.tolerance is not None else None,
            flagged=flagged,
            reason=self._describe(flagged),
        )

    def _integrate(self) -> float | None:
        """Integrate the interval.

        Returns:
            The error [m]; None if explicit steps are abandoned. The state is then that of the start.
        """
        interval = self._interval
        if self._accumulator is not None:
            self._accumulator.reset()
        try:
            error = interval.integrate()
        except NoRoomError:
            # Moving bodies left the cloth no space within the frame: no step is short enough.
            self._state.restore_motion(interval.start)
            if not fallback.is_implicit_feasible(self._plan):
                raise
            return None
        except UnstableError:
            self._state.restore_motion(interval.start)
            raise
        if error is None:
            self._state.restore_motion(interval.start)
        return error

    def _integrate_fallback(self) -> float | None:
        """Integrate by a single run of the longest stable steps, within the reserve; see `_integrate`."""
        context = self._context
        context.in_fallback, context.exhausted, context.abandoned = True, True, False
        choice, rule = StepChoice(1, 1.0, True), self._interval.rule
        self._interval = Interval(context, self._t, self._duration, choice, rule)
        self._grant_work(self._reserve)
        return self._integrate()

    def _mean_refinement(self) -> float:
        """Return the number of steps of the first runs relative to the number that stability requires."""
        return max(1.0, self._interval.first_run_steps * self._interval.max_step / self._duration)

    def _describe(self, flagged: int) -> str:
        """Return the choice in words."""
        interval, context = self._interval, self._context
        text = interval.choice.describe(self._options, interval.first_run_steps, interval.min_step)
        if interval.n_pieces > 1:
            text += f" in the finest of {interval.n_pieces} stretches"
        text += describe_details(interval.ratio, context.single_precision)
        if flagged and context.exhausted:
            text += f"; the tolerance was missed within the frame's work limit of {self._options.work:g}"
        elif flagged:
            text += "; the tolerance is finer than rounding of the coordinates allows"
        return text

    def _finish_implicitly(self) -> Advance:
        """Finish the frame by implicit steps."""
        context = self._context
        # The key of the state must stay, see `reset_step_control`.
        self._memory.store(self._state)
        if self._accumulator is not None:
            self._accumulator.reset()
        plan, state, name = self._plan, self._state, self._options.name
        remaining = self._max_evaluations - context.evaluations - context.call_work
        result = fallback.finish_implicitly(
            plan, state, self._t, self._duration, self._accumulator, instead_of=name, max_evaluations=remaining
        )
        return result._replace(
            evaluations=context.evaluations + result.evaluations,
            limit=self._limit,
            rejected=context.rejected,
            limited_by="work",
            error=result.error if self._options.tolerance is not None else None,
        )
