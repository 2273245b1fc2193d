# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Controller of one advance: accepts and rejects pieces, chooses number of runs and refinement of steps.

The loop `explicit.integrate` asks in this order:

- `choose_piece` returns the next piece: its length H, the steps of its first run, the multirate ratio. It is stable by
  the bounds at its start and by predicted contact, and it fits the work budget.
- `tableau` returns the runs of a piece, each calculated when it is needed. `run` calculates the chosen ones.
- `is_stable` tells if the runs are finite, and their steps within the limits that they met. `reject_unstable` makes
  these shorter.
- `predict` returns the error from the last estimate; it is infinite if an estimate is due. `estimate` measures it.
  `reject_inaccurate` chooses more runs, shorter steps or a shorter piece.
- `check_energy` checks a piece whose error is not known to fit its budget. `reject_energy` makes steps shorter.
- `accept` moves the state to the end of the piece. A rejected piece does not move it.
- `store` writes into the state what the next advance needs.

docs/step_control.md has the rules.
"""

from __future__ import annotations

import math
from functools import cached_property, partial

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.arithmetic.deterministic_math import root
from cloth_sim_ros.physics.control.changes import ChangeRule
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.description import ExplicitSettings, describe, describe_miss
from cloth_sim_ros.physics.control.energy import EnergyRule
from cloth_sim_ros.physics.control.error import ErrorRule, displacement_by_velocities
from cloth_sim_ros.physics.control.error_estimate import ErrorEstimate
from cloth_sim_ros.physics.control.fallback import FALLBACK_EVALUATIONS, is_implicit_feasible
from cloth_sim_ros.physics.control.frame_division import FrameDivision
from cloth_sim_ros.physics.control.frame_totals import ErrorPrediction, FrameTotals, Piece
from cloth_sim_ros.physics.control.multirate import MultirateRule
from cloth_sim_ros.physics.control.precision import PrecisionRule
from cloth_sim_ros.physics.control.run_differences import RunDifferences
from cloth_sim_ros.physics.control.stability import MAX_UNDAMPED_STEPS, StabilityRule
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError, refuse_step, refuse_unbounded
from cloth_sim_ros.physics.integrators.extrapolation_tableau import (
    RATIO_SUMS,
    VELOCITY_ERROR_TIME,
    ExtrapolationTableau,
    step_counts,
)
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state import controller_state
from cloth_sim_ros.physics.state.controller_state import (
    ChangeState,
    EnergyState,
    ErrorState,
    FallbackState,
    StabilityState,
)
from cloth_sim_ros.physics.state.state import State

#: Minimum steps of a piece for halving; with fewer steps the runs of a half would not differ enough.
_MIN_HALVED_STEPS = 2 * MAX_UNDAMPED_STEPS
#: Attributes of the controller.
_ATTRIBUTES = (
    "_applied_refinement _attempts _before _changes _division _duration _error _estimate "
    "_fallback_count _frame _halved_step _has_tolerance _last_refinement _may_turn "
    "_met_limit _multirate _piece _plan _precision _prediction _ratio _rejected_attempt "
    "_run_differences _stability _start_bounds _start_hinge_bounds _start_v _state abandoned budget "
    "estimates_error exhausted in_fallback limit n_runs options refinement rejected work __dict__"
)


class Controller:
    """Controller of one explicit advance: chooses pieces, number of runs and steps, by rules and the work budget.

    A frame has stretches, a stretch has equal pieces, a piece has steps. The refinement is the factor by which steps
    are shorter than the longest stable ones. A motion is rough after a piece was halved, or needed much shorter steps.

    Args:
        options: settings of the integrator.
        plan: equations of motion.
        state: at the start.
        t: time at the start [s].
        duration: time to advance [s].

    Raises:
        StepLimitError: if a fixed step exceeds the limit at the start.
        UnstableError: if no step is short enough.
    """

    # A plain frame reads each attribute only a few times, and slots are faster then.
    __slots__ = _ATTRIBUTES.split()

    def __init__(self, options: ExplicitSettings, plan: Plan, state: State, t: float, duration: float) -> None:
        self.options, self._plan, self._state, self._duration = options, plan, state, duration
        self._has_tolerance = has_tolerance = options.tolerance is not None
        #: Rejected attempts.
        self.rejected = 0
        #: True while the reserve finishes the frame; if the work budget allows no finer steps.
        self.in_fallback = self.exhausted = False
        #: True if a spring may turn over within the present piece.
        self._may_turn = False
        has_previous_frame = StabilityState.key in state.memory
        memory, error = StabilityState.load(state), ErrorState.load(state)
        self._stability = StabilityRule(plan, memory, state.x)
        refuse_unbounded(memory.omega2, memory.damping)
        sheet_limit = self._stability.sheet_limit
        if abs(error.duration - duration) > 1e-6 * duration:
            # Recorded errors belong to frames of another length.
            error = ErrorState(n_runs=error.n_runs, refinement=error.refinement, duration=duration)
            precision_keys = controller_state.PrecisionState.key, controller_state.RoundingNoiseState.key
            for key in (*controller_state.PARTICLE_KEYS, *precision_keys):
                state.memory.pop(key, None)
        if has_tolerance and plan.gripper_count and error.n_runs == 1.0 and not self._stability.is_damped(duration):
            # Small paths without an estimate excite vibrations, whose errors add up.
            error.count_force_change(plan.grip_acceleration_change(t, duration), options.tolerance)
        is_due, self._last_refinement = error.time_until_estimate <= 0.0, 0.0
        if is_due and not has_tolerance:
            # Longer steps than the energy rule required are tried periodically.
            self._last_refinement, error.refinement = error.refinement, max(1.0, 0.5 * error.refinement)
        #: Error budget of the frame [m].
        tolerance = math.inf if options.tolerance is None else options.tolerance
        self.budget = CONSTANTS.error_budget_fraction * duration * tolerance
        #: Number of combined runs, refinement of their steps, and whether a further run estimates their error.
        self.n_runs = min(int(error.n_runs), options.n_runs) if has_tolerance else options.n_runs
        self.refinement, self.estimates_error = error.refinement, has_tolerance and is_due
        # A fixed step of a running simulation was stable at its start.
        proven_step = options.step if options.step is not None and has_previous_frame else 0.0
        memory.max_step = max(memory.max_step, min(max(sheet_limit, proven_step), duration))
        #: Step limit at the start [s].
        self.limit = sheet_limit if plan.contact is None else self._stability.predicted_limit(t, duration, state)
        contact_time = self._stability.contact_time
        may_touch = contact_time > 0.0
        if options.step is not None and not has_previous_frame:
            refuse_step(options.step, self.limit, options.name)
        self._ratio = 1
        if plan.has_hinges:
            # Waves of contact may have any frequency, without damping.
            allowed = has_tolerance and not may_touch and self._stability.is_damped(duration)
            self._multirate = MultirateRule(plan, controller_state.MultirateState.load(state), allowed=allowed)
            self._ratio = self._choose_ratio(min(CONSTANTS.stability_safety * sheet_limit, duration))
            self._start_hinge_bounds = self._multirate.bounds
        self._fallback_count = FallbackState.load(state).fallback_count if FallbackState.key in state.memory else 0.0
        limits = memory.max_step, self._fallback_count, contact_time, self.limit, self._ratio
        #: Work of explicit steps.
        self.work = WorkBudget(plan, options.work, duration, *limits)
        measure = partial(displacement_by_velocities, plan, self.work, t, state.x)
        self._error = ErrorRule(error, self.budget, options.n_runs, state, self._stability, measure)
        self._precision = PrecisionRule(plan, state, duration, self.budget)
        self._changes = ChangeRule(plan, ChangeState.load(state), self.work, may_touch=may_touch)
        # Even the longest stable steps may exceed the work limit of the frame.
        #: True if explicit steps are abandoned.
        self.abandoned = duration / sheet_limit > self.work.cap and self._has_fallback
        self._start_bounds, self._start_v = (memory.omega2, memory.damping), state.v
        self._run_differences = RunDifferences(state)
        self._division = FrameDivision(
            plan, state, t, duration, self._stability, self.work, has_tolerance=has_tolerance
        )
        self._begin()

    @cached_property
    def _energy(self) -> EnergyRule:
        """Energy rule, created at first access, because most frames do not need it."""
        return EnergyRule(self._plan, EnergyState.load(self._state), self._last_refinement)

    @property
    def _has_fallback(self) -> bool:
        """True if a fallback can finish the frame after explicit steps are abandoned."""
        return self.has_explicit_fallback or is_implicit_feasible(self._plan)

    @property
    def has_explicit_fallback(self) -> bool:
        """True if explicit steps in the reserved work are the fallback: with contact, tolerance, and not used yet."""
        return self._changes.may_touch and self._has_tolerance and not self.in_fallback

    def use_reserve(self) -> None:
        """Reset the controller, not the state, to a fallback: single runs of the longest steps, with reserved work."""
        self.in_fallback, self.exhausted, self.abandoned, self._may_turn = True, True, False, False
        self.n_runs, self.refinement = 1, 1.0
        self.work.grant_reserve()
        self.restart()

    def restart(self) -> None:
        """Return the controller, not the state, to the frame's start; all pieces then get an error estimate."""
        memory = self._stability.memory
        memory.omega2, memory.damping = self._start_bounds
        if self._plan.has_hinges:
            self._multirate.bounds = self._start_hinge_bounds
        self.estimates_error = True
        if self._changes.is_unexpected:
            self._changes.may_touch = True
            # Waves of contact may have any frequency, without damping.
            self._stop_multirate()
        self.__dict__.pop("_energy", None)
        self._begin()

    def _begin(self) -> None:
        """Reset totals, division and the present piece for the start of the frame; used work and choices stay."""
        #: Totals of the accepted pieces.
        self._frame = FrameTotals()
        self._run_differences.restart()
        max_step = CONSTANTS.stability_safety * self._stability.memory.max_step
        self.work.rest_rate = self.refinement / max_step * RATIO_SUMS[self.n_runs + 1]
        #: Velocities [m/s] at the start of the interval before, and its length [s].
        previous = self._state.memory.get(controller_state.PREVIOUS_VELOCITIES_KEY)
        self._before = None if previous is None else (previous, self._duration)
        self._division.restart(is_rough=self._may_turn)
        #: The present piece, the step limit that its runs met [s], the step to keep for its halves [s], and its
        #: rejected attempts.
        self._piece: Piece | None = None
        self._met_limit, self._halved_step, self._attempts = math.inf, 0.0, 0
        #: Used work, runs, refinement and piece of the last rejected attempt; None before the first.
        self._rejected_attempt: tuple[float, int, float, Piece] | None = None
        #: Refinement of estimated runs, that of stability included.
        self._applied_refinement = 1.0

    def must_restart(self, *, needs_estimate: bool) -> bool:
        """Return True if the frame must restart with error estimates.

        A piece needs an estimate and earlier ones were only predicted, so they may be wrong too. Or a spring may turn
        over in this piece, or it touches although contact was not expected.

        Args:
            needs_estimate: True if the predicted error of the piece is unknown or exceeds its budget.
        """
        is_predicted = self._frame.n_pieces > 0 and not self._frame.has_estimates
        return (
            (needs_estimate and is_predicted)
            or (self._may_turn and not self._division.is_rough)
            or self._changes.is_unexpected
        )

    # Pieces.

    def choose_piece(self, t: float) -> Piece | None:
        """Return the present piece, or choose the next from time t [s]; None if explicit steps are abandoned."""
        if self._piece is None and not self.abandoned:
            self._piece = self._divide(t)
            if self.estimates_error and not (self.work.evaluations or self.exhausted):
                self.work.add(self._precision.measure(t, self._state, self._piece.max_step, self.n_runs))
                self._precision.update_kinetic_energy(self._state)
        return None if self.abandoned else self._piece

    def _divide(self, t: float) -> Piece:
        """Divide the next stretch into equal pieces; return the first, with steps that are stable and affordable."""
        options, division = self.options, self._division
        while True:
            stretch = division.stretch = division.rest_of_stretch
            is_whole = stretch == self._duration
            limit = self.limit if is_whole else self._stability.predicted_limit(t, stretch, self._state)
            limit = min(self._met_limit, limit)
            max_step = min(CONSTANTS.stability_safety * limit, stretch)
            should_halve = self._has_tolerance and self._stability.should_halve(max_step, stretch)
            if not (should_halve and self._halve(stretch, is_rough=division.is_rough)):
                break
        if options.step is not None and options.step <= limit:
            max_step = options.step
        if self._halved_step:
            self.refinement, self._halved_step = max(1.0, max_step / self._halved_step), 0.0
        ratio, division.multirate_refinement = 1, 1.0
        if self._ratio > 1:
            ratio, division.multirate_refinement = self._multirate.ratio_within(max_step, stretch)
        self.work.set_weight(ratio, self._stability.contact_time)
        steps, n_pieces = division.count_steps(self.n_runs, self.refinement, stretch, max_step)
        fits = self.work.fits(self.work.work_of(self.n_runs, steps, n_pieces) + division.rest_work())
        if self._has_tolerance and not fits:
            self._fit_to_budget(max_step)
            steps, n_pieces = division.count_steps(self.n_runs, self.refinement, stretch, max_step)
        if self.estimates_error:
            self._record_refinement(stretch, max_step)
        steps = max(1, math.ceil(steps / n_pieces / ratio)) * ratio
        return Piece(stretch / n_pieces, steps, ratio, max_step, n_pieces)

    def _choose_ratio(self, max_step: float) -> int:
        """Set and return the multirate ratio of this advance; a changed ratio sets an error estimate due."""
        rule, recorded_ratio = self._multirate, self._multirate.memory.ratio
        if self.estimates_error:
            rule.choose_ratio(self._state.x, max_step, self._duration, self.n_runs)
        else:
            rule.keep_ratio(max_step, self._duration)
        self.estimates_error = self.estimates_error or (self._has_tolerance and rule.ratio != recorded_ratio)
        return rule.ratio

    def _choose(self, n_runs: int, refinement: float) -> None:
        """Choose runs and refinement of the next piece, for which the rest of the stretch is divided again."""
        self.n_runs, self.refinement, self._piece = n_runs, refinement, None

    def _stop_multirate(self) -> None:
        """Evaluate hinges in each step from the next division on, until the frame ends."""
        if self._ratio > 1:
            self._multirate.ratio = self._ratio = 1

    def _record_refinement(self, length: float, max_step: float) -> None:
        """Record the refinement of estimated runs over a length [s], relative to the longest stable step [s]."""
        required_refinement = self._division.required_refinement(self.n_runs, length, max_step)
        self._applied_refinement = max(self.refinement, required_refinement)

    def _halve(self, length: float, *, is_rough: bool = True) -> bool:
        """Halve the present or next piece, of a length [s], as rough motion or not; False if halves are too short."""
        division = self._division
        if not division.is_long_enough(0.5 * length):
            return False
        if self._piece is not None:
            division.isolate(self._piece)
        division.halve(length)
        division.is_rough, self.estimates_error = is_rough, self.estimates_error or is_rough
        self._piece, self._met_limit, self._attempts = None, math.inf, 0
        return True

    def _fit_to_budget(self, max_step: float) -> None:
        """Reduce `n_runs` and `refinement` to the work budget of the stretch; set `exhausted` or `abandoned`.

        Explicit steps are abandoned if the longest stable ones [s] exceed it by more than the cost of implicit steps
        that finish the frame.
        """
        self.estimates_error, allows_second = True, not (self._attempts or self._division.is_rough)
        choice = self._division.reduce_to_budget(self.n_runs, self.refinement, max_step, allows_second=allows_second)
        self.n_runs, self.refinement, work = choice
        self.exhausted = self.exhausted or not self.work.fits(work)
        fallback_work = FALLBACK_EVALUATIONS + CONSTANTS.implicit_finish_steps * self.work.call_work
        self.abandoned = not self.work.fits(work - fallback_work) and self._has_fallback

    def tableau(
        self, t: float, piece: Piece, previous: ExtrapolationTableau | None, accumulator: WorkAccumulator | None
    ) -> ExtrapolationTableau:
        """Return a tableau of runs of a piece from time t [s], or the previous attempt's if steps are equal."""
        # Where runs begin a step together, all miss a kink alike.
        is_coprime = self._division.is_rough or self._changes.may_touch or self._plan.has_kinks
        counts = step_counts(piece.steps, ratio=piece.ratio, coprime=is_coprime)
        single_precision = is_estimated = False
        if self._has_tolerance:
            is_estimated = self.estimates_error or not self._error.is_predictable(counts[: self.n_runs], piece.length)
            single_precision = not self._division.is_rough and self._precision.allows_single_precision(
                self._state, self.n_runs, estimates_error=self.estimates_error
            )
        if (
            previous is not None
            and (previous.counts, previous.duration, previous.ratio) == (counts, piece.length, piece.ratio)
            and single_precision >= previous.single_precision
        ):
            return previous
        self.work.used += self.work.call_work
        expected_runs = self._count_estimates(piece.steps) + 1 if is_estimated else self.n_runs
        if is_estimated and self._needs_more_runs(counts[: expected_runs + 1], piece.ratio):
            expected_runs += 1
        return ExtrapolationTableau(
            self._plan,
            self._state,
            t,
            piece.length,
            counts,
            record_power=accumulator is not None and accumulator.record_power,
            record_obstacles=accumulator is not None and accumulator.obstacle_count > 0,
            single_precision=single_precision,
            frame_time=self._duration,
            ratio=piece.ratio,
            expected_runs=expected_runs,
            before=self._before,
        )

    def _needs_more_runs(self, counts: tuple[int, ...], ratio: int) -> bool:
        """Return True if an error estimate probably needs a further run, which is then calculated in the same call."""
        if sum(counts) <= self._plan.evaluations_per_call:
            return self.refinement > 1.0
        is_repeated = self._attempts > 0 or self._division.is_rough
        return self.n_runs == 2 and is_repeated and self._plan.threads_per_run(ratio) == 1

    def run(self, tableau: ExtrapolationTableau) -> None:
        """Calculate the chosen runs of a tableau, and count their work."""
        evaluations = tableau.evaluations
        tableau.summary(self.n_runs)
        self.work.add(tableau.evaluations - evaluations, self.work.weight)

    # Rule 1: stability.

    def is_stable(self, tableau: ExtrapolationTableau, piece: Piece) -> bool:
        """Return True if the chosen runs are finite, with steps within the limit that they met."""
        n_runs = self.n_runs
        summary = tableau.summary(n_runs)
        if not summary.is_finite or piece.step > self._stability.encountered_limit(tableau, n_runs, summary):
            return False
        return piece.ratio == 1 or not self._multirate.exceeds_limit(piece.ratio * piece.step, summary)

    def reject_unstable(self, tableau: ExtrapolationTableau, piece: Piece) -> None:
        """Reject a piece that `is_stable` refuses: choose shorter steps, or abandon explicit steps.

        Raises:
            UnstableError: if no choice is left.
        """
        n_runs, factor, failure = self.n_runs, 1.0, "not within their stability limit"
        summary = tableau.summary(n_runs)
        limit = self._stability.encountered_limit(tableau, n_runs, summary)
        if not summary.is_finite:
            # Finer steps would not have got that far.
            factor, failure = 2.0 if piece.step <= limit else 1.0, "not finite"
        elif piece.ratio > 1 and self._multirate.exceeds_limit(piece.ratio * piece.step, summary):
            self._stop_multirate()
        # If a run ended on a surface, the limit is zero.
        self._met_limit = min(self._met_limit, limit or 0.5 * piece.step)
        self._retry(factor, failure, piece)

    # Rule 2: error.

    def allowed_error(self, piece: Piece) -> float:
        """Return the error budget of a piece [m]: the frame's budget until its end, less the error of earlier pieces.

        After a piece that missed its budget it is at least the piece's share of the frame's budget.
        """
        allowed = self.budget * (self._division.end_of(piece) / self._duration) - self._frame.error
        if self._frame.has_missed:
            allowed = max(allowed, self.budget * (piece.length / self._duration))
        return allowed

    def predict(self, tableau: ExtrapolationTableau, piece: Piece) -> float:
        """Return a piece's error [m], predicted from the last estimate; infinite if unknown or an estimate is due."""
        if not self._has_tolerance:
            self._prediction = ErrorPrediction()
            return 0.0
        n_runs = self.n_runs
        summary = tableau.summary(n_runs)
        self._may_turn = summary.turn > CONSTANTS.max_turn and not self.in_fallback
        rates = self._stability.memory.omega2, self._stability.memory.damping
        path = (tableau.t, piece.length, rates, VELOCITY_ERROR_TIME)
        grip_jerk_change = self._plan.grip_jerk_change(*path) if self._plan.gripper_count > 0 else 0.0
        error, lower_order_error = self._error.predict(
            tableau.counts[:n_runs],
            piece.length,
            tableau.change(n_runs - 1) if n_runs > 1 else (0.0, 0.0),
            max(summary.activity, summary.change_from_before),
            tableau.jerk_change if summary.turn > CONSTANTS.smooth_turn else 0.0,
            grip_jerk_change,
            partial(self._run_differences.second_differences, tableau, n_runs) if n_runs > 1 else None,
        )
        is_changed, contents = False, None
        if self._plan.contact is not None or self._plan.has_kinks or piece.ratio > 1:
            target = self._error.target(piece.length)
            is_changed, contents = self._changes.compare(tableau, piece, n_runs, target, energy_alone=self.in_fallback)
        may_yield = self._plan.plastic is not None and not (self.estimates_error or self.in_fallback)
        if is_changed or (may_yield and tableau.kink_displacement(n_runs) > self._error.target(piece.length)):
            error = math.inf
        if n_runs > 1 and summary.turn > 0.5 * CONSTANTS.max_turn and not self.in_fallback:
            # Hinges and springs that turn fast may pulse where all runs sample them.
            error = math.inf
        self._prediction = ErrorPrediction(error, lower_order_error, summary.activity, grip_jerk_change, contents)
        return math.inf if self.estimates_error else error

    def estimate(self, tableau: ExtrapolationTableau, piece: Piece, allowed: float) -> float:
        """Return the error of a piece [m] by further runs, whose work counts; set `n_runs` to one that suffices.

        If the error is above its target, further runs show whether more runs or finer steps are better.

        Args:
            tableau: runs of the piece.
            piece: the piece.
            allowed: its error budget [m].

        Returns:
            The error; infinite if single precision does not resolve that of further runs, which may suffice.
        """
        changes, division, n_confirming, is_touch = self._changes, self._division, 0, False
        if not (division.is_rough or self.in_fallback):
            if self.n_runs == 1:
                n_confirming = self._stability.count_confirming_runs(piece.steps, piece.length)
            # New contact may begin and end within the piece, so that no later estimate contains it.
            is_touch = changes.has_new_contact
        estimate = self._estimate = ErrorEstimate(
            tableau,
            piece,
            rule=self._error,
            work=self.work,
            chosen_runs=self.n_runs,
            allowed=allowed,
            rounding_fraction=piece.length / division.stretch,
            is_rough=division.is_rough,
            jumps=changes.may_jump,
            may_coincide=n_confirming > 0 or is_touch,
        )
        if not self.estimates_error:
            self.estimates_error = True
            self._record_refinement(piece.length, piece.max_step)
        estimate.begin(max(self._count_estimates(piece.steps), 1 + n_confirming))
        if (estimate.errors[-1] > allowed and not self.in_fallback) or self.refinement > 1.0:
            is_resolved = estimate.extend(self._applied_refinement, division.rest_work(piece), self._precision)
            if not is_resolved:
                estimate.needs_double = division.fits(self.n_runs, self._refinement_in_double(piece), piece)
        estimate.confirm()
        if not self.in_fallback:
            self.n_runs = estimate.sufficient_runs(is_touch=is_touch)
        if division.is_rough or changes.may_jump or changes.may_kink:
            estimate.add_end_error(self._plan, self._state, self.n_runs)
        estimate.end_error += changes.kink_error
        return math.inf if estimate.needs_double else estimate.error(self.n_runs)

    def _count_estimates(self, steps: int) -> int:
        """Return the number of combinations whose error is estimated, so that the chosen one is reliable.

        The error of a single run does not follow its order in a few steps, or where friction may jump. So its estimate
        may be small by chance. A second one confirms it.

        Args:
            steps: of the first run.
        """
        is_ordered = steps >= CONSTANTS.min_ordered_steps and not self._changes.may_jump
        is_confirmed = self.n_runs == 1 and not is_ordered and not self.in_fallback
        return min(self.n_runs + is_confirmed, self.options.n_runs)

    def reject_inaccurate(self, piece: Piece) -> bool:
        """Reject an estimated piece: choose more runs, finer steps or halves; False if it must be accepted."""
        estimate, division = self._estimate, self._division
        if estimate.needs_double:
            self._repeat_in_double(piece)
            return True
        error, floor = estimate.error(self.n_runs), estimate.rounding_floor(self.n_runs)
        if self.in_fallback or error <= CONSTANTS.estimate_trust_factor * floor:
            return False  # no step reduces the error below rounding
        n_runs, refinement, may_help = self._choose_finer(estimate, error)
        self._precision.n_misses += 1
        required_refinement = division.required_refinement(n_runs, piece.length, piece.max_step)
        max_refinement = CONSTANTS.max_refinement_factor * max(self.refinement, required_refinement)
        next_refinement = min(refinement, max_refinement)
        is_affordable = (
            self._attempts < CONSTANTS.max_failed_attempts
            and division.is_long_enough(piece.length)
            and division.fits(n_runs, next_refinement, piece)
        )
        requires_much_more = not may_help and self._requires_much_more(refinement)
        # Halves cost less than much finer steps in all of a piece.
        is_much_finer = self._attempts > 0 and refinement > max_refinement
        if is_much_finer or (not may_help and (not is_affordable or requires_much_more)):
            if self._halve_if_long(piece):
                self.rejected += 1
                return True
            division.is_rough = division.is_rough or requires_much_more
        if not is_affordable:
            if not math.isfinite(estimate.errors[0]):
                self._retry(2.0, "not finite", piece)
                return True
            self.exhausted = True
            return False
        if division.is_rough:
            # Only this piece needs finer steps.
            division.isolate(piece)
        self._choose(n_runs, next_refinement)
        self._attempts, self.rejected = self._attempts + 1, self.rejected + 1
        return True

    def _choose_finer(self, estimate: ErrorEstimate, error: float) -> tuple[int, float, bool]:
        """Return runs and refinement that bring an error [m] to its target; true unless further runs do not help."""
        errors = estimate.errors
        if errors[self.n_runs - 1] <= estimate.allowed:
            # Only the ends of the piece exceed its budget.
            return self.n_runs, self.refinement * root(error / estimate.target, 3), False
        n_runs, refinement = estimate.choose_runs(self._applied_refinement, estimate.target)
        if self._division.is_rough:
            # Errors may be small by chance, so steps do not grow.
            refinement = max(refinement, self.refinement)
        # A single estimate does not show whether further runs help.
        return n_runs, refinement, len(errors) == 1 or CONSTANTS.estimate_trust_factor * min(errors) < errors[0]

    def _repeat_in_double(self, piece: Piece) -> None:
        """Reject a piece in single precision: repeat it in double, with the longest steps that further runs allow."""
        refinement = self._refinement_in_double(piece)
        if refinement < self.refinement:
            self._choose(self.n_runs, refinement)
            # The error of impulses would cost further runs.
            self._stop_multirate()
        self._precision.require_double()
        self._attempts, self.rejected = self._attempts + 1, self.rejected + 1

    def _refinement_in_double(self, piece: Piece) -> float:
        """Return the refinement with which a piece in single precision is repeated in double, with further runs.

        Steps that were refined for fewer runs make their combination more accurate than needed. The longest stable
        steps usually suffice; if they do not, one run more costs less than shorter steps of all runs.
        """
        return min(self.refinement, self._stability.min_refinement(len(self._estimate.errors) + 1, piece.length))

    def _requires_much_more(self, refinement: float) -> bool:
        """Return True if a refinement is far above the present one, after a rejected attempt or in rough motion."""
        is_repeated = self._division.is_rough or self._attempts > 0
        return is_repeated and refinement > CONSTANTS.estimate_trust_factor * self.refinement

    def _halve_if_long(self, piece: Piece) -> bool:
        """Halve a piece, if it has enough steps and its halves fit the work budget; return true if it was halved.

        Kinks of friction of bending do not halve: many hinges yield in each frame, and steps are of order 2 there.
        Contact jumps, so that pieces of a model with contact are halved nevertheless.
        """
        if self._plan.plastic is not None and self._plan.contact is None:
            return False
        fits = piece.steps >= _MIN_HALVED_STEPS and self._division.fits(self.n_runs, self.refinement, piece)
        if not (fits and self._halve(piece.length)):
            return False
        self._halved_step = piece.max_step / self.refinement
        return True

    # Rule 3: energy.

    def check_energy(self, tableau: ExtrapolationTableau) -> bool:
        """Return False if a piece of unknown or excessive error creates energy; otherwise record its energy drift."""
        n_runs, has_contact = self.n_runs, self._stability.has_contact(tableau, self.n_runs)
        omega2 = self._stability.memory.omega2, math.inf if has_contact else tableau.summary(n_runs).omega2
        choice = tableau, self._state, n_runs, omega2, self.refinement
        is_allowed, evaluations = self._energy.check(*choice, steps_differ=n_runs > 1 or self._division.is_rough)
        self.work.add(evaluations, self.work.weight)
        return is_allowed

    def reject_energy(self, piece: Piece) -> None:
        """Reject a piece that created energy: choose finer steps, or abandon explicit steps.

        Raises:
            UnstableError: if no choice is left.
        """
        # The drive of a gripper's jaws may be its source; implicit steps finish then.
        self._retry(2.0, "making energy from nowhere", piece, may_abandon=True)

    def _retry(self, factor: float, failure: str, piece: Piece, *, may_abandon: bool = False) -> None:
        """Prepare a further attempt of a rejected piece: finer steps, halves, fewer runs, or abandon explicit steps.

        Args:
            factor: factor on the refinement.
            failure: failure of the present steps, for the error message.
            piece: the rejected piece.
            may_abandon: True if implicit steps may finish the frame even without a work limit.

        Raises:
            UnstableError: if no choice is left.
        """
        options, has_failed = self.options, not self.options.work and self._attempts >= CONSTANTS.max_failed_attempts
        self.rejected += 1
        refinement = factor * self.refinement
        requires_much_more = self._has_tolerance and factor > 1.0 and self._requires_much_more(2.0 * refinement)
        if requires_much_more and self._halve_if_long(piece):
            return
        # With contact, fewer runs are cheaper and more accurate than implicit steps.
        n_runs = self.n_runs
        while self._changes.may_touch and n_runs > 1 and not self._division.fits(n_runs, refinement, piece):
            n_runs -= 1
        # The work limit may shorten a finer attempt to the rejected one, whose runs are known.
        attempt = self.work.used, self.n_runs, self.refinement, piece
        is_repeated, self._rejected_attempt = attempt == self._rejected_attempt, attempt
        if not has_failed and not is_repeated and self._division.fits(n_runs, refinement, piece):
            if self._has_tolerance:
                # The recorded error is valid for the same runs and multirate ratio.
                self.estimates_error = self.estimates_error or n_runs < self.n_runs or piece.ratio != self._ratio
            elif factor > 1.0:
                self._error.memory.refinement = refinement
                self._error.set_period(CONSTANTS.max_estimate_period, 2.0 * self._error.memory.estimate_period)
            self._choose(n_runs, refinement)
            self._attempts += 1
            return
        self.abandoned = self._has_fallback and (may_abandon or not has_failed)
        if not self.abandoned:
            consequence = (
                f"like {self._attempts} attempts with longer ones; check that all forces are finite and derive from "
                "their energies"
                if has_failed
                else f"and finer ones exceed the frame's work limit of {options.work:g} times real time; raise "
                "'work_limit' or reduce the cloth's stiffness"
            )
            raise UnstableError(f"{options.name}: steps of {piece.step:.3g} s are {failure}, {consequence}")

    # Acceptance.

    def accept(
        self,
        tableau: ExtrapolationTableau,
        piece: Piece,
        error: float,
        allowed: float,
        accumulator: WorkAccumulator | None,
    ) -> float:
        """Move the state to the end of a piece, update bounds, totals, rules; return the time in the frame [s].

        Args:
            tableau: runs of the piece.
            piece: the piece.
            error: error of the piece [m].
            allowed: its error budget [m].
            accumulator: work accumulator; None for none.

        Returns:
            Time since the start of the frame [s].
        """
        n_runs, state, memory, frame = self.n_runs, self._state, self._stability.memory, self._frame
        summary, length = tableau.summary(n_runs), piece.length
        if accumulator is not None:
            tableau.accumulate(n_runs, accumulator)
        memory.omega2, memory.damping = summary.omega2, summary.damping
        if piece.ratio > 1:
            self._multirate.bounds = summary.hinge_bounds
        if self.estimates_error and (contents := self._prediction.contents) is not None:
            self._changes.limit_known(contents, self._estimate.errors[n_runs - 1], self._error.target(length))
        frame.add(tableau, piece, n_runs, self._prediction, error)
        frame.has_missed = frame.has_missed or error > allowed
        frame.refined_time += length if self.refinement > 1.0 else 0.0
        differences = self._run_differences.accept(tableau, n_runs)
        if self.estimates_error:
            frame.add_estimate(tableau, self._prediction, self._estimate.errors, self.refinement, differences)
        self._before = state.v, length
        tableau.commit(n_runs, state)
        if self._has_tolerance:
            # Without a tolerance steps do not grow again, so attempts count over the frame.
            self._attempts = 0
        division, self._met_limit = self._division, math.inf
        division.accept(piece)
        self._piece = piece._replace(pieces_left=piece.pieces_left - 1) if piece.pieces_left > 1 else None
        if division.is_rough:
            self._choose_next(piece)
        return division.elapsed

    def _choose_next(self, piece: Piece) -> None:
        """Choose runs and refinement for what follows a piece of rough motion; steps grow at most by a factor of 2.

        A longer next stretch takes them, because the moment that needs short steps has then passed. The next frame
        starts with the longest steps so chosen; what is too coarse is rejected at little cost.
        """
        target = self._error.target(piece.length)
        n_runs, refinement = self._estimate.choose_runs(self.refinement, target)
        refinement = max(1.0, 0.5 * self.refinement, refinement)
        if piece.max_step / refinement > self._frame.longest_step:
            self._frame.longest_step, self._frame.longest_runs = piece.max_step / refinement, n_runs
        if piece.pieces_left > 1:
            # The moment that needs short steps may have passed: then the rest of the stretch is divided again.
            if 2.0 * refinement <= self.refinement and self._estimate.error(self.n_runs) <= target:
                self._choose(n_runs, refinement)
        elif self._division.rest_of_stretch > 1.5 * self._division.stretch:
            self.n_runs, self.refinement = n_runs, min(refinement, self.refinement)

    def store(self) -> None:
        """Store the rules' numbers, with runs and steps of the next advance, in the state's memory."""
        state, error, frame = self._state, self._error, self._frame
        if self._division.is_rough:
            max_step = min(CONSTANTS.stability_safety * self.limit, self._duration)
            error.restart(frame.longest_runs, max(1.0, max_step / frame.longest_step))
        elif frame.has_estimates and frame.is_uniform:
            error.learn(frame, self.n_runs, self._applied_refinement, self._duration)
        elif frame.has_estimates:
            error.restart(self.n_runs, self.refinement)
        elif self._has_tolerance and self.n_runs > 1 and frame.lower_order_error <= error.target(self._duration):
            error.memory.time_until_estimate = 0.0  # one run less may suffice
        else:
            error.count_down()
        if self._has_tolerance:
            state.memory[controller_state.PREVIOUS_VELOCITIES_KEY] = self._start_v
        self._stability.memory.store(state)
        error.store(state)
        self._run_differences.store(state, is_known=error.memory.n_runs == self.n_runs and not self._division.is_rough)
        if self.estimates_error or not self._has_tolerance:
            self._energy.memory.store(state)
            self._precision.store(state)
        if self._plan.has_hinges:
            self._multirate.memory.ratio = float(self._multirate.ratio)
            self._multirate.memory.store(state)
        if self._plan.contact is not None or frame.max_ratio > 1:
            contents = frame.contents if self.estimates_error else None
            (contents or self._changes.known).store(state)
        if self._fallback_count or self.in_fallback:
            FallbackState(min(64.0, self._fallback_count + 1.0) if self.in_fallback else 0.0).store(state)

    def store_bounds(self) -> None:
        """Store only the spectral bounds in the state's memory; their key must stay, see `reset_step_control`."""
        self._stability.memory.store(self._state)

    # Report.

    def report(self) -> Advance:
        """Return the report of the advance: steps, evaluations, error, limiting factor, and reason in words."""
        options, frame, step = self.options, self._frame, self._frame.min_step
        has_long_limit = self._duration <= CONSTANTS.stability_safety * self.limit
        equal_step = 0.0
        if options.step is not None:
            # Pieces round their numbers of steps up.
            equal_step = self._duration / (steps_for(self._duration, options.step) + frame.n_pieces - 1)
        flagged = int(self._has_tolerance and frame.error > self.budget)
        limit, reason = describe(
            options.name,
            options.tolerance,
            options.step,
            self.n_runs,
            step,
            frame.max_ratio,
            equal_step=equal_step,
            has_fewest_steps=has_long_limit and step >= self._duration / self._division.min_steps(self.n_runs),
            is_refined=frame.refined_time > 0.5 * self._duration,
            single_precision=frame.single_precision,
            n_pieces=frame.n_pieces if self._division.is_rough else 1,
        )
        if flagged:
            reason += f"; {describe_miss(options.work, is_exhausted=self.exhausted)}"
        limited_by = "work" if self.exhausted else limit
        error = frame.error if self._has_tolerance else None
        evaluations, name = self.work.evaluations, options.name
        return Advance(
            frame.steps, evaluations, step, self.limit, self.rejected, name, limited_by, error, flagged, reason
        )
