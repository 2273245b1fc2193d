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

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.stability import StabilityRule
from cloth_sim_ros.physics.integrators.columns import RATIOS, SUMS, amplification
from cloth_sim_ros.physics.powers import in_order, power, root
from cloth_sim_ros.physics.remembered import Error
from cloth_sim_ros.physics.state import State

#: Rounding error of a run, in units of epsilon times the largest coordinate. A combination amplifies it.
_ROUNDINGS = 4.0
#: The predicted error of a single run grows with this power of the velocity change, as x''' may.
_LIVELIER = 3


@attrs.define
class Sums:
    """Sums of errors over the parts of a frame."""

    #: Errors of T_1, T_2, ... [m], as many as all parts have in common.
    errors: list[float] = attrs.field(factory=list)
    #: Estimated error of the chosen combination, and its prediction [m].
    error: float = 0.0
    predicted: float = 0.0
    #: Error of the combination of one run less, in frames without an estimate [m].
    before: float = 0.0
    #: Largest change of a velocity over a part [m/s].
    activity: float = 0.0
    #: Number of parts.
    parts: int = 0

    def add(self, errors: Sequence[float], columns: int, predicted: float, activity: float) -> None:
        """Add the estimates of a part.

        Args:
            errors: of T_1, T_2, ... [m].
            columns: number of combined runs.
            predicted: predicted error [m].
            activity: largest velocity change over the part [m/s].
        """
        known = self.errors or [0.0] * len(errors)
        self.errors = [in_order(pair) for pair in zip(known, errors, strict=False)]
        self.error += errors[columns - 1]
        self.predicted += predicted
        self.activity = max(self.activity, activity)
        self.parts += 1


class ErrorRule:
    """Number of runs and refinement for an interval.

    Args:
        memory: state of the rule.
        stability: rule that bounds step sizes.
        budget: error budget of the interval [m].
        most: maximum number of combined runs.
        state: at the start.
    """

    def __init__(self, memory: Error, stability: StabilityRule, budget: float, most: int, state: State) -> None:
        self.memory, self._stability, self.budget, self._most = memory, stability, budget, most
        self._x = state.x

    def of_stretch(self, memory: Error, budget: float, state: State, stability: StabilityRule) -> ErrorRule:
        """Return the rule for a shorter interval."""
        return ErrorRule(memory, stability, budget, self._most, state)

    @cached_property
    def _rounding(self) -> float:
        """Rounding error of a run [m]; frames without an estimate do not need it."""
        coordinate = max(float(self._x.max()), -float(self._x.min()))
        return _ROUNDINGS * float(np.finfo(np.float64).eps) * coordinate

    def floor(self, columns: int) -> float:
        """Return the distance of T_(K+1) from T_K that rounding alone causes [m], K = n_runs."""
        return self._rounding * amplification(columns + 1)

    def predicted(self, columns: int, difference: float, activity: float) -> float:
        """Return the predicted error of a part [m].

        Args:
            columns: K, the number of combined runs.
            difference: distance of T_K from T_(K-1) [m]; 0 for a single run.
            activity: largest velocity change over the part [m/s].
        """
        memory = self.memory
        if columns > 1:
            # The larger the difference of combinations, the smaller the gain of the next one; at a force jump it is 0.
            parted = max(1.0, difference / memory.difference) if memory.difference else float("inf")
            return min(1.0, memory.margin * memory.ratio * parted) * difference
        return predicted_of_one(memory, activity)

    def choose(self, errors: Sequence[float], refine: float) -> tuple[int, float]:
        """Return the runs and the refinement that meet the budget with the fewest force evaluations.

        Args:
            errors: of T_1, T_2, ... at the present refinement [m]; that of T_K decreases as h^(K + 1).
            refine: present refinement.
        """
        best = (1, refine, float("inf"))
        for columns, error in enumerate(errors[: self._most], start=1):
            scale = root(max(error, self.floor(columns)) / (CONSTANTS.aim * self.budget), columns + 1)
            wanted = max(self._stability.least(columns), refine * scale)
            work = wanted * (SUMS[columns] + RATIOS[columns] / CONSTANTS.wait)
            if work < best[2]:
                best = (columns, wanted, work)
        return best[0], best[1]

    def judged(self, columns: int, refine: float, sums: Sums) -> None:
        """Record the estimates of an accepted frame, and choose runs and refinement of the next one.

        Args:
            columns: number of combined runs.
            refine: their refinement.
            sums: errors of its parts.
        """
        memory, errors, error = self.memory, sums.errors, sums.error
        off = error / sums.predicted if sums.predicted > 0.0 else float("inf")
        known = memory.activity > 0.0 and memory.columns == columns
        wanted, finer = self.choose(errors, refine)
        # Steps grow by a factor of two at most, because a motion that reverses is slow for a moment.
        finer = max(min(finer, CONSTANTS.finer * refine), 0.5 * refine, 1.0)
        scaled, far = refine / finer, error <= CONSTANTS.far * self.budget
        memory.columns, memory.refine, memory.activity = float(wanted), finer, sums.activity
        memory.error = max(errors[wanted - 1] * power(scaled, wanted + 1), self.floor(wanted))
        if wanted > 1:
            before, here = errors[wanted - 2], errors[wanted - 1]
            memory.ratio = min(1.0, here / before * scaled) if before > self.floor(wanted - 1) else 1.0
            memory.difference = max(before, self.floor(wanted - 1)) * power(scaled, wanted) / sums.parts
        trusted = far or (known and off <= CONSTANTS.trust) or error <= self.floor(columns)
        memory.margin = 1.0 if far else max(1.0, 0.5 * memory.margin, min(off, 1e3) if known else 1.0)
        longest = 4.0 * CONSTANTS.wait if far and finer == 1.0 else CONSTANTS.wait
        memory.interval = min(longest, 2.0 * memory.interval) if trusted else 1.0
        memory.wait = memory.interval

    def halved(self, columns: int, refine: float) -> None:
        """Record a frame that was divided into intervals; the next one starts with an estimate at their mean step."""
        self.memory = Error(columns=float(columns), refine=refine, part=self.memory.part)

    def passed(self, columns: int, sums: Sums) -> None:
        """Record a frame without an estimate; the next one gets an estimate if one run less may suffice."""
        memory = self.memory
        less = columns > 1 and sums.before <= CONSTANTS.aim * self.budget
        memory.wait = 0.0 if less else max(0.0, memory.wait - 1.0)

    def refined(self, refine: float) -> None:
        """Record a refinement that the energy rule required for a fixed step."""
        memory = self.memory
        memory.refine = refine
        memory.wait = memory.interval = min(CONSTANTS.wait, 2.0 * memory.interval)


def predicted_of_one(memory: Error, activity: float) -> float:
    """Return the predicted error of a single run over a part [m].

    Args:
        memory: state of the error rule.
        activity: largest velocity change over the part [m/s].
    """
    livelier = max(1.0, activity / memory.activity) if memory.activity else float("inf")
    if livelier > CONSTANTS.trust:
        # The motion differs from the one with the last estimate, for example after an impact.
        return float("inf")
    return memory.margin * memory.error * power(livelier, _LIVELIER)


def is_of(memory: Error, duration: float) -> bool:
    """Return True if the state of the rule belongs to frames of a duration [s]."""
    return abs(memory.part - duration) <= 1e-6 * duration
