# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error rule: number of combined runs and refinement of their steps.

See Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.9. The error estimate of a combination T_K is
its distance from T_(K+1), which costs a further run. Between two estimates the error is predicted. If an estimate does
not confirm the prediction, the next part is estimated too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import attrs
import numpy as np

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum, power, root
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS, RATIOS, amplification, error_coefficient
from cloth_sim_ros.physics.state.controller_state import ErrorState
from cloth_sim_ros.physics.state.state import State

#: Rounding error of a run, in units of epsilon times the largest coordinate. A combination amplifies it.
_COORDINATE_ROUNDINGS = 4.0
#: The predicted error of a single run grows with this power of the velocity change, as x''' may.
_ACTIVITY_EXPONENT = 3


@attrs.define
class ErrorSums:
    """Sums of errors over the parts of a frame."""

    #: Errors of T_1, T_2, ... [m], as many as all parts have in common.
    errors: list[float] = attrs.field(factory=list)
    #: Changes of positions [m] and of velocities [m/s] from T_1 to T_2, from T_2 to T_3, ...
    changes: list[tuple[float, float]] = attrs.field(factory=list)
    #: Estimated error of the chosen combination, and its prediction [m].
    error: float = 0.0
    predicted: float = 0.0
    #: Predicted error of the combination of one run less, in frames without an estimate [m].
    lower_order_error: float = 0.0
    #: Largest activity of a part [m/s].
    activity: float = 0.0
    #: Number of parts.
    n_parts: int = 0

    def add_estimate(
        self,
        errors: Sequence[float],
        changes: Sequence[tuple[float, float]],
        n_runs: int,
        predicted: float,
        activity: float,
    ) -> None:
        """Add the estimates of a part.

        Args:
            errors: of T_1, T_2, ... [m].
            changes: of positions [m] and of velocities [m/s] from T_1 to T_2, from T_2 to T_3, ...
            n_runs: number of combined runs.
            predicted: predicted error [m].
            activity: activity of the part [m/s].
        """
        self.error += errors[n_runs - 1]
        if self.n_parts:
            errors = [ordered_sum(pair) for pair in zip(self.errors, errors, strict=False)]
            changes = [(x + dx, v + dv) for (x, v), (dx, dv) in zip(self.changes, changes, strict=False)]
        self.errors, self.changes = list(errors), list(changes)
        self.n_parts += 1
        self.predicted += predicted
        self.activity = max(self.activity, activity)


class ErrorRule:
    """Number of runs and refinement for an interval.

    Args:
        memory: state of the rule.
        stability: rule that bounds step sizes.
        budget: error budget of the interval [m].
        max_runs: maximum number of combined runs.
        state: at the start.
    """

    def __init__(
        self, memory: ErrorState, stability: StabilityRule, budget: float, max_runs: int, state: State
    ) -> None:
        self.memory, self.stability, self.budget, self._max_runs = memory, stability, budget, max_runs
        self._x = state.x

    def for_interval(self, memory: ErrorState, budget: float, state: State, stability: StabilityRule) -> ErrorRule:
        """Return the rule for a shorter interval."""
        return ErrorRule(memory, stability, budget, self._max_runs, state)

    @cached_property
    def _rounding(self) -> float:
        """Rounding error of a run [m]; frames without an estimate do not need it."""
        coordinate = max(float(self._x.max()), -float(self._x.min()))
        return _COORDINATE_ROUNDINGS * float(np.finfo(np.float64).eps) * coordinate

    def rounding_floor(self, n_runs: int) -> float:
        """Return the distance of T_(K+1) from T_K that rounding alone causes [m], K = n_runs."""
        return self._rounding * amplification(n_runs + 1)

    def predict(
        self, counts: tuple[int, ...], length: float, change: tuple[float, float], activity: float
    ) -> tuple[float, float]:
        """Return the predicted errors of a part, and of the combination of one run less [m].

        Args:
            counts: step counts of the combined runs.
            length: of the part [s].
            change: of positions [m] and of velocities [m/s] by the last run of the combination; zeros for a single run.
            activity: activity of the part [m/s].
        """
        memory = self.memory
        step = length / counts[0]
        if len(counts) != memory.n_runs or not has_known_order(memory, counts[0], step):
            return float("inf"), float("inf")
        if len(counts) == 1:
            return predict_single_run_error(memory, activity, counts[0], step) * (length / memory.duration), 0.0
        fraction = length / memory.duration
        lower_order_error = change[0] + memory.velocity_weight * change[1]
        known_error = memory.lower_order_error * fraction
        if not known_error:
            return float("inf"), float("inf")
        # The larger the change by the last run, the smaller the gain of the next one; at a force jump it is 0.
        ratio = lower_order_error / known_error
        growth = max(1.0, ratio * memory.lower_order_coefficient / coefficient_of(counts[:-1], length))
        scale = memory.safety_factor * growth * growth * coefficient_of(counts, length) / memory.coefficient
        return scale * memory.error * fraction, lower_order_error

    def choose(self, errors: Sequence[float], refinement: float) -> tuple[int, float]:
        """Return the runs and the refinement that meet the budget with the fewest force evaluations.

        Args:
            errors: of T_1, T_2, ... at the present refinement [m]; that of T_K decreases as h^(K + 1).
            refinement: present refinement.
        """
        best, target = (1, refinement, float("inf")), CONSTANTS.error_target_fraction * self.budget
        estimated_fraction = min(1.0, self.memory.duration / CONSTANTS.max_estimate_period)
        for n_runs, error in enumerate(errors[: self._max_runs], start=1):
            floor = self.rounding_floor(n_runs)
            # No step reduces the error below rounding.
            scale = root(max(error, floor) / max(target, floor), n_runs + 1)
            required_refinement = max(self.stability.min_refinement(n_runs), refinement * scale)
            work = required_refinement * (RATIO_SUMS[n_runs] + RATIOS[n_runs] * estimated_fraction)
            if work < best[2]:
                best = (n_runs, required_refinement, work)
        return best[0], best[1]

    def record_estimate(
        self, n_runs: int, refinement: float, sums: ErrorSums, counts: tuple[int, ...], length: float
    ) -> None:
        """Record the estimates of an accepted frame, and choose runs and refinement of the next one.

        Args:
            n_runs: number of combined runs.
            refinement: their refinement.
            sums: errors of its parts.
            counts: step counts of the runs of each part.
            length: length of a part [s].
        """
        memory, errors, error = self.memory, sums.errors, sums.error
        prediction_ratio = error / sums.predicted if sums.predicted > 0.0 else float("inf")
        is_predicted = math.isfinite(sums.predicted)
        next_runs, next_refinement = self.choose(errors, refinement)
        # Steps grow by a factor of two at most, because a motion that reverses is slow for a moment.
        next_refinement = max(min(next_refinement, CONSTANTS.max_refinement_factor * refinement), 0.5 * refinement, 1.0)
        is_far_below = error <= CONSTANTS.low_error_fraction * self.budget
        memory.n_runs, memory.refinement, memory.activity = float(next_runs), next_refinement, sums.activity
        memory.error = max(errors[next_runs - 1], self.rounding_floor(next_runs))
        memory.coefficient, memory.step = coefficient_of(counts[:next_runs], length), length / counts[0]
        if next_runs > 1:
            floor = self.rounding_floor(next_runs - 1)
            position_change, velocity_change = sums.changes[next_runs - 2]
            displaced = max(0.0, errors[next_runs - 2] - position_change)
            memory.velocity_weight = displaced / velocity_change if velocity_change else 0.0
            memory.lower_order_error = max(errors[next_runs - 2], floor)
            memory.lower_order_coefficient = coefficient_of(counts[: next_runs - 1], length)
        is_confirmed = is_predicted and prediction_ratio <= CONSTANTS.estimate_trust_factor
        # The error of another combination may be small by chance: it changes its sign at times.
        is_same = next_runs == n_runs
        is_trusted = is_same and (is_far_below or is_confirmed or error <= self.rounding_floor(n_runs))
        known_ratio = min(prediction_ratio, 1e3) if is_predicted else 1.0
        memory.safety_factor = 1.0 if is_far_below else max(1.0, 0.5 * memory.safety_factor, known_ratio)
        max_period = CONSTANTS.max_estimate_period * (4.0 if is_far_below and next_refinement == 1.0 else 1.0)
        period = min(max_period, 2.0 * memory.estimate_period) if is_trusted else 0.0
        memory.estimate_period = memory.time_until_estimate = max(memory.duration, period)

    def record_halving(self, n_runs: int, refinement: float) -> None:
        """Record a frame that was divided into intervals; the next one starts with an estimate at their mean step."""
        self.memory = ErrorState(n_runs=float(n_runs), refinement=refinement, duration=self.memory.duration)

    def record_prediction(self, n_runs: int, sums: ErrorSums) -> None:
        """Record a frame without an estimate; the next one gets an estimate if one run less may suffice."""
        memory = self.memory
        fewer_suffice = n_runs > 1 and sums.lower_order_error <= CONSTANTS.error_target_fraction * self.budget
        if fewer_suffice:
            memory.time_until_estimate = 0.0
        else:
            count_down(memory)

    def record_refinement(self, refinement: float) -> None:
        """Record a refinement that the energy rule required for a fixed step."""
        memory = self.memory
        memory.refinement = refinement
        period = min(CONSTANTS.max_estimate_period, 2.0 * memory.estimate_period)
        memory.estimate_period = memory.time_until_estimate = max(memory.duration, period)


def coefficient_of(counts: tuple[int, ...], length: float) -> float:
    """Return the error coefficient of runs over a length [s], see `error_coefficient`."""
    return error_coefficient(counts) * power(length, len(counts) + 1)


def has_known_order(memory: ErrorState, steps: int, step: float) -> bool:
    """Return True if the error of runs follows from the last estimate by their order.

    A run of a few steps has an error that longer steps change in another way.

    Args:
        memory: state of the error rule.
        steps: step count of the first run.
        step: its step size [s].
    """
    return memory.step > 0.0 and (steps >= CONSTANTS.min_ordered_steps or step <= memory.step)


def predict_single_run_error(memory: ErrorState, activity: float, steps: int, step: float) -> float:
    """Return the predicted error of a frame by a single run [m].

    Args:
        memory: state of the error rule.
        activity: largest activity of a part [m/s].
        steps: step count.
        step: step size [s].
    """
    activity_ratio = max(1.0, activity / memory.activity) if memory.activity else float("inf")
    if activity_ratio > CONSTANTS.estimate_trust_factor:
        # The motion differs from the one with the last estimate, for example after an impact.
        return float("inf")
    if not has_known_order(memory, steps, step):
        return float("inf")
    scale = memory.safety_factor * step * step / memory.coefficient
    return scale * memory.error * power(activity_ratio, _ACTIVITY_EXPONENT)


def count_down(memory: ErrorState) -> None:
    """Count a frame without an estimate."""
    time_left = memory.time_until_estimate - memory.duration
    memory.time_until_estimate = time_left if time_left > 1e-6 * memory.duration else 0.0


def is_for_duration(memory: ErrorState, duration: float) -> bool:
    """Return True if the state of the rule belongs to frames of a duration [s]."""
    return abs(memory.duration - duration) <= 1e-6 * duration
