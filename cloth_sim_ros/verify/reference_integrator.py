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
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import combine
from cloth_sim_ros.physics.integrators.extrapolation_tableau import weights
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import Run, RunSummary
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY, StateMemory

#: Step counts of the runs of an interval: one run more than the simulation's maximum.
STEP_COUNTS = (8, 10, 12, 16, 20)
#: Step counts of the check: 1.5 times as many steps, and one more run.
CHECK_STEP_COUNTS = (12, 15, 18, 24, 30, 36)
#: Maximum step as a fraction of the stability limit at an interval's start.
STABILITY_FRACTION = 0.48
#: Minimum interval as a fraction of a frame; below it, the check tells the size of the error.
_MIN_INTERVAL = 1.0 / 4096.0
#: Minimum interval with friction, as a fraction of a frame: at the onset of sliding the force jumps.
_MIN_INTERVAL_WITH_FRICTION = 1.0 / 256.0
#: Unit roundoff of double precision.
UNIT_ROUNDOFF = 2.0**-53


class MotionState(NamedTuple):
    """Positions x [m], velocities v [m/s], shape (3, n) each, and state memory of a motion at one time."""

    #: Positions [m] and velocities [m/s], shape (3, n) each.
    x: Array
    v: Array
    #: Friction anchors, jaws and contact thickness, as in `State.memory`.
    memory: StateMemory = MappingProxyType({})


def returned_to_yield_surface(plan: Plan, state: MotionState) -> MotionState:
    """Return a state whose plastic lengths are mapped to the yield surface; other states are returned as they are.

    Hinges may start beyond their yield limit: in a folded initial state, or after a change of a parameter. The engine
    maps them at the end of each run's first step, so its limit for small steps is the mapping at the start.
    """
    if plan.plastic is None:
        return state
    lengths, _ = plan.plastic.return_mapping(state.x, state.memory)
    return state._replace(memory={**state.memory, PLASTIC_LENGTHS_KEY: lengths})


@lru_cache(maxsize=16)
def rounding_amplification(counts: tuple[int, ...]) -> float:
    """Return the factor by which extrapolation amplifies rounding errors: the sum of its |weights|."""
    return sum(abs(weight) for weight in weights(counts))


class ReferenceIntegrator:
    """Integrator of frames by extrapolated leapfrog, with an estimated error below `rate` [m/s] times the time.

    Args:
        rate: error per second of simulated time [m/s].
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._interval_scale = 1.0

    def integrate_frame(
        self, plan: Plan, t: float, duration: float, start: MotionState, step: float
    ) -> tuple[MotionState, list[float]]:
        """Integrate a frame in intervals of controlled length; return the end state and the lengths [s].

        Args:
            plan: equations of motion.
            t: time at its start [s].
            duration: its length [s].
            start: state at its start; not modified.
            step: smallest step of the simulation in the frame [s]; infinite if it took none. The steps here are at most
                half of it, except with friction, whose jumps and kinks no step resolves.

        Returns:
            The state at its end, and the lengths of the intervals [s].
        """
        rates, lengths, elapsed = plan.spectral_bounds(start[0]), list[float](), 0.0
        state = returned_to_yield_surface(plan, start)
        # Below the rounding of the difference of two extrapolations, smaller steps bring no gain.
        rounding = rounding_amplification(STEP_COUNTS) + rounding_amplification(STEP_COUNTS[1:])
        min_error = 4.0 * UNIT_ROUNDOFF * float(np.abs(start[0]).max()) * rounding
        min_interval, max_step = _MIN_INTERVAL * duration, 0.5 * step
        if plan.plastic is not None or (plan.contact is not None and plan.contact.force.has_anchors):
            # Around such a force jump the simulation's steps become arbitrarily small.
            min_interval = _MIN_INTERVAL_WITH_FRICTION * duration
            max_step = max(max_step, min_interval / STEP_COUNTS[0])
        while elapsed < duration * (1.0 - 1e-12):
            remaining = duration - elapsed
            # Upper bound of the contact stiffness ahead.
            predicted = plan.predict_contact(t + elapsed, remaining, state.x, state.v, state.memory)
            limit = leapfrog_limit(rates[0] + predicted[0], rates[1] + predicted[1])
            max_interval = min(STABILITY_FRACTION * limit, max_step) * STEP_COUNTS[0] * self._interval_scale
            length = remaining / max(1, math.ceil(remaining / max_interval * (1.0 - 1e-12)))
            end_state, rates, error = self._attempt(plan, t + elapsed, length, state)
            if length > min_interval and not error <= max(self.rate * length, min_error):
                self._interval_scale *= 0.5
                rates = plan.spectral_bounds(state[0])
                continue
            # The error of an interval scales with the sixth power of its length.
            if error < max(self.rate * length / 100.0, min_error):
                self._interval_scale = min(1.0, 1.4 * self._interval_scale)
            state, elapsed = end_state, elapsed + length
            lengths.append(length)
        return state, lengths

    def _attempt(
        self, plan: Plan, t: float, length: float, start: MotionState
    ) -> tuple[MotionState, tuple[float, float], float]:
        end_state, runs, summary = _extrapolate(plan, t, length, start, STEP_COUNTS)
        # Extrapolation of the four finest runs; its difference to all five is its error.
        lower_order = combine([run.x for run in runs[1:]], weights(STEP_COUNTS[1:]))
        error = max_distance(end_state.x, lower_order) if summary.is_finite else math.inf
        if length / STEP_COUNTS[0] > 2.0 * STABILITY_FRACTION * leapfrog_limit(summary.omega2, summary.damping):
            error = math.inf
        return end_state, (summary.omega2, summary.damping), error


def integrate_intervals(
    plan: Plan, t: float, lengths: Sequence[float], start: MotionState, counts: tuple[int, ...] = STEP_COUNTS
) -> MotionState:
    """Integrate intervals of given lengths [s] from time `t` [s] by fixed step counts; return the state at the end."""
    state = returned_to_yield_surface(plan, start)
    for length in lengths:
        state, t = _extrapolate(plan, t, length, state, counts)[0], t + length
    return state


def _extrapolate(
    plan: Plan, t: float, length: float, start: MotionState, counts: tuple[int, ...]
) -> tuple[MotionState, list[Run], RunSummary]:
    """Integrate an interval by leapfrog runs of several step counts; return extrapolated state, runs and summary."""
    memory = start.memory
    runs, result = plan.runs(t, length, (start.x, start.v), counts, weights=weights(counts), memory=memory)
    assert result is not None
    x, v, summary = result
    if plan.has_end_memory:
        memory = {**memory, **plan.combine_ends(t + length, x, v, runs, weights(counts), memory)}
    return MotionState(x, v, memory), runs, summary


def max_distance(x: Array, y: Array) -> float:
    """Return the maximum distance between particles of two arrays (3, n) [m]; infinite if an entry is not finite."""
    distance = float(np.sqrt(np.square(x - y).sum(axis=0).max()))
    return distance if math.isfinite(distance) else math.inf
