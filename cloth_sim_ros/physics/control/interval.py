# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive interval: attempts by explicit steps until stability, error and energy rules hold.

One choice of runs and steps applies to the whole interval. If a refinement reduces the error less than its order
predicts, the motion is not smooth: a spring turned over, or a force changed suddenly. Then the interval is halved, so
that fine steps are limited to that moment.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.arithmetic.deterministic_math import root
from cloth_sim_ros.physics.control.advance_context import AdvanceContext
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.error import ErrorRule, ErrorSums
from cloth_sim_ros.physics.control.force_jump import EVALUATIONS, missed_velocity_change
from cloth_sim_ros.physics.control.stability import MAX_UNDAMPED_STEPS, StabilityRule
from cloth_sim_ros.physics.control.step_choice import StepChoice
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.integrators.extrapolation_tableau import (
    RATIO_SUMS,
    VELOCITY_ERROR_TIME,
    ExtrapolationTableau,
    step_counts,
)
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.plan.runs import History
from cloth_sim_ros.physics.state.controller_state import ErrorState
from cloth_sim_ros.physics.state.state import State

#: Minimum steps of the first run for halving; with fewer steps the runs of a half would not differ enough.
_MIN_HALVED_STEPS = 2 * MAX_UNDAMPED_STEPS
#: Maximum halvings of an advance; the shortest interval of a frame is then below a nanosecond.
_MAX_HALVINGS = 24
#: Failure of steps that create energy. The drive of a gripper's jaws may be its source; implicit steps finish then.
_CREATES_ENERGY = "making energy from nowhere"
#: Plausible gain of a combination of two runs over a single one.
_FIRST_GAIN = 0.1
#: Attempts of an interval after which steps without a work limit fail: finer ones would fail too, as with a force that
#: is not finite.
_MAX_FAILED_ATTEMPTS = 12


class Interval:
    """Advances the state of a context over one interval.

    Args:
        context: context of the advance.
        t: time at the start [s].
        duration: length [s].
        choice: first choice of runs and refinement.
        rule: error rule with the budget of this interval, and the stability rule for its length.
        reserved: force evaluations reserved for the rest of the advance.
        n_halvings: number of halvings that led to this interval.
    """

    def __init__(
        self,
        context: AdvanceContext,
        t: float,
        duration: float,
        choice: StepChoice,
        rule: ErrorRule,
        *,
        reserved: float = 0.0,
        n_halvings: int = 0,
    ) -> None:
        self._context, self._t, self._duration = context, t, duration
        self.choice, self.rule, self._stability = choice, rule, rule.stability
        self._history = context.history
        self._reserved, self._n_halvings = reserved, n_halvings
        #: Maximum steps of the first run. If it needs more, the interval is halved before the first attempt, because
        #: short steps are rarely necessary for long.
        self.max_first_steps = math.inf
        self.limit, self.start = context.contact_limit.predicted_limit(t, duration, context.state), context.state
        #: Steps of the runs that make up the result, those of the first run, the smallest step [s], and the number of
        #: intervals after halving.
        self.steps, self.first_run_steps, self.min_step, self.n_pieces = 0, 0, math.inf, 1
        #: Rejected attempts; True if the interval must be halved next.
        self._n_rejected, self._must_halve = 0, False
        self._first_tableau: ExtrapolationTableau | None = None
        self._sums, self._steps_per_part, self._contact_energy = ErrorSums(), 0, 0.0
        #: Multirate ratio.
        self.ratio, self._stability.multirate_refinement = context.multirate.ratio_within(self.max_step, duration)

    @property
    def max_step(self) -> float:
        """Largest step that stability allows [s]."""
        return min(CONSTANTS.stability_safety * self.limit, self._duration)

    def integrate(self) -> float | None:
        """Integrate the interval.

        Returns:
            The sum of its errors [m]; None if explicit steps are abandoned.

        Raises:
            UnstableError: if no choice is left.
        """
        context = self._context
        state, memory, accumulator = context.state, context.stability, context.accumulator
        self.start = start = state.shallow_copy()
        bounds_before = memory.omega2, memory.damping, context.multirate.bounds
        saved_work = None if accumulator is None else accumulator.save()
        max_step = self.max_step
        if self._duration * self.choice.refinement > self.max_first_steps * max_step:
            if self._n_halvings < _MAX_HALVINGS and context.fits_budget(self._reserved):
                return self._integrate_halves()
            context.exhausted, self.choice = True, StepChoice(self.choice.n_runs, 1.0, True)
            context.abandoned = self._duration > self.max_first_steps * max_step and context.has_fallback
        if context.contact_limit.should_halve(max_step, self._duration) and self._n_halvings < _MAX_HALVINGS:
            return self._integrate_halves(was_attempted=True)
        if self._n_halvings and not context.abandoned:
            self.choice = context.clamp(self.choice, self.estimate_work, self._reserved)
        while not context.abandoned:
            error = self._attempt(start)
            if error is not None and self._n_halvings:
                error = self._check_end(error)
            if error is not None:
                return error
            state.restore_motion(start)
            memory.omega2, memory.damping, context.multirate.bounds = bounds_before
            if accumulator is not None and saved_work is not None:
                accumulator.restore(saved_work)
            context.rejected += 1
            self._n_rejected += 1
            if self._must_halve and not context.abandoned:
                return self._integrate_halves()
        return None

    def _integrate_halves(self, *, was_attempted: bool = False) -> float | None:
        """Integrate both halves, each with its own choice; return as `integrate`."""
        context, choice, half, error_sum = self._context, self.choice, 0.5 * self._duration, 0.0
        context.history = self._history
        max_first_steps = min(self.max_first_steps, self.first_run_steps or math.inf)
        self.steps, self.first_run_steps, self.min_step, self.n_pieces = 0, 0, math.inf, 0
        for k in range(2):
            # The second half gets the unused budget of the first one.
            budget = max(0.5 * self.rule.budget, (self.rule.budget - error_sum) * k)
            stability = StabilityRule(context.plan, context.stability, context.state, half)
            rule = self.rule.for_interval(ErrorState(duration=half), budget, context.state, stability)
            # Reserve of the other half: its steps may be as long as before, but it takes at least as many as this one.
            refinement = max(1.0, choice.refinement * min(1.0, half / self.max_step))
            later_steps = refinement * max(1.0, half / (CONSTANTS.stability_safety * context.stability.max_step))
            reserved = self._reserved + later_steps * RATIO_SUMS[choice.n_runs + 1] * (k == 0)
            t, n_halvings = self._t + k * half, self._n_halvings + 1
            child = Interval(context, t, half, choice, rule, reserved=reserved, n_halvings=n_halvings)
            child.max_first_steps = max_first_steps
            # The half starts with the steps that were too long for the whole.
            max_step = min(child.max_step, self.max_step) if was_attempted else child.max_step
            child.choice = StepChoice(choice.n_runs, max(1.0, choice.refinement * max_step / self.max_step), True)
            error = child.integrate()
            if error is None:
                return None
            error_sum += error
            self.steps, self.first_run_steps = self.steps + child.steps, self.first_run_steps + child.first_run_steps
            self.n_pieces, self.min_step = self.n_pieces + child.n_pieces, min(self.min_step, child.min_step)
        return error_sum

    def _attempt(self, start: State) -> float | None:
        """Run all parts; return the sum of their errors [m], or None for a further attempt from the start."""
        context, choice, rule = self._context, self.choice, self.rule
        options, max_step, contact_limit = context.options, self.max_step, context.contact_limit
        self.ratio, self._stability.multirate_refinement = context.multirate.ratio_within(max_step, self._duration)
        if options.step is not None:
            max_step = options.step if options.step <= self.limit else min(options.step, max_step)
        required_refinement = 1.0 if options.tolerance is None else self._stability.required_refinement(choice.n_runs)
        steps = steps_for(self._duration, max_step / max(choice.refinement, required_refinement))
        n_parts = self._n_parts(choice.n_runs, steps)
        length = self._duration / n_parts
        self._steps_per_part = max(1, math.ceil(steps / n_parts / self.ratio)) * self.ratio
        self.min_step = length / self._steps_per_part
        self.first_run_steps, self.steps = n_parts * self._steps_per_part, 0
        self._sums, self._must_halve, self._contact_energy = ErrorSums(), False, 0.0
        context.history = self._history
        for part in range(n_parts):
            if not self._integrate_part(part, length, start):
                return None
        if choice.estimates_error:
            counts = step_counts(self._steps_per_part, ratio=self.ratio)
            refinement = max(choice.refinement, required_refinement)
            rule.record_estimate(self.choice.n_runs, refinement, self._sums, counts, length)
        else:
            rule.record_prediction(choice.n_runs, self._sums)
        contact_limit.contact_energy = max(contact_limit.contact_energy, self._contact_energy)
        return self._sums.error

    def _n_parts(self, n_runs: int, steps: int) -> int:
        """Return the number of parts of the interval."""
        is_plain_run = n_runs == 1 and self._context.options.tolerance is None
        return 1 if is_plain_run else self._stability.n_parts(n_runs, steps, self._duration)

    def _integrate_part(self, part: int, length: float, start: State) -> bool:
        """Run one part; return True if all rules hold."""
        context, choice = self._context, self.choice
        state, options, memory = context.state, context.options, context.stability
        t = self._t + part * length
        tableau = self._tableau_of_part(part, t, length, start)
        evaluations_before = tableau.evaluations
        is_finite = (summary := tableau.summary(choice.n_runs)).is_finite
        context.evaluations += tableau.evaluations - evaluations_before
        context.call_work += context.part_call_work
        # If contact is too stiff for the steps, an error estimate is a waste.
        if is_finite and context.contact_limit.has_contact(tableau, choice.n_runs) and not self._check_limit(tableau):
            return False
        accepted = True
        if is_finite and options.tolerance is not None:
            accepted = self._check_error(tableau, summary.activity, part, length / self._duration)
        if not is_finite:
            # Contact did not stop a particle; with finer steps it would not have got that far. If the run ended on a
            # surface, the limit is zero, and the steps were too long.
            energy, rates = tableau.encountered_energy(choice.n_runs), tableau.self_contact(choice.n_runs)
            limit = context.contact_limit.limit_at_energy(energy, rates) or 0.5 * self.min_step
            factor, self.limit = 2.0 if self.min_step <= limit else 1.0, min(self.limit, limit)
            return self._retry(factor, "not finite")
        if not (accepted and self._check_limit(tableau)):
            return False
        choice, summary = self.choice, tableau.summary(self.choice.n_runs)
        omega2_after = math.inf if context.contact_limit.has_contact(tableau, choice.n_runs) else summary.omega2
        # Without a reliable error estimate the steps may create energy.
        is_unknown = options.tolerance is None or self._sums.error > self.rule.budget
        steps_differ = choice.n_runs > 1 or self._n_halvings > 0
        if is_unknown and context.energy.must_check(memory.omega2, omega2_after, steps_differ, choice.refinement):
            # The energy of a combination does not oscillate; a change of step size makes the deviation permanent.
            step = 0.0 if steps_differ else self.min_step
            if context.creates_energy(tableau, choice, (t, t + length), step):
                return self._retry(2.0, _CREATES_ENERGY)
        memory.omega2, memory.damping, hinge_bounds = summary.omega2, summary.damping, summary.hinge_bounds
        context.multirate.bounds = hinge_bounds if self.ratio > 1 else context.multirate.bounds
        if context.accumulator is not None:
            tableau.accumulate(choice.n_runs, context.accumulator)
        self.steps += sum(tableau.counts[: choice.n_runs])
        earlier, context.history = context.history, History(state.v, None, length)
        if earlier is not None and earlier.length == length:
            context.history = History(state.v, earlier.previous, length)
        tableau.commit(choice.n_runs, state)
        return True

    def _check_limit(self, tableau: ExtrapolationTableau) -> bool:
        """Return True if the steps of a part are within the limit that the motion encountered; else choose a retry."""
        limit = self._context.contact_limit.encountered_limit(tableau, self.choice.n_runs) or 0.5 * self.min_step
        exceeds_limit, summary = self._context.multirate.exceeds_limit, tableau.summary(self.choice.n_runs)
        if self.min_step <= limit and (self.ratio == 1 or not exceeds_limit(self.ratio * self.min_step, summary)):
            return True
        self.limit = min(self.limit, limit)
        return self._retry(1.0, "not within their stability limit")

    def _tableau_of_part(self, part: int, t: float, length: float, start: State) -> ExtrapolationTableau:
        """Return the tableau of a part; that of the first part is reused by attempts with the same steps."""
        context, first, accumulator = self._context, self._first_tableau, self._context.accumulator
        counts = step_counts(self._steps_per_part, ratio=self.ratio, coprime=self._n_halvings > 0)
        error_was_too_large = self._n_rejected + self._n_halvings > 0 and context.plan.threads_per_run(self.ratio) == 1
        if context.options.tolerance is not None:
            # The measured effect belongs to a whole advance, and does not decrease with the interval.
            allows = context.precision.allows_single_precision
            context.single_precision = self._n_halvings == 0 and allows(context.state, self.choice)
        if (
            first is not None
            and part == 0
            and (first.counts, first.duration, first.ratio) == (counts, length, self.ratio)
            and context.single_precision >= first.single_precision
        ):
            context.single_precision = first.single_precision
            return first
        tableau = ExtrapolationTableau(
            context.plan,
            start if part == 0 else context.state,
            t,
            length,
            counts,
            record_power=accumulator is not None and accumulator.record_power,
            record_obstacles=accumulator is not None and accumulator.obstacle_count > 0,
            single_precision=context.single_precision,
            jaw_time=context.duration,
            history=context.history,
            precomputed_run=context.precomputed_run,
            ratio=self.ratio,
            expected_runs=self.choice.expected_runs(context.options.tolerance, error_was_too_large=error_was_too_large),
        )
        self._first_tableau = tableau if part == 0 else first
        return tableau

    def _check_error(self, tableau: ExtrapolationTableau, activity: float, part: int, fraction: float) -> bool:
        """Add the error of a part to that of the interval; return True if it fits, else choose a retry.

        Args:
            tableau: tableau of the part.
            activity: its activity [m/s].
            part: its index.
            fraction: its length relative to the interval.
        """
        elapsed_fraction = (part + 1) * fraction
        context, choice, rule, sums = self._context, self.choice, self.rule, self._sums
        change = tableau.change(choice.n_runs - 1) if choice.n_runs > 1 else (0.0, 0.0)
        counts = tableau.counts[: choice.n_runs]
        predicted, predicted_lower_order = rule.predict(counts, tableau.duration, change, activity)
        contact_energy = tableau.contact_energy(choice.n_runs)
        self._contact_energy = max(self._contact_energy, contact_energy)
        if context.contact_limit.exceeds_known_energy(contact_energy):
            # The contact is harder than in the frame of the last estimate, or the first one.
            predicted = math.inf
        if not choice.estimates_error:
            sums.error += predicted
            sums.lower_order_error += predicted_lower_order
            if sums.error <= rule.budget:
                return True
            # All parts need an estimate, because one choice applies to the whole interval. Existing runs are reused.
            reusable = tableau.evaluations if tableau is self._first_tableau else 0
            choice = StepChoice(choice.n_runs, choice.refinement, True)
            self.choice = context.clamp(choice, self.estimate_work, self._reserved, reusable)
            return False
        errors: list[float] = []
        for _ in range(choice.n_runs):
            self._append_estimate(errors, tableau)
        is_accepted = sums.error + errors[-1] <= rule.budget or context.exhausted
        if not is_accepted or choice.refinement > 1.0:
            error_target = CONSTANTS.error_target_fraction * rule.budget * elapsed_fraction
            reserved = self._reserved + (1.0 - elapsed_fraction) * self.estimate_work(choice.n_runs, choice.refinement)
            while len(errors) < context.options.n_runs and sums.error + errors[-1] > error_target:
                is_affordable = context.fits_budget(reserved + tableau.counts[len(errors) + 1])
                # If runs do not gain on one another, as at a force jump, a further run does not either.
                is_useless = len(errors) > 1 and errors[-1] > errors[-2]
                resolves = context.precision.resolves_error(len(errors) + 2)
                if not is_affordable or is_useless or (tableau.single_precision and not resolves):
                    break
                self._append_estimate(errors, tableau)
        if not is_accepted:
            # A combination of more existing runs may suffice. If the motion is not smooth, all further estimates must
            # confirm it, because one of them may be small by chance.
            fits = [sums.error + error <= rule.budget for error in errors]
            n_confirming = len(errors) if self._n_halvings else 0
            sufficient = [k for k, fit in enumerate(fits, start=1) if fit and all(fits[k - 1 : n_confirming])]
            if sufficient:
                self.choice = choice = StepChoice(sufficient[0], choice.refinement, True)
                is_accepted = True
        changes = [tableau.change(k) for k in range(1, len(errors) + 1)]
        sums.add_estimate(errors, changes, choice.n_runs, predicted, activity)
        floor = rule.rounding_floor(choice.n_runs)
        if is_accepted or sums.error <= CONSTANTS.estimate_trust_factor * sums.n_parts * floor:
            return True  # no step reduces the error below rounding
        refinement = max(choice.refinement, self._stability.multirate_refinement)
        n_runs, next_refinement = rule.choose([error / elapsed_fraction for error in sums.errors], refinement)
        # A single estimate does not show whether the motion is smooth.
        is_smooth = len(sums.errors) == 1 or CONSTANTS.estimate_trust_factor * min(sums.errors) < sums.errors[0]
        return not self._choose_finer(n_runs, next_refinement, is_smooth=is_smooth)

    def _check_end(self, error: float) -> float | None:
        """Return the error of an interval [m] including its first and last half steps; None for a further attempt."""
        context, half_step = self._context, 0.5 * self.min_step
        for state, t, duration in (
            (self.start, self._t, -half_step),
            (context.state, self._t + self._duration, half_step),
        ):
            change = missed_velocity_change(context.plan, state, t, duration)
            displacement, steps = context.plan.velocity_displacement(t, state.x, change, VELOCITY_ERROR_TIME)
            error += displacement
            context.evaluations += EVALUATIONS + 2 * steps
        if error <= self.rule.budget or context.exhausted or error <= self.rule.rounding_floor(self.choice.n_runs):
            return error
        refinement = self.choice.refinement * root(error / (CONSTANTS.error_target_fraction * self.rule.budget), 3)
        return None if self._choose_finer(self.choice.n_runs, refinement, is_smooth=False) else error

    def _choose_finer(self, n_runs: int, refinement: float, *, is_smooth: bool) -> bool:
        """Choose runs and refinement of the next attempt; return False if none fits the work limit.

        Args:
            n_runs: wanted number of runs.
            refinement: wanted refinement.
            is_smooth: True if combinations gained on one another, as in a smooth motion.
        """
        self._context.precision.n_misses += 1
        present_refinement = max(self.choice.refinement, self._stability.required_refinement(n_runs))
        next_refinement = min(refinement, CONSTANTS.max_refinement_factor * present_refinement)
        is_affordable = self._n_rejected < _MAX_FAILED_ATTEMPTS and self.fits_budget(n_runs, next_refinement)
        if not is_smooth and (not is_affordable or self._exceeds_order(refinement)) and self._can_halve():
            self._must_halve = True
            return True
        if is_affordable:
            self.choice = StepChoice(n_runs, next_refinement, True)
            return True
        self._context.exhausted = True
        return False

    def _exceeds_order(self, refinement: float) -> bool:
        """Return True if the last refinement reduced the error less than its order predicts."""
        is_repeated = self._n_halvings + self._n_rejected > 0
        return is_repeated and refinement > CONSTANTS.estimate_trust_factor * self.choice.refinement

    def _can_halve(self) -> bool:
        """Return True if the interval has enough steps for halving, and its halves fit the work limit."""
        is_long_enough = self.first_run_steps >= _MIN_HALVED_STEPS and self._n_halvings < _MAX_HALVINGS
        return is_long_enough and self.fits_budget(self.choice.n_runs, self.choice.refinement)

    def _append_estimate(self, errors: list[float], tableau: ExtrapolationTableau) -> None:
        """Append the error estimate of the next combination [m], and count its further run.

        If the motion is not smooth, an estimate may be small by chance. Then it counts as at least what the gain of the
        combination before it makes plausible.
        """
        evaluations_before, error = tableau.evaluations, tableau.difference(len(errors) + 1)
        self._context.evaluations += tableau.evaluations - evaluations_before
        if self._n_halvings and errors:
            gain = errors[-1] / errors[-2] if len(errors) > 1 and errors[-2] else _FIRST_GAIN
            error = max(error, errors[-1] * gain * gain)
        errors.append(error)

    def fits_budget(self, n_runs: int, refinement: float) -> bool:
        """Return True if a further attempt fits the remaining work of the frame."""
        return self._context.fits_budget(self._reserved + self.estimate_work(n_runs, refinement))

    def estimate_work(self, n_runs: int, refinement: float) -> float:
        """Return the work of an attempt with an error estimate, in force evaluations, engine calls included."""
        steps = steps_for(self._duration, self.max_step / max(refinement, self._stability.required_refinement(n_runs)))
        call_work = self._n_parts(n_runs, steps) * (n_runs + 1 + self._context.part_call_work)
        return steps * RATIO_SUMS[n_runs + 1] + call_work

    def _retry(self, factor: float, failure: str) -> bool:
        """Choose finer steps for a retry from the start, or abandon explicit steps; return False.

        Args:
            factor: factor on the refinement.
            failure: failure of the present steps, for the error message.

        Raises:
            UnstableError: if no choice is left.
        """
        context, choice, options = self._context, self.choice, self._context.options
        refinement = factor * choice.refinement
        exceeds_order = factor > 1.0 and self._exceeds_order(2.0 * refinement)
        if options.tolerance is not None and exceeds_order and self._can_halve():
            self._must_halve = True
            return False
        n_runs = context.reduce_runs(choice.n_runs, lambda n: self._reserved + self.estimate_work(n, refinement))
        has_failed = not options.work and self._n_rejected >= _MAX_FAILED_ATTEMPTS
        if has_failed and not (failure == _CREATES_ENERGY and context.has_fallback):
            raise UnstableError(
                f"{options.name}: steps of {self.min_step:.3g} s are {failure}, like {self._n_rejected} attempts with "
                "longer ones; check that all forces are finite and derive from their energies"
            )
        if not has_failed and self.fits_budget(n_runs, refinement):
            # The recorded error is valid for the same multirate ratio. Without a tolerance there is no error estimate.
            must_estimate = choice.estimates_error or n_runs < choice.n_runs or self.ratio != context.multirate.ratio
            self.choice = StepChoice(n_runs, refinement, must_estimate and options.tolerance is not None)
            if options.tolerance is None and factor > 1.0:
                self.rule.record_refinement(refinement)
            return False
        context.abandoned = context.has_fallback
        if not context.abandoned:
            raise UnstableError(
                f"{options.name}: steps of {self.min_step:.3g} s are {failure}, and finer ones exceed the frame's "
                f"work limit of {options.work:g} times real time; raise 'work_limit' or reduce the cloth's stiffness"
            )
        return False
