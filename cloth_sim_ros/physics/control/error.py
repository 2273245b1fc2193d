# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rule of the error: how many runs are combined and how fine their steps are (Hairer, Norsett, Wanner, Solving
Ordinary Differential Equations I, II.9).

The error of a combination T_K of K runs is its distance from T_(K+1). That takes a run more, so between two judgements
it is predicted; a prediction that a judgement does not confirm is trusted less, and the next part is judged too.
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

#: Roundings of the largest coordinate that a run leaves: what a combination makes of them is no error of its steps.
_ROUNDINGS = 4.0
#: The error of a single run is taken to grow by this power of a change of its velocities, as its x''' might.
_LIVELIER = 3


@attrs.define
class Sums:
    """What the parts of a frame add up to."""

    #: Errors of T_1, T_2, ... [m], as many as every part had.
    errors: list[float] = attrs.field(factory=list)
    #: Error of the runs that were combined, and what it would have been taken for [m].
    error: float = 0.0
    predicted: float = 0.0
    #: Error of one run less where none was judged [m].
    before: float = 0.0
    #: Largest change of a velocity over a part [m/s].
    activity: float = 0.0
    #: Number of parts.
    parts: int = 0

    def add(self, errors: Sequence[float], columns: int, predicted: float, activity: float) -> None:
        """Add a part that was judged."""
        known = self.errors or [0.0] * len(errors)
        self.errors = [in_order(pair) for pair in zip(known, errors, strict=False)]
        self.error += errors[columns - 1]
        self.predicted += predicted
        self.activity = max(self.activity, activity)
        self.parts += 1


class ErrorRule:
    """Chooses runs and steps for parts of one length.

    Args:
        memory: of the rule.
        stability: what steps must be finer than.
        budget: error that a part may have [m].
        most: most runs that may be combined.
        state: at the start.
    """

    def __init__(self, memory: Error, stability: StabilityRule, budget: float, most: int, state: State) -> None:
        self.memory, self._stability, self.budget, self._most = memory, stability, budget, most
        self._x = state.x

    def of_stretch(self, memory: Error, budget: float, state: State, stability: StabilityRule) -> ErrorRule:
        """Return the same rule for a shorter stretch."""
        return ErrorRule(memory, stability, budget, self._most, state)

    @cached_property
    def _rounding(self) -> float:
        """What rounding leaves of a run [m]; frames that are not judged never ask."""
        coordinate = max(float(self._x.max()), -float(self._x.min()))
        return _ROUNDINGS * float(np.finfo(np.float64).eps) * coordinate

    def floor(self, columns: int) -> float:
        """Return what rounding alone leaves between T_(K+1) and T_K, K = columns [m]."""
        return self._rounding * amplification(columns + 1)

    def predicted(self, columns: int, difference: float, activity: float) -> float:
        """Return the error [m] of a part that is not judged.

        Args:
            columns: runs that were combined.
            difference: distance of T_K from T_(K-1) [m]; nothing for a single run.
            activity: largest change of a velocity over the part [m/s].
        """
        memory = self.memory
        if columns > 1:
            # Where combinations part more, they gain less on one another: at a kink of a force nothing.
            parted = max(1.0, difference / memory.difference) if memory.difference else float("inf")
            return min(1.0, memory.margin * memory.ratio * parted) * difference
        return predicted_of_one(memory, activity)

    def choose(self, errors: Sequence[float], refine: float) -> tuple[int, float]:
        """Return the runs and the refinement that meet the budget with the fewest force evaluations.

        Args:
            errors: of T_1, T_2, ... at the present refinement [m]; that of T_K falls as h^(K + 1).
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
        """Remember a frame that was judged and accepted, and choose what the next one is run by.

        Args:
            columns: runs that were combined.
            refine: their refinement.
            sums: what its parts added up to.
        """
        memory, errors, error = self.memory, sums.errors, sums.error
        off = error / sums.predicted if sums.predicted > 0.0 else float("inf")
        known = memory.activity > 0.0 and memory.columns == columns
        wanted, finer = self.choose(errors, refine)
        # Steps grow by a factor of two at most: a motion that turns back is calm for a moment.
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
        """Remember a frame that was cut into stretches: the next one is judged at the mean of its steps."""
        self.memory = Error(columns=float(columns), refine=refine, part=self.memory.part)

    def passed(self, columns: int, sums: Sums) -> None:
        """Remember a frame that was not judged; where a run less would do, the next one is."""
        memory = self.memory
        less = columns > 1 and sums.before <= CONSTANTS.aim * self.budget
        memory.wait = 0.0 if less else max(0.0, memory.wait - 1.0)

    def refined(self, refine: float) -> None:
        """Remember that the energy of a fixed step asked for finer ones."""
        memory = self.memory
        memory.refine = refine
        memory.wait = memory.interval = min(CONSTANTS.wait, 2.0 * memory.interval)


def predicted_of_one(memory: Error, activity: float) -> float:
    """Return the error [m] of a part of a single run that is not judged, by the largest change of a velocity over it
    [m/s].
    """
    livelier = max(1.0, activity / memory.activity) if memory.activity else float("inf")
    if livelier > CONSTANTS.trust:
        # Another motion than the one that was judged, as where a particle hits something.
        return float("inf")
    return memory.margin * memory.error * power(livelier, _LIVELIER)


def is_of(memory: Error, duration: float) -> bool:
    """Whether what is remembered is of frames of a length [s]."""
    return abs(memory.part - duration) <= 1e-6 * duration
