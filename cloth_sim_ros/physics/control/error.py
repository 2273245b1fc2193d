# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error rule: number of combined runs and refinement of their steps.

See Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.9. The error estimate of a combination T_K is
its distance from T_(K+1), which costs a further run. Between two estimates the error is predicted. If an estimate does
not confirm the prediction, the next part is estimated too.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import attrs
import numpy as np

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum, power, root
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIO_SUMS, RATIOS, amplification
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
    #: Estimated error of the chosen combination, and its prediction [m].
    error: float = 0.0
    predicted: float = 0.0
    #: Error of the combination of one run less, in frames without an estimate [m].
    lower_order_error: float = 0.0
    #: Largest change of a velocity over a part [m/s].
    activity: float = 0.0
    #: Number of parts.
    n_parts: int = 0

    def add_estimate(self, errors: Sequence[float], n_runs: int, predicted: float, activity: float) -> None:
        """Add the estimates of a part.

        Args:
            errors: of T_1, T_2, ... [m].
            n_runs: number of combined runs.
            predicted: predicted error [m].
            activity: largest velocity change over the part [m/s].
        """
        previous = self.errors or [0.0] * len(errors)
        self.errors = [ordered_sum(pair) for pair in zip(previous, errors, strict=False)]
        self.error += errors[n_runs - 1]
        self.predicted += predicted
        self.activity = max(self.activity, activity)
        self.n_parts += 1


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

    def predict(self, n_runs: int, difference: float, activity: float) -> float:
        """Return the predicted error of a part [m].

        Args:
            n_runs: K, the number of combined runs.
            difference: distance of T_K from T_(K-1) [m]; 0 for a single run.
            activity: largest velocity change over the part [m/s].
        """
        memory = self.memory
        if n_runs > 1:
            # The larger the difference of combinations, the smaller the gain of the next one; at a force jump it is 0.
            growth = max(1.0, difference / memory.difference) if memory.difference else float("inf")
            return min(1.0, memory.safety_factor * memory.error_ratio * growth) * difference
        return predict_single_run_error(memory, activity)

    def choose(self, errors: Sequence[float], refinement: float) -> tuple[int, float]:
        """Return the runs and the refinement that meet the budget with the fewest force evaluations.

        Args:
            errors: of T_1, T_2, ... at the present refinement [m]; that of T_K decreases as h^(K + 1).
            refinement: present refinement.
        """
        best, target = (1, refinement, float("inf")), CONSTANTS.error_target_fraction * self.budget
        for n_runs, error in enumerate(errors[: self._max_runs], start=1):
            floor = self.rounding_floor(n_runs)
            # No step reduces the error below rounding.
            scale = root(max(error, floor) / max(target, floor), n_runs + 1)
            required_refinement = max(self.stability.min_refinement(n_runs), refinement * scale)
            work = required_refinement * (RATIO_SUMS[n_runs] + RATIOS[n_runs] / CONSTANTS.max_estimate_period)
            if work < best[2]:
                best = (n_runs, required_refinement, work)
        return best[0], best[1]

    def record_estimate(self, n_runs: int, refinement: float, sums: ErrorSums) -> None:
        """Record the estimates of an accepted frame, and choose runs and refinement of the next one.

        Args:
            n_runs: number of combined runs.
            refinement: their refinement.
            sums: errors of its parts.
        """
        memory, errors, error = self.memory, sums.errors, sums.error
        prediction_ratio = error / sums.predicted if sums.predicted > 0.0 else float("inf")
        is_comparable = memory.activity > 0.0 and memory.n_runs == n_runs
        next_runs, next_refinement = self.choose(errors, refinement)
        # Steps grow by a factor of two at most, because a motion that reverses is slow for a moment.
        next_refinement = max(min(next_refinement, CONSTANTS.max_refinement_factor * refinement), 0.5 * refinement, 1.0)
        step_ratio, is_far_below = refinement / next_refinement, error <= CONSTANTS.low_error_fraction * self.budget
        memory.n_runs, memory.refinement, memory.activity = float(next_runs), next_refinement, sums.activity
        memory.error = max(errors[next_runs - 1] * power(step_ratio, next_runs + 1), self.rounding_floor(next_runs))
        if next_runs > 1:
            previous, floor = errors[next_runs - 2], self.rounding_floor(next_runs - 1)
            memory.error_ratio = min(1.0, errors[next_runs - 1] / previous * step_ratio) if previous > floor else 1.0
            memory.difference = max(previous, floor) * power(step_ratio, next_runs) / sums.n_parts
        is_confirmed = is_comparable and prediction_ratio <= CONSTANTS.estimate_trust_factor
        is_trusted = is_far_below or is_confirmed or error <= self.rounding_floor(n_runs)
        known_ratio = min(prediction_ratio, 1e3) if is_comparable else 1.0
        memory.safety_factor = 1.0 if is_far_below else max(1.0, 0.5 * memory.safety_factor, known_ratio)
        max_period = CONSTANTS.max_estimate_period * (4.0 if is_far_below and next_refinement == 1.0 else 1.0)
        memory.estimate_period = min(max_period, 2.0 * memory.estimate_period) if is_trusted else 1.0
        memory.frames_until_estimate = memory.estimate_period

    def record_halving(self, n_runs: int, refinement: float) -> None:
        """Record a frame that was divided into intervals; the next one starts with an estimate at their mean step."""
        self.memory = ErrorState(n_runs=float(n_runs), refinement=refinement, duration=self.memory.duration)

    def record_prediction(self, n_runs: int, sums: ErrorSums) -> None:
        """Record a frame without an estimate; the next one gets an estimate if one run less may suffice."""
        memory = self.memory
        fewer_suffice = n_runs > 1 and sums.lower_order_error <= CONSTANTS.error_target_fraction * self.budget
        memory.frames_until_estimate = 0.0 if fewer_suffice else max(0.0, memory.frames_until_estimate - 1.0)

    def record_refinement(self, refinement: float) -> None:
        """Record a refinement that the energy rule required for a fixed step."""
        memory = self.memory
        memory.refinement = refinement
        memory.estimate_period = min(CONSTANTS.max_estimate_period, 2.0 * memory.estimate_period)
        memory.frames_until_estimate = memory.estimate_period


def predict_single_run_error(memory: ErrorState, activity: float) -> float:
    """Return the predicted error of a single run over a part [m].

    Args:
        memory: state of the error rule.
        activity: largest velocity change over the part [m/s].
    """
    activity_ratio = max(1.0, activity / memory.activity) if memory.activity else float("inf")
    if activity_ratio > CONSTANTS.estimate_trust_factor:
        # The motion differs from the one with the last estimate, for example after an impact.
        return float("inf")
    return memory.safety_factor * memory.error * power(activity_ratio, _ACTIVITY_EXPONENT)


def is_for_duration(memory: ErrorState, duration: float) -> bool:
    """Return True if the state of the rule belongs to frames of a duration [s]."""
    return abs(memory.duration - duration) <= 1e-6 * duration
