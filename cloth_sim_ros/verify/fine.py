# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reference integrator: extrapolated leapfrog with much smaller steps.

Each interval is integrated with several step counts, extrapolated to order 6. A check uses more and smaller steps, to
order 7. Both use the plan's leapfrog runs only, not the simulation's error control.
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

#: Step counts of the runs of an interval: one run more than the simulation's maximum.
FINE = (8, 10, 12, 16, 20)
#: Step counts of the check: 1.5 times as many steps, and one more run.
FINER = (12, 15, 18, 24, 30, 36)
#: Maximum step as a fraction of the stability limit at an interval's start.
SHARE_OF_LIMIT = 0.48
#: Minimum interval as a fraction of a frame; below it, the check tells the size of the error.
_LEAST = 1.0 / 4096.0
#: Minimum interval with friction, as a fraction of a frame: at the onset of sliding the force jumps.
_LEAST_ROUGH = 1.0 / 256.0
#: Unit roundoff of double precision.
ROUNDING = 2.0**-53


class Moving(NamedTuple):
    """State of a motion at one time."""

    #: Positions [m] and velocities [m/s], shape (3, n) each.
    x: Array
    v: Array
    #: Friction anchors, see `ContactBinding.anchors_shape`; None if there are none yet.
    anchors: Array | None = None
    #: Jaws of the grippers, see `ContactBinding`; None if they are open or absent.
    pinched: Array | None = None


@lru_cache(maxsize=16)
def amplification(counts: tuple[int, ...]) -> float:
    """Return the amplification of rounding by an extrapolation: the sum of |w| over its weights."""
    return sum(abs(weight) for weight in weights(counts))


class FineSteps:
    """Integrates frames in intervals, with the estimated error below a rate.

    Args:
        rate: error per second of simulated time [m/s].
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._scale = 1.0

    def frame(self, plan: Plan, t: float, duration: float, start: Moving, step: float) -> tuple[Moving, list[float]]:
        """Integrate a frame.

        Args:
            plan: equations of motion.
            t: time at its start [s].
            duration: its length [s].
            start: state at its start; not modified.
            step: smallest step of the simulation in the frame [s]; infinite if it took none. The steps here are at most
                half of it, except with friction, whose force jumps no step resolves.

        Returns:
            The state at its end, and the lengths of the intervals [s].
        """
        now, rates, lengths, done = start, plan.rates(start[0]), list[float](), 0.0
        # Below the rounding of the difference of two extrapolations, smaller steps bring no gain.
        least = 4.0 * ROUNDING * float(np.abs(start[0]).max()) * (amplification(FINE) + amplification(FINE[1:]))
        shortest, finest = _LEAST * duration, 0.5 * step
        if plan.contact is not None and plan.contact.force.anchored:
            # Around such a force jump the simulation's steps become arbitrarily small.
            shortest = _LEAST_ROUGH * duration
            finest = max(finest, shortest / FINE[0])
        while done < duration * (1.0 - 1e-12):
            left = duration - done
            # Upper bound of the contact stiffness ahead.
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
            # The error of an interval scales with the sixth power of its length.
            if error < max(self.rate * length / 100.0, least):
                self._scale = min(1.0, 1.4 * self._scale)
            now, done = ended, done + length
            lengths.append(length)
        return now, lengths

    def _try(self, plan: Plan, t: float, length: float, start: Moving) -> tuple[Moving, tuple[float, float], float]:
        ended, runs, told = _combined(plan, t, length, start, FINE)
        # Extrapolation of the four finest runs; its difference to all five is its error.
        rough = combine([run.x for run in runs[1:]], weights(FINE[1:]))
        error = distance(ended.x, rough) if told.finite else math.inf
        if length / FINE[0] > 2.0 * SHARE_OF_LIMIT * leapfrog_limit(told.omega2, told.damping):
            error = math.inf
        return ended, (told.omega2, told.damping), error


def follow(plan: Plan, t: float, lengths: Sequence[float], start: Moving, counts: tuple[int, ...] = FINE) -> Moving:
    """Integrate the same intervals from another start, or with other step counts."""
    now = start
    for length in lengths:
        now, t = _combined(plan, t, length, now, counts)[0], t + length
    return now


def _combined(
    plan: Plan, t: float, length: float, start: Moving, counts: tuple[int, ...]
) -> tuple[Moving, list[Run], Told]:
    """Integrate an interval with several step counts; return the extrapolated state, the runs, and their summary."""
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
    """Return the maximum distance between particles of two arrays (3, n) [m]; infinite if an entry is not finite."""
    away = float(np.sqrt(np.square(x - y).sum(axis=0).max()))
    return away if math.isfinite(away) else math.inf
