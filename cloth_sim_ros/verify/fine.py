# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A motion far finer than the simulation's own: short stretches, each run by leapfrog with several step counts and
combined to order 6; and the same with smaller steps to order 7, to check it.

Nothing of the simulation's error control is used: only the plan's plain runs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cloth_sim_ros.physics.arrays import combine
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.columns import weights
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.runs import Run, Told

#: Step counts of the runs of a stretch: one run more than the simulation ever combines.
FINE = (8, 10, 12, 16, 20)
#: Those of the check: half as many steps again, and one run more still.
FINER = (12, 15, 18, 24, 30, 36)
#: Largest step, relative to the stability limit at a stretch's start: at least twice as fine as any stable one.
SHARE_OF_LIMIT = 0.48
#: A stretch is not cut below this part of a frame: then the check says how large the error is.
_LEAST = 1.0 / 4096.0
#: The same where there is friction: what starts to slide is a jump of the force, which no stretch is short enough for.
_LEAST_ROUGH = 1.0 / 256.0
#: Relative rounding of a number.
ROUNDING = 2.0**-53


class Moving(NamedTuple):
    """A motion at one moment."""

    #: Positions [m] and velocities [m/s], shape (3, n) each.
    x: Array
    v: Array
    #: Anchors of friction, see `Touching.anchors_shape`; None where nothing is held yet.
    anchors: Array | None = None
    #: Where pads of grippers are, see `Touching.pinched_shape`; None where they are open, or there are none.
    pinched: Array | None = None


@lru_cache(maxsize=16)
def amplification(counts: tuple[int, ...]) -> float:
    """Return by how much a combination of such runs amplifies rounding: the sum of |w|."""
    return sum(abs(weight) for weight in weights(counts))


class FineSteps:
    """Cuts frames into stretches so that the estimated error stays below a rate.

    Args:
        rate: error that may be made in a second [m/s].
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._scale = 1.0

    def frame(self, plan: Plan, t: float, duration: float, start: Moving, step: float) -> tuple[Moving, list[float]]:
        """Move through a frame.

        Args:
            plan: equations of motion.
            t: time at its start [s].
            duration: its length [s].
            start: the motion at its start; its arrays stay as they are.
            step: smallest step the simulation took in it [s]; infinite where it took none. Those here are at most half
                of it, but for friction, whose jumps no step resolves.

        Returns:
            The motion at its end, and the lengths of the stretches [s].
        """
        now, rates, lengths, done = start, plan.rates(start[0]), list[float](), 0.0
        # Below what rounding makes of the difference of two combinations no step is better than another.
        least = 4.0 * ROUNDING * float(np.abs(start[0]).max()) * (amplification(FINE) + amplification(FINE[1:]))
        shortest, finest = _LEAST * duration, 0.5 * step
        if plan.contact is not None and plan.contact.force.anchored:
            # Around such a jump the simulation takes steps of no length at all.
            shortest = _LEAST_ROUGH * duration
            finest = max(finest, shortest / FINE[0])
        while done < duration * (1.0 - 1e-12):
            left = duration - done
            # What contact may come to, at the most.
            if plan.contact is not None:
                plan.contact.lay_pads(now.pinched)
            ahead = plan.ahead(t + done, left, now.x, now.v)
            limit = leapfrog_limit(rates[0] + ahead[0], rates[1] + ahead[1])
            longest = min(SHARE_OF_LIMIT * limit, finest) * FINE[0] * self._scale
            length = left / max(1, math.ceil(left / longest * (1.0 - 1e-12)))
            ended, rates, error = self._try(plan, t + done, length, now)
            if length > shortest and not error <= max(self.rate * length, least):
                self._scale *= 0.5
                rates = plan.rates(now[0])
                continue
            # The error of a stretch falls as the sixth power of its length.
            if error < max(self.rate * length / 100.0, least):
                self._scale = min(1.0, 1.4 * self._scale)
            now, done = ended, done + length
            lengths.append(length)
        return now, lengths

    def _try(self, plan: Plan, t: float, length: float, start: Moving) -> tuple[Moving, tuple[float, float], float]:
        ended, runs, told = _combined(plan, t, length, start, FINE)
        # The finer four of them, combined: by how much the fifth changes that is the error of these.
        rough = combine([run.x for run in runs[1:]], weights(FINE[1:]))
        error = distance(ended.x, rough) if told.finite else math.inf
        if length / FINE[0] > 2.0 * SHARE_OF_LIMIT * leapfrog_limit(told.omega2, told.damping):
            error = math.inf
        return ended, (told.omega2, told.damping), error


def follow(plan: Plan, t: float, lengths: Sequence[float], start: Moving, counts: tuple[int, ...] = FINE) -> Moving:
    """Move through the same stretches from another start, or with other step counts in each."""
    now = start
    for length in lengths:
        now, t = _combined(plan, t, length, now, counts)[0], t + length
    return now


def _combined(
    plan: Plan, t: float, length: float, start: Moving, counts: tuple[int, ...]
) -> tuple[Moving, list[Run], Told]:
    """Run a stretch with each of several step counts; return what they combine to, the runs, and what is told of it."""
    if plan.contact is not None:
        plan.contact.lay(start.anchors)
        plan.contact.lay_pads(start.pinched)
    runs, result = plan.runs(t, length, (start.x, start.v), counts, weights=weights(counts))
    assert result is not None
    x, v, told = result
    if plan.contact is None:
        return Moving(x, v), runs, told
    return Moving(x, v, *plan.contact.ended(t + length, x, v, runs, weights(counts))), runs, told


def distance(x: Array, y: Array) -> float:
    """Return the largest distance between particles of two arrays (3, n) [m]; infinite if any entry is not finite."""
    away = float(np.sqrt(np.square(x - y).sum(axis=0).max()))
    return away if math.isfinite(away) else math.inf
