# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When a sheet has come to rest, so that its frames need not be computed any more.

The tolerance in force is what licenses it: without one nothing sleeps. A sheet falls asleep at the end of a frame if
for a whole second nothing moved what it hangs on, and no particle was faster than ``tolerance min(0.1 / s, c / 2)``
with the air's drag rate c, and if at its end no particle that was let go there at rest would be accelerated by more
than ``0.2 tolerance / s^2``.

Why that bounds the error: on a mode of angular frequency w the residual force moves the place of rest by a / w^2 and
the speed overshoots it by v / w at most, whatever the damping is, since the residual is taken at zero velocity; for w
from 1.5 rad/s (a pendulum of 4 m) up that is less than a sixth of the tolerance. Motion without any restoring force
is stopped by the air within v / c, half of the tolerance. A turning point is no rest: there the speed vanishes and the
residual does not. Slower modes than 1 rad/s, of sheets of more than ten metres or hardly stretched ones without
weight, are held to the same drift in a second, not to the same distance.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import Advance, restart
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State

#: Name in ``State.memory``: calm frames in a row, and whether the sheet sleeps, shape (2,), int64. It is not there
#: while the sheet moves.
MEMORY = "sleep"
#: Part of the tolerance that may be lost by one second of sleep instead of motion.
DRIFT = 0.1
#: How long a sheet has to be calm [s].
CALM = 1.0
#: Least rate at which motion is taken to die out [1/s]: what is slower than the tolerance in a day is rest even
#: without air.
_LEAST_RATE = 1.0 / 86400.0
#: An acceleration of so many roundings of a coordinate, times the largest squared frequency, is none.
_ROUNDINGS = 4.0


class Sleep:
    """Follows one simulation's frames; all that it remembers lies in the state.

    Args:
        plan: equations of motion.
        tolerance: the tolerance in force [m]; None where there is none, and then nothing sleeps.
        period: length of a frame [s].
    """

    def __init__(self, plan: Plan, *, tolerance: float | None, period: float) -> None:
        self._plan = plan
        self._tolerance = tolerance or 0.0
        self._frames = max(2, math.ceil(CALM / period))
        self._speed = self._tolerance * min(DRIFT, max(0.5 * plan.drag, _LEAST_RATE))
        self._error = DRIFT * self._tolerance * period

    def follow(self, state: State, t: float) -> bool:
        """Look at a frame that moved and ended at time t [s]; put the sheet to sleep, velocities zero, if it may.

        Returns:
            Whether it fell asleep.
        """
        if not self._calm(state):
            state.memory.pop(MEMORY, None)
            return False
        frames = 1 + int(state.memory[MEMORY][0]) if MEMORY in state.memory else 1
        falls = frames >= self._frames
        if falls:
            if not self.rests(state, t):
                state.memory.pop(MEMORY, None)
                return False
            state.v = np.zeros_like(state.v)
        state.memory[MEMORY] = np.array([frames, falls], dtype=np.int64)
        return falls

    def rests(self, state: State, t: float) -> bool:
        """Whether the state would stay where it is, let go at rest at time t [s], by the rule above."""
        model = self._plan.model
        if not self._tolerance or not self._steady() or state.v[:, model.anchors].any():
            return False
        acceleration = np.empty_like(state.x)
        self._plan.accelerations(t, state.x, np.zeros_like(state.v), acceleration)
        coordinate = max(float(state.x.max()), -float(state.x.min()))
        omega2, _ = self._plan.rates(state.x)
        rounding = _ROUNDINGS * float(np.finfo(np.float64).eps) * omega2 * coordinate
        return bool(all_below(acceleration, max(2.0 * DRIFT * self._tolerance, rounding)))

    def goes_on(self, state: State) -> bool:
        """Whether a sheet that sleeps may sleep on: nothing moves what it hangs on. Otherwise it is woken."""
        if self._steady():
            return True
        wake(state)
        return False

    def frame(self, integrator: str) -> Advance:
        """What is told of a frame that was slept through."""
        return Advance(
            steps=0,
            evaluations=0,
            step=0.0,
            limit=math.inf,
            integrator=integrator,
            binds="rest",
            error=self._error,
            reason=f"asleep: at rest within the tolerance {self._tolerance:g} m until something touches the cloth",
        )

    def _steady(self) -> bool:
        return self._plan.steady()

    def _calm(self, state: State) -> bool:
        return bool(self._tolerance) and bool(all_below(state.v, self._speed)) and self._steady()


def is_asleep(state: State) -> bool:
    """Whether the sheet of a state sleeps."""
    memory = state.memory.get(MEMORY)
    return memory is not None and bool(memory[1])


def wake(state: State) -> None:
    """Let the sheet move on from where it is, if it sleeps, and forget how calm it was."""
    if is_asleep(state):
        restart(state)
    state.memory.pop(MEMORY, None)


def all_below(vectors: Array, limit: float) -> bool:
    """Return whether every vector of an array (3, n) is at most as long as the limit; False if one is not finite."""
    # A sheet that moves is known by its last particle: the first ones are often anchored.
    x, y, z = vectors[:, -1].tolist()
    if not x * x + y * y + z * z <= limit * limit:
        return False
    square = vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2]
    return bool((square <= limit * limit).all())
