# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sleep of a sheet at rest: its frames are not computed.

Sleep needs a tolerance in force. The motion that sleep omits is bounded by the motion in the second before it, as
follows. Let d be the largest distance that a particle moved in that second, or twice that in one of its halves. If the
acceleration hardly changes, the speed is at most d / s. The mean velocities of both halves differ by half a second of
acceleration, and each is at most d / s. Therefore the acceleration is at most 4 d / s^2. In T further seconds a
particle moves at most d (T + 2 T^2), and its velocity changes by at most 4 d T.

The sheet keeps that impulse: it wakes with the velocities that it had, plus the acceleration of the observed second
times the time asleep. Without the impulse, a sheet that nothing holds would miss it for ever. The acceleration may have
changed meanwhile, so the change of velocity counts too, by what it displaces in the following second. The sheet sleeps
as long as d (T + 2 T^2 + 4 T) is within the remainder of a quarter of the tolerance. Then it is watched again. The
omitted motion is added to the used drift: 2 d (T + 1), with the larger d of before and after. A sheet at rest moves by
rounding only and sleeps for hours. A creeping sheet exhausts its drift and is then computed until an event touches it.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY, reset_step_control
from cloth_sim_ros.physics.state.controller_state import SLEEP_IMPULSES_KEY as IMPULSE
from cloth_sim_ros.physics.state.controller_state import SLEEP_MIDDLE_KEY as MIDDLE
from cloth_sim_ros.physics.state.controller_state import SLEEP_POSITIONS_KEY as FROM
from cloth_sim_ros.physics.state.controller_state import SLEEP_VELOCITIES_KEY as VELOCITY
from cloth_sim_ros.physics.state.controller_state import SleepState as Memory
from cloth_sim_ros.physics.state.state import State

#: Accelerations below this many rounding errors of a coordinate, times the largest squared frequency, count as zero.
_ROUNDING_FACTOR = 4.0
#: Longest sleep [frames], for a sheet whose motion rounds to zero.
_MAX_FRAMES = 2.0**53


class SleepRule:
    """Criterion and duration of sleep for one simulation; observations are in the state's memory.

    Args:
        plan: equations of motion.
        tolerance: the tolerance in force [m]; with None nothing sleeps.
        period: length of a frame [s].
    """

    def __init__(self, plan: Plan, *, tolerance: float | None, period: float) -> None:
        self._plan, self._period = plan, period
        self._tolerance = tolerance or 0.0
        self._max_drift = CONSTANTS.sleep_drift_fraction * self._tolerance
        self._watch_frames = max(2, math.ceil(CONSTANTS.sleep_quiet_time / period))

    def update(self, state: State, t: float) -> bool:
        """Observe a frame that moved and ended at time t [s]; if it was at rest for long, begin sleep and return True.

        Returns:
            True if the sheet fell asleep.
        """
        if not self._is_calm(state):
            _end_watch(state)
            return False
        memory, middle = Memory.load(state), self._watch_frames // 2
        if FROM not in state.memory or (memory.quiet_frames >= middle and MIDDLE not in state.memory):
            # The watch starts here.
            state.memory[FROM], memory.quiet_frames = state.x, 0.0
            memory.store(state)
            return False
        memory.quiet_frames += 1.0
        if memory.quiet_frames == middle:
            state.memory[MIDDLE] = state.x
        if memory.quiet_frames < self._watch_frames:
            memory.store(state)
            return False
        displacement, impulse = self._observed_motion(state)
        _end_watch(state)
        if memory.sleep_time:
            omitted_time = memory.sleep_time + CONSTANTS.sleep_quiet_time
            memory.drift_used += 2.0 * max(displacement, memory.max_displacement) * omitted_time
        memory.sleep_time, memory.max_displacement, memory.quiet_frames = 0.0, displacement, 0.0
        frames = self._max_sleep_frames(displacement, self._max_drift - memory.drift_used)
        if frames >= self._watch_frames and self.is_in_equilibrium(state, t):
            memory.wake_frame = min(_MAX_FRAMES, float(state.frame + 1 + frames))
            memory.sleep_time = frames * self._period
            state.memory[VELOCITY], state.v = state.v + frames * impulse, np.zeros_like(state.v)
            state.memory[IMPULSE] = impulse
        memory.store(state)
        return is_asleep(state)

    def _observed_motion(self, state: State) -> tuple[float, Array]:
        """Return the largest displacement in the observed second [m] and the velocity change in a frame [m/s].

        Returns:
            Its largest displacement, or twice that in one of its halves [m]; and the velocity change in a frame [m/s].
        """
        start, middle, end = state.memory[FROM], state.memory[MIDDLE], state.x
        frames = self._watch_frames
        before, after = frames // 2, frames - frames // 2
        rates = (
            largest_distance(end, start) / frames,
            largest_distance(middle, start) / before,
            largest_distance(end, middle) / after,
        )
        velocity_change = (end - middle) / (after * self._period) - (middle - start) / (before * self._period)
        return max(rates) * (CONSTANTS.sleep_quiet_time / self._period), velocity_change / (0.5 * frames)

    def _max_sleep_frames(self, displacement: float, budget: float) -> int:
        """Return the number of frames of sleep after which the omitted motion may reach a budget [m].

        Args:
            displacement: largest one in a second [m].
            budget: permitted motion [m].
        """
        if budget <= 0.0:
            return 0
        if displacement == 0.0:
            return int(_MAX_FRAMES)
        # d (2 T^2 + 5 T) = budget, without cancellation.
        ratio = budget / displacement
        return int(min(_MAX_FRAMES, 2.0 * ratio / (5.0 + math.sqrt(25.0 + 8.0 * ratio)) / self._period))

    def is_in_equilibrium(self, state: State, t: float) -> bool:
        """Return True if a state, released at rest at time t [s], is accelerated by no more than sleep permits."""
        model = self._plan.model
        if not self._tolerance or not self._is_steady() or state.v[:, model.anchors].any():
            return False
        acceleration = np.empty_like(state.x)
        self._plan.accelerations(t, state.x, np.zeros_like(state.v), acceleration, state.memory)
        coordinate = max(float(state.x.max()), -float(state.x.min()))
        omega2, _ = self._plan.spectral_bounds(state.x)
        rounding = _ROUNDING_FACTOR * float(np.finfo(np.float64).eps) * omega2 * coordinate
        max_acceleration = max(self._max_drift, rounding)
        contact = self._plan.contact
        if contact is not None and contact.force.jaws:
            pad_accelerations = contact.jaw_accelerations(t, state.x, np.zeros_like(state.v), state.memory)
            if not (np.abs(pad_accelerations) <= max_acceleration).all():
                return False
        return bool(are_all_below(acceleration, max_acceleration))

    def may_stay_asleep(self, state: State) -> bool:
        """Return True if a sleeping sheet may stay asleep; otherwise wake it and return False.

        It wakes if its time is up, or if a body that it hangs on moves.
        """
        if not self._is_steady():
            wake(state)
            return False
        if state.frame >= Memory.load(state).wake_frame:
            _resume_motion(state)
            return False
        return True

    def sleeping_advance(self, integrator: str) -> Advance:
        """Return the report (`Advance`, no steps) of a frame that a sleeping sheet does not compute."""
        error = self._max_drift * self._period / CONSTANTS.sleep_quiet_time
        reason = f"asleep: at rest within the tolerance {self._tolerance:g} m until something touches the cloth"
        return Advance(0, 0, 0.0, math.inf, integrator=integrator, limited_by="rest", error=error, reason=reason)

    def _is_steady(self) -> bool:
        return self._plan.steady()

    def _is_calm(self, state: State) -> bool:
        limit = self._max_drift / CONSTANTS.sleep_quiet_time
        pads = state.memory.get(JAWS_KEY)
        if pads is not None and not (np.abs(pads[:, 1]) <= limit).all():
            return False
        return bool(self._tolerance) and bool(are_all_below(state.v, limit)) and self._is_steady()


def is_asleep(state: State) -> bool:
    """Return True if the sheet of a state sleeps: its frames are not computed."""
    return VELOCITY in state.memory


def sleeps_until(state: State) -> float:
    """Return the index of the frame at which a sleeping sheet wakes by itself; not for others."""
    return Memory.load(state).wake_frame


def wake(state: State) -> None:
    """Wake a state's sheet, if it sleeps, with its velocities and impulse, and restart the observation of rest."""
    if is_asleep(state):
        _resume_motion(state)
        reset_step_control(state)
    state.memory.pop(Memory.key, None)
    _end_watch(state)


def _end_watch(state: State) -> None:
    """End the observation of rest: remove its positions from the state."""
    for key in (FROM, MIDDLE):
        state.memory.pop(key, None)


def _resume_motion(state: State) -> None:
    """End sleep in a state: restore the velocities that the sheet had, plus the impulse since."""
    velocities, impulse = state.memory.pop(VELOCITY), state.memory.pop(IMPULSE, None)
    remaining_frames = max(0.0, Memory.load(state).wake_frame - state.frame)
    state.v = velocities.copy() if impulse is None else velocities - remaining_frames * impulse


def are_all_below(vectors: Array, limit: float) -> bool:
    """Return True if every vector of an array (3, n) is at most as long as the limit; False if one is not finite."""
    # The last particle is checked first. It usually moves if the sheet does, whereas the first ones are often anchored.
    x, y, z = vectors[:, -1].tolist()
    if not x * x + y * y + z * z <= limit * limit:
        return False
    squared_lengths = vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2]
    return bool((squared_lengths <= limit * limit).all())
