# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Positions of a robot's joints from joint states of one or several publishers, without a ROS graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.ros.io.stamps import MAX_FUTURE, STAMP_EXPIRY, StampGate

#: Largest position of a joint [rad or m]: squares of larger ones may overflow.
_MAX_POSITION = 1e9
#: Largest number of states that wait for their frame, and of publishers with different joints.
_MAX_WAITING, _MAX_PUBLISHERS = 4096, 256


class JointStates:
    """Newest positions of a robot's joints, from joint states that take effect by stamp.

    States of one list of names are ordered by stamp, as commands of one gripper. States of other names are another
    publisher's. The newest stamp of each joint counts. After a silence of the joint an older one counts too.

    Args:
        names: names of the joints; joints of other names are ignored.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        #: Positions [rad or m]; 0 for joints of unknown position.
        self.positions: NDArray[np.float64] = np.zeros(len(self.names))
        #: True for each joint whose position is known.
        self.is_known: NDArray[np.bool_] = np.zeros(len(self.names), dtype=bool)
        #: Stamp of the newest state in force [ns].
        self.stamp = 0
        #: Stamp of the position of each joint [ns].
        self._stamps: NDArray[np.int64] = np.zeros(len(self.names), dtype=np.int64)
        #: ROS time at which the newest state of each joint came [ns]; 0 for none.
        self._arrivals: NDArray[np.int64] = np.zeros(len(self.names), dtype=np.int64)
        self._indices = {name: k for k, name in enumerate(self.names)}
        #: For each list of names: indices in a message, indices of joints, and the gate of its stamps.
        self._publishers: dict[tuple[str, ...], tuple[NDArray[np.int64], NDArray[np.int64], StampGate]] = {}
        self._waiting: list[tuple[int, NDArray[np.int64], NDArray[np.float64]]] = []

    @property
    def missing(self) -> list[str]:
        """Names of the joints whose position is unknown, as a new list."""
        return [name for name, known in zip(self.names, self.is_known.tolist(), strict=True) if not known]

    def add(self, names: Sequence[str], positions: Sequence[float], stamp: int, now: int) -> bool:
        """Check a joint state, and queue it until its stamp; return false if it names none of the joints.

        Args:
            names: names of joints.
            positions: their positions [rad or m].
            stamp: stamp of the state [ns]; zero means now.
            now: present ROS time [ns].

        Raises:
            StampError: for a stamp that is refused.
            ValueError: for another number of positions than of names, for a joint that is named twice, and for
                positions that are not finite or too large.
        """
        key = tuple(names)
        if key not in self._publishers:
            if len(self._publishers) >= _MAX_PUBLISHERS:
                self._publishers.clear()
            matches = [(k, self._indices[name]) for k, name in enumerate(key) if name in self._indices]
            of_message, of_joints = (np.array([pair[k] for pair in matches], dtype=np.int64) for k in (0, 1))
            self._publishers[key] = of_message, of_joints, StampGate()
        of_message, of_joints, gate = self._publishers[key]
        if not len(of_message):
            return False
        if len(positions) != len(key):
            raise ValueError(f"it names {len(key)} joints and gives {len(positions)} positions; give one for each name")
        if len(set(of_joints.tolist())) != len(of_joints):
            repeated = next(name for k, name in enumerate(key) if name in self._indices and name in key[:k])
            raise ValueError(f"it names joint '{repeated}' twice; give each joint one position")
        values = np.asarray(positions, dtype=np.float64)[of_message]
        # A comparison with NaN is false.
        is_valid = np.abs(values) <= _MAX_POSITION
        if not is_valid.all():
            k = int(np.argmin(is_valid))
            limit = f"it must be finite, and at most {_MAX_POSITION:g}"
            raise ValueError(f"the position of joint '{key[of_message[k]]}' is {values[k]}; {limit}")
        effective = gate.accept(stamp, now)
        self._waiting.append((effective, of_joints, values))
        elapsed = now - self._arrivals[of_joints]
        # The clock may have been set back since.
        silent = of_joints[(elapsed < 0) | (elapsed >= STAMP_EXPIRY)]
        if (self._stamps[silent] > effective).any():
            # The gate accepts the older stamps of a restarted publisher, so that its joints do too.
            self._stamps[silent] = np.minimum(self._stamps[silent], effective)
            self.stamp = int(self._stamps.max())
        self._arrivals[of_joints] = now
        del self._waiting[:-_MAX_WAITING]
        return True

    def silent_since(self, time: int) -> list[str]:
        """Return the names of the joints that had states before a ROS time [ns], but none since."""
        is_silent = (self._arrivals > 0) & (self._arrivals < time)
        return [name for name, silent in zip(self.names, is_silent.tolist(), strict=True) if silent]

    def apply(self, now: int) -> bool:
        """Apply the queued states that are due at a ROS time [ns] to `positions`; return true if a position changed."""
        if not self._waiting:
            return False
        ready = sorted((state for state in self._waiting if state[0] <= now), key=lambda state: state[0])
        if not ready:
            return False
        self._waiting = [state for state in self._waiting if state[0] > now]
        before, known = self.positions.copy(), self.is_known.all()
        for stamp, of_joints, values in ready:
            is_newer = self._stamps[of_joints] <= stamp
            newer = of_joints[is_newer]
            self.positions[newer], self._stamps[newer] = values[is_newer], stamp
            self.is_known[newer] = True
            self.stamp = max(self.stamp, stamp)
        return not known or not np.array_equal(before, self.positions)

    def limit_times(self, now: int) -> None:
        """Limit times to the present ROS time [ns], and drop states too far ahead, because wall time was set back."""
        for times in (self._arrivals, self._stamps):
            np.minimum(times, now, out=times)
        self.stamp = min(self.stamp, now)
        self._waiting = [state for state in self._waiting if state[0] <= now + MAX_FUTURE]

    def restart_time(self, positions: NDArray[np.float64]) -> None:
        """Drop queued states and forget stamps because the clock was set back: any stamp is accepted next.

        Args:
            positions: positions of the joints until their next states [rad or m].
        """
        self._waiting.clear()
        self.positions = positions.copy()
        self.stamp = 0
        self._stamps[:] = 0
        self._arrivals[:] = 0
        for _, _, gate in self._publishers.values():
            gate.reset()
