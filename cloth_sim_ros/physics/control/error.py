# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error rule: number of combined runs and refinement of their steps.

See Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.9. The error estimate of a combination T_K is
its distance from T_(K+1), which costs a further run. Between two estimates the error is predicted. An estimate that
confirms its prediction doubles the time until the next one. Otherwise one frame without an estimate follows.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import largest_component
from cloth_sim_ros.physics.arithmetic.deterministic_math import power, root
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.frame_totals import FrameTotals
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.extrapolation_tableau import (
    RATIO_SUMS,
    RATIOS,
    VELOCITY_ERROR_TIME,
    coefficient_of,
    rounding_amplification,
)
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import SECOND_DIFFERENCES_KEY, ErrorState
from cloth_sim_ros.physics.state.state import State

_EPSILON = sys.float_info.epsilon
#: Rounding error of a run, in units of epsilon times the largest coordinate. A combination amplifies it.
_COORDINATE_ROUNDINGS = 4.0
#: Largest rounding error of a velocity in a step, relative to the velocity.
_STEP_ROUNDING = 0.5 * _EPSILON
#: The predicted error of a single run grows with this power of the velocity change, as x''' may.
_ACTIVITY_EXPONENT = 3


class ErrorRule:
    """Rule that predicts errors between estimates, and chooses runs and refinement for an error budget.

    Args:
        memory: state of the rule.
        budget: error budget of the frame [m].
        max_runs: maximum number of combined runs.
        state: at the start.
        stability: requires a refinement of each number of runs.
        measure_displacement: gives the displacement [m] by velocity errors [m/s] at the start, shape (3, n).
    """

    def __init__(
        self,
        memory: ErrorState,
        budget: float,
        max_runs: int,
        state: State,
        stability: StabilityRule,
        measure_displacement: Callable[[Array], float],
    ) -> None:
        self.memory, self.budget, self.max_runs, self._stability = memory, budget, max_runs, stability
        self._measure_displacement = measure_displacement
        self._x, self._v = state.x, state.v
        #: Second differences of `RunDifferences` [m, m/s] in the last frame with an estimate, (2, n); None if unknown.
        self._known_differences = state.memory.get(SECOND_DIFFERENCES_KEY)

    @cached_property
    def _position_rounding(self) -> float:
        """Rounding error of a run's positions [m], calculated at first access."""
        return _COORDINATE_ROUNDINGS * _EPSILON * largest_component(self._x)

    @cached_property
    def _displacement_limit(self) -> float:
        """Upper limit of `_rounding_displacement` [m], without force evaluations."""
        return VELOCITY_ERROR_TIME * _STEP_ROUNDING * largest_component(self._v)

    @cached_property
    def _rounding_displacement(self) -> float:
        """Displacement that the rounding of all velocities in a step causes later [m], measured at first access."""
        return min(self._displacement_limit, self._measure_displacement(_STEP_ROUNDING * np.abs(self._v)))

    def rounding_floor(self, n_runs: int, steps: int, target: float) -> float:
        """Return the error estimate of n_runs combined runs of a piece that rounding alone causes [m].

        Each step rounds velocities. At a steady acceleration all steps round them alike, so that the errors add up.

        Args:
            n_runs: number of combined runs.
            steps: of the first run.
            target: aimed error [m]; an upper limit suffices if it is below.
        """
        amplification = rounding_amplification(n_runs + 1)
        limit = amplification * (self._position_rounding + steps * self._displacement_limit)
        if limit <= target:
            return limit
        return amplification * (self._position_rounding + steps * self._rounding_displacement)

    def is_predictable(self, counts: tuple[int, ...], length: float) -> bool:
        """Return True if the last estimate can predict the error of a piece with these step counts and length [s]."""
        memory = self.memory
        # A run of a few steps has an error that longer steps change in another way.
        has_order = counts[0] >= CONSTANTS.min_ordered_steps or length / counts[0] <= memory.step
        return memory.step > 0.0 and has_order and len(counts) == memory.n_runs

    def predict(
        self,
        counts: tuple[int, ...],
        length: float,
        change: tuple[float, float],
        activity: float,
        jerk_change: float = 0.0,
        grip_jerk_change: float = 0.0,
        second_differences: Callable[[], Array | None] | None = None,
    ) -> tuple[float, float]:
        """Return the predicted errors of a piece [m] by its runs, and by one run less; infinite if the motion changed.

        Args:
            counts: step counts of the combined runs.
            length: of the piece [s].
            change: of positions [m] and of velocities [m/s] by the last run of the combination; zeros for a single run.
            activity: activity of the piece [m/s].
            jerk_change: change of jerk of a single run whose springs turn [m/s].
            grip_jerk_change: change of jerk by grippers' paths [m/s].
            second_differences: see `_has_hidden_change`; None for a single run.
        """
        memory = self.memory
        step, fraction = length / counts[0], length / memory.duration
        if not self.is_predictable(counts, length):
            return math.inf, math.inf
        activity_ratio = max(1.0, activity / memory.activity) if memory.activity else math.inf
        trust_factor = CONSTANTS.estimate_trust_factor
        # The differences of several runs show most changes of a motion.
        if activity_ratio > (trust_factor if len(counts) == 1 else trust_factor * trust_factor * trust_factor):
            # The motion differs from the one with the last estimate, for example after an impact.
            return math.inf, math.inf
        if len(counts) == 1:
            is_changed = jerk_change > trust_factor * memory.jerk_change
            if is_changed and displacement_by_jerk(jerk_change, counts[0]) > self.target(length):
                return math.inf, math.inf
            scale = memory.safety_factor * step * step / memory.coefficient
            known_jerk_change = memory.grip_jerk_change * length * length
            by_grips = displacement_by_jerk(max(0.0, grip_jerk_change - known_jerk_change), counts[0])
            error = scale * memory.error * power(activity_ratio, _ACTIVITY_EXPONENT) * fraction
            # Activity without an error, as of free fall, must not hide another.
            least = displacement_by_activity(activity, counts[0], length)
            if least > max(trust_factor * error, self.target(length)):
                return math.inf, math.inf
            return error + by_grips, 0.0
        if self._is_other_path(grip_jerk_change, counts[0], length):
            return math.inf, math.inf
        lower_order_error = change[0] + memory.velocity_weight * change[1]
        known_error = memory.lower_order_error * fraction
        if not known_error:
            return math.inf, math.inf
        expected_fraction = fraction * coefficient_of(counts[:-1], length) / memory.lower_order_coefficient
        if second_differences and self._has_hidden_change(
            lower_order_error, second_differences, expected_fraction, length
        ):
            return math.inf, math.inf
        # The larger the change by the last run, the smaller the gain of the next one; at a force jump it is 0.
        growth = max(1.0, lower_order_error / (memory.lower_order_error * expected_fraction))
        if memory.velocity_change:
            # Fast waves of the last estimate displace little by their velocities, other ones may displace much.
            growth = max(growth, change[1] / (memory.velocity_change * expected_fraction))
        # The error may turn to waves that displace more, of which differences of runs show nothing.
        age = 1.0 + self._age / CONSTANTS.error_growth_time
        scale = memory.safety_factor * growth * growth * age * age * coefficient_of(counts, length) / memory.coefficient
        return scale * memory.error * fraction, lower_order_error

    @property
    def _age(self) -> float:
        """Time from the last error estimate to the end of the frame [s]."""
        memory = self.memory
        return memory.estimate_period - memory.time_until_estimate + memory.duration

    def _has_hidden_change(
        self,
        largest_change: float,
        second_differences: Callable[[], Array | None],
        expected_fraction: float,
        length: float,
    ) -> bool:
        """Return True if a particle's runs begin to differ as they did not in the last estimate, which matters.

        Runs of a slow particle differ much, and the next run changes little. It hides what another one begins, or
        itself. Its differences change little from piece to piece.

        Args:
            largest_change: largest change of a particle by the last run [m].
            second_differences: gives those of `RunDifferences`, (2, n), or None if they are unknown.
            expected_fraction: ratio of expected differences to those of the frame with the last estimate.
            length: of the piece [s].
        """
        target = self.target(length) / CONSTANTS.hidden_gain
        if largest_change <= target:
            return False
        differences, known = second_differences(), self._known_differences
        if differences is None:
            # The changes of the last pieces were too small to matter. So larger ones than expected are new.
            return largest_change > CONSTANTS.estimate_trust_factor * expected_fraction * self.memory.lower_order_error
        if known is not None:
            differences = differences - (CONSTANTS.estimate_trust_factor * expected_fraction) * known
        of_positions, of_velocities = differences
        displacements = of_positions + self.memory.velocity_weight * of_velocities
        return not float(np.maximum.reduce(displacements)) <= target

    def _is_other_path(self, grip_jerk_change: float, steps: int, length: float) -> bool:
        """Return True if grippers move so that the last estimate does not tell the error of combined runs.

        A path changes within a frame, faster than the waves of the estimate may. Extrapolation gains less on it.

        Args:
            grip_jerk_change: change of jerk by grippers' paths [m/s].
            steps: of the first run.
            length: of the piece [s].
        """
        known_jerk_change = self.memory.grip_jerk_change * length * length
        is_other = grip_jerk_change > CONSTANTS.estimate_trust_factor * known_jerk_change
        return is_other and displacement_by_jerk(grip_jerk_change, steps) > self.target(length)

    def target(self, length: float) -> float:
        """Return the error at which a piece of a length [s] aims [m]."""
        return CONSTANTS.error_target_fraction * self.budget * (length / self.memory.duration)

    def choose_runs(
        self,
        errors: Sequence[float],
        refinement: float,
        target: float,
        length: float,
        steps: int,
        *,
        rounding_fraction: float = 1.0,
        present_runs: int = 0,
    ) -> tuple[int, float]:
        """Return the number of runs and the refinement that meet a target error with the fewest force evaluations.

        Args:
            errors: of T_1, T_2, ... at the present refinement [m]; that of T_K decreases as h^(K + 1).
            refinement: present refinement.
            target: aimed error [m].
            length: of the errors' interval [s].
            steps: of the first run.
            rounding_fraction: rounding in these errors, relative to that of a run.
            present_runs: number of runs that needs no estimate in the next frame; 0 for none.
        """
        best = (1, refinement, math.inf)
        for n_runs, error in enumerate(errors[: self.max_runs], start=1):
            floor = rounding_fraction * self.rounding_floor(n_runs, steps, target / rounding_fraction)
            # Earlier pieces may have left no budget.
            scale = root(error / max(target, sys.float_info.min), n_runs + 1)
            if floor:
                # Rounding grows with the number of steps. Steps finer than the balance of both errors gain nothing.
                balance = root(error / floor, n_runs + 2)
                # An error within its budget shows that rounding is less than its upper limit.
                fits = error <= target / CONSTANTS.error_target_fraction
                scale = min(scale, max(1.0, balance) if fits else balance)
            required_refinement = max(self._stability.min_refinement(n_runs, length), refinement * scale)
            work = self._work(n_runs, required_refinement)
            if present_runs and n_runs != present_runs:
                work *= CONSTANTS.run_change_cost
            if work < best[2]:
                best = (n_runs, required_refinement, work)
        return best[0], best[1]

    def may_gain(self, further_runs: int, n_runs: int, refinement: float, length: float) -> bool:
        """Return True if further runs with the longest stable steps would need less work than a choice.

        Args:
            further_runs: their number.
            n_runs: number of runs of the choice.
            refinement: its refinement.
            length: of the interval [s].
        """
        least = self._work(further_runs, self._stability.min_refinement(further_runs, length))
        return CONSTANTS.run_change_cost * least < self._work(n_runs, refinement)

    def _work(self, n_runs: int, refinement: float) -> float:
        """Return the work of a frame in runs with the longest stable steps, with its mean share of an estimate."""
        estimated_fraction = min(1.0, self.memory.duration / CONSTANTS.max_estimate_period)
        return refinement * (RATIO_SUMS[n_runs] + RATIOS[n_runs] * estimated_fraction)

    def learn(self, frame: FrameTotals, n_runs: int, refinement: float, duration: float) -> None:
        """Record the error estimates of an accepted frame, and choose runs and refinement of the next.

        Args:
            frame: totals of its pieces; its `errors` may change.
            n_runs: number of combined runs.
            refinement: refinement of their steps, that of stability included.
            duration: of the frame [s].
        """
        is_raised = self._raise_accidental_error(frame, n_runs)
        # Absolute values of rounding errors add up over pieces. Finer steps, thus more pieces, do not reduce them.
        choice = frame.errors, refinement, self.target(duration), duration, frame.runs[0][0]
        next_runs, next_refinement = self.choose_runs(*choice, rounding_fraction=frame.n_pieces, present_runs=n_runs)
        # Steps grow by a factor of two at most, because a motion that reverses is slow for a moment.
        next_refinement = max(min(next_refinement, CONSTANTS.max_refinement_factor * refinement), 0.5 * refinement, 1.0)
        self.record_estimate(frame, n_runs, next_runs, next_refinement, is_raised=is_raised)

    def _raise_accidental_error(self, frame: FrameTotals, n_runs: int) -> bool:
        """Raise the error of a frame's single runs if it is small by chance; return true if it was raised.

        The phases of waves decide the error of a single run, so it may vary tenfold from frame to frame. At most it
        falls by half between two estimates, besides what shorter steps and a lower activity explain.

        Args:
            frame: totals of its pieces; its `errors` may change.
            n_runs: number of combined runs.
        """
        memory, (counts, length) = self.memory, frame.runs
        if not (n_runs == memory.n_runs == 1 and memory.coefficient and memory.activity):
            return False
        coefficient_ratio = coefficient_of(counts[:1], length) / memory.coefficient
        activity_ratio = min(1.0, frame.activity / memory.activity)
        least = 0.5 * memory.error * coefficient_ratio * power(activity_ratio, _ACTIVITY_EXPONENT)
        is_raised = frame.errors[0] < least
        if is_raised:
            frame.errors = [least, *frame.errors[1:]]
        return is_raised

    def record_estimate(
        self, frame: FrameTotals, n_runs: int, next_runs: int, next_refinement: float, *, is_raised: bool
    ) -> None:
        """Record an accepted frame's error estimates in `memory`, and set the time until the next estimate.

        Args:
            frame: totals of its pieces.
            n_runs: number of combined runs.
            next_runs: number of combined runs of the next frame.
            next_refinement: their refinement.
            is_raised: True if the error was small by chance and therefore raised.
        """
        memory, errors, error, (counts, length) = self.memory, frame.errors, frame.error, frame.runs
        target = self.target(length)
        prediction_ratio = error / frame.predicted_error if frame.predicted_error > 0.0 else math.inf
        is_predicted = math.isfinite(frame.predicted_error)
        is_far_below = error <= CONSTANTS.low_error_fraction * self.budget
        memory.n_runs, memory.refinement, memory.activity = float(next_runs), next_refinement, frame.activity
        memory.jerk_change, memory.grip_jerk_change = frame.jerk_change, frame.grip_jerk_change
        memory.force_change = 0.0
        # A path without effect must not hide another: a change of jerk is known as far as it is in the estimate.
        known_error = CONSTANTS.estimate_trust_factor * errors[max(next_runs - 2, 0)]
        known_jerk_change = known_error / (displacement_by_jerk(1.0, counts[0]) * length * memory.duration)
        memory.grip_jerk_change = min(memory.grip_jerk_change, known_jerk_change)
        self._known_differences, memory.velocity_change = None, 0.0
        memory.error = max(errors[next_runs - 1], self.rounding_floor(next_runs, counts[0], target))
        memory.coefficient, memory.step = coefficient_of(counts[:next_runs], length), length / counts[0]
        if next_runs > 1:
            floor = self.rounding_floor(next_runs - 1, counts[0], target)
            position_change, velocity_change = frame.changes[next_runs - 2]
            displaced = max(0.0, errors[next_runs - 2] - position_change)
            memory.velocity_weight = displaced / velocity_change if velocity_change else 0.0
            if next_runs == n_runs:
                self._known_differences, memory.velocity_change = frame.second_differences, velocity_change
            memory.lower_order_error = max(errors[next_runs - 2], floor)
            memory.lower_order_coefficient = coefficient_of(counts[: next_runs - 1], length)
        is_confirmed = is_predicted and prediction_ratio <= CONSTANTS.estimate_trust_factor
        # The error of another combination may be small by chance: it changes its sign at times.
        is_same = next_runs == n_runs
        # Longer steps may follow from an error that was small by chance.
        is_risky = is_raised and next_refinement > 1.0
        is_expected = is_far_below or is_confirmed or error <= self.rounding_floor(n_runs, counts[0], target)
        is_trusted = is_same and is_expected and not is_risky
        known_ratio = min(prediction_ratio, 1e3) if is_predicted else 1.0
        memory.safety_factor = 1.0 if is_far_below else max(1.0, 0.5 * memory.safety_factor, known_ratio)
        self.set_period(
            CONSTANTS.max_estimate_period * (4.0 if is_far_below and next_refinement == 1.0 else 1.0),
            2.0 * memory.estimate_period if is_trusted else 0.0,
        )
        # A vibration may begin at phases at which a single run errs little.
        is_unconfirmed = next_runs == 1 and not (is_predicted or is_far_below)
        if is_unconfirmed or not is_same:
            memory.time_until_estimate = 0.0

    def set_period(self, max_period: float, period: float) -> None:
        """Set estimate period and time until the next estimate [s] to a period, limited to one frame and a maximum."""
        memory = self.memory
        memory.estimate_period = memory.time_until_estimate = max(memory.duration, min(max_period, period))

    def restart(self, n_runs: int, refinement: float) -> None:
        """Forget the last estimate, so that the next frame estimates its error; keep runs and refinement."""
        self.memory = ErrorState(n_runs=float(n_runs), refinement=refinement, duration=self.memory.duration)
        self._known_differences = None

    def store(self, state: State) -> None:
        """Store the rule's numbers in a state's memory."""
        self.memory.store(state)
        if self._known_differences is None:
            state.memory.pop(SECOND_DIFFERENCES_KEY, None)
        else:
            state.memory[SECOND_DIFFERENCES_KEY] = self._known_differences

    def count_down(self) -> None:
        """Reduce the time until the next estimate by a frame, down to 0."""
        memory = self.memory
        time_left = memory.time_until_estimate - memory.duration
        memory.time_until_estimate = time_left if time_left > 1e-6 * memory.duration else 0.0


def displacement_by_velocities(plan: Plan, work: WorkBudget, t: float, x: Array, errors: Array) -> float:
    """Return the displacement [m] that errors of velocities [m/s] cause later, and count its work."""
    displacement, evaluations = plan.velocity_displacement(t, x, errors, VELOCITY_ERROR_TIME)
    work.add(evaluations)
    return displacement


def displacement_by_jerk(jerk_change: float, steps: int) -> float:
    """Return what the velocity error of a single run displaces later [m]: h^2/24 times the change of jerk.

    Args:
        jerk_change: change of jerk over the run, times T^2/8 [m/s].
        steps: number of its steps.
    """
    return VELOCITY_ERROR_TIME * jerk_change / (3.0 * steps * steps)


def displacement_by_activity(activity: float, steps: int, length: float) -> float:
    """Return the error [m] of a single run of an oscillator with this activity, if its period is longer than the run.

    Its amplitude a and angular frequency w give an activity of a w^3 T^2/4. Its phase errs by w^3 h^2 T/24. Faster ones
    err by more.

    Args:
        activity: of the run [m/s].
        steps: number of its steps.
        length: of the run [s].
    """
    return activity * length / (6.0 * steps * steps)
