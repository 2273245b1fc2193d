# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When a sheet has come to rest, so that its frames need not be computed any more, and for how long.

The tolerance in force is what licenses it: without one nothing sleeps. What sleep leaves out is bounded by what the
sheet did while it was watched for a second before: let d be the furthest that a particle got in it. A particle whose
velocity and acceleration hardly change had at most the speed d / s, and at most the acceleration 8 d / s^2 (at a
turning point it moves by a / 8 in a second), so in T more seconds it gets no further than d (T + 4 T^2). The sheet
sleeps while that is within what is left of a quarter of the tolerance. Then it wakes with the velocities that it had,
and is watched again: what the sleep left out is booked, d T with the larger d of before and after, twice for caution.
A sheet at rest moves by rounding in a second, and sleeps for hours; one that creeps uses up what it may and is computed
from then on, until an event touches it.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED, restart
from cloth_sim_ros.physics.remembered import SLEEP_FROM as FROM
from cloth_sim_ros.physics.remembered import SLEEP_VELOCITY as VELOCITY
from cloth_sim_ros.physics.remembered import Sleep as Memory
from cloth_sim_ros.physics.state import State

#: Accelerations below so many roundings of a coordinate, times the largest squared frequency, count as zero.
_ROUNDINGS = 4.0
#: Longest sleep [frames]: what rounds to no motion at all sleeps for good.
_FOR_GOOD = 2.0**53


class Sleep:
    """Follows one simulation's frames; all that it remembers lies in the state.

    Args:
        plan: equations of motion.
        tolerance: the tolerance in force [m]; None where there is none, and then nothing sleeps.
        period: length of a frame [s].
    """

    def __init__(self, plan: Plan, *, tolerance: float | None, period: float) -> None:
        self._plan, self._period = plan, period
        self._tolerance = tolerance or 0.0
        self._room = CONSTANTS.drift * self._tolerance
        self._frames = max(2, math.ceil(CONSTANTS.calm / period))

    def follow(self, state: State, t: float) -> bool:
        """Look at a frame that moved and ended at time t [s]; put the sheet to sleep if it may.

        Returns:
            Whether it fell asleep.
        """
        if not self._calm(state):
            state.memory.pop(FROM, None)
            return False
        memory = Memory.of(state)
        if FROM not in state.memory:
            # Watched from here on.
            state.memory[FROM], memory.frames = state.x, 0.0
            memory.store(state)
            return False
        memory.frames += 1.0
        if memory.frames < self._frames:
            memory.store(state)
            return False
        moved = largest_distance(state.x, state.memory.pop(FROM)) * CONSTANTS.calm / (memory.frames * self._period)
        memory.used += 2.0 * max(moved, memory.moved) * memory.slept
        memory.slept, memory.moved, memory.frames = 0.0, moved, 0.0
        frames = self._most(moved, self._room - memory.used)
        if frames >= self._frames and self.rests(state, t):
            memory.until = min(_FOR_GOOD, float(state.frame + 1 + frames))
            memory.slept = frames * self._period
            state.memory[VELOCITY], state.v = state.v, np.zeros_like(state.v)
        memory.store(state)
        return is_asleep(state)

    def _most(self, moved: float, room: float) -> int:
        """Return for how many frames a sheet may sleep that moved so far in a second [m], with room for more [m]."""
        if room <= 0.0:
            return 0
        if moved == 0.0:
            return int(_FOR_GOOD)
        # d (T + 4 T^2) = room, without cancellation.
        ratio = room / moved
        return int(min(_FOR_GOOD, 2.0 * ratio / (1.0 + math.sqrt(1.0 + 16.0 * ratio)) / self._period))

    def rests(self, state: State, t: float) -> bool:
        """Whether a state that is let go where it is, at rest, at time t [s], is hardly accelerated."""
        model = self._plan.model
        if not self._tolerance or not self._steady() or state.v[:, model.anchors].any():
            return False
        if self._plan.contact is not None:
            self._plan.contact.take(state)
        acceleration = np.empty_like(state.x)
        self._plan.accelerations(t, state.x, np.zeros_like(state.v), acceleration)
        coordinate = max(float(state.x.max()), -float(state.x.min()))
        omega2, _ = self._plan.rates(state.x)
        rounding = _ROUNDINGS * float(np.finfo(np.float64).eps) * omega2 * coordinate
        most = max(self._room, rounding)
        contact = self._plan.contact
        if contact is not None and contact.force.pads:
            pushed = contact.pad_accelerations(t, state.x, np.zeros_like(state.v))
            if not (np.abs(pushed) <= most).all():
                return False
        return bool(all_below(acceleration, most))

    def goes_on(self, state: State) -> bool:
        """Whether a sheet that sleeps may sleep on: its time is not up, and nothing moves what it hangs on. Otherwise
        it is woken.
        """
        if not self._steady():
            wake(state)
            return False
        if state.frame >= Memory.of(state).until:
            _rise(state)
            return False
        return True

    def frame(self, integrator: str) -> Advance:
        """What is told of a frame that was slept through."""
        return Advance(
            steps=0,
            evaluations=0,
            step=0.0,
            limit=math.inf,
            integrator=integrator,
            binds="rest",
            error=self._room * self._period / CONSTANTS.calm,
            reason=f"asleep: at rest within the tolerance {self._tolerance:g} m until something touches the cloth",
        )

    def _steady(self) -> bool:
        return self._plan.steady()

    def _calm(self, state: State) -> bool:
        limit = self._room / CONSTANTS.calm
        pads = state.memory.get(PINCHED)
        if pads is not None and not (np.abs(pads[:, 1]) <= limit).all():
            return False
        return bool(self._tolerance) and bool(all_below(state.v, limit)) and self._steady()


def is_asleep(state: State) -> bool:
    """Whether the sheet of a state sleeps."""
    return VELOCITY in state.memory


def sleeps_until(state: State) -> float:
    """Return the number of the frame at which a sheet that sleeps wakes by itself."""
    return Memory.of(state).until


def wake(state: State) -> None:
    """Let the sheet move on from where it is, if it sleeps, and forget how calm it was."""
    if is_asleep(state):
        _rise(state)
        restart(state)
    for name in (Memory.key, FROM):
        state.memory.pop(name, None)


def _rise(state: State) -> None:
    """Let a sheet that sleeps go on with the velocities that it had."""
    state.v = state.memory.pop(VELOCITY).copy()


def all_below(vectors: Array, limit: float) -> bool:
    """Return whether every vector of an array (3, n) is at most as long as the limit; False if one is not finite."""
    # The last particle is looked at first: if the sheet moves it mostly does, while the first ones are often anchored.
    x, y, z = vectors[:, -1].tolist()
    if not x * x + y * y + z * z <= limit * limit:
        return False
    square = vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2]
    return bool((square <= limit * limit).all())
