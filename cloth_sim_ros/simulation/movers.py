# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is moved from outside, grippers and obstacles: poses and targets in the state, a smooth path for each frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import Planner, rotation_vector, turned_by, unit
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.simulation.events import Vector

#: Fastest that an obstacle's surface, or a pad's, follows its target, mean over a frame [m/s].
MOST_SPEED = 10.0
#: Takes a body's index, its pose and its target, and returns the pose that it shall have at the frame's end. A pose is
#: 7 numbers: position [m] and quaternion x, y, z, w.
Goal = Callable[[int, Sequence[float], Sequence[float]], Sequence[float]]


def renewed(state: State, name: str) -> NDArray:
    """Replace an array of the state's memory by a copy, and return the copy to write into.

    The old array is left as it was, because earlier states share it.
    """
    state.memory[name] = state.memory[name].copy()
    return state.memory[name]


def standing(t: float, poses: Array) -> Array:
    """Return the paths of bodies that stand at poses (count, 7) from time t [s] on, shape (count, PATH_NUMBERS)."""
    rows = np.zeros((len(poses), PATH_NUMBERS))
    rows[:, 0], rows[:, 1:4], rows[:, 13:17] = t, poses[:, :3], poses[:, 3:]
    return rows


def within(pose: Sequence[float], target: Sequence[float], reach: float, most: float) -> Sequence[float]:
    """Return where a body is that goes from a pose to a target, 7 numbers each, or as near to it as it may: no point
    within a reach [m] of its origin goes further than `most` [m].
    """
    needed = travel(pose, target, reach)
    if needed <= most:
        return target
    share = most / needed
    displacement = [target[i] - pose[i] for i in range(3)]
    turn = rotation_vector(pose[3:], target[3:])
    turned = turned_by(pose[3:], [share * angle for angle in turn])
    return [*(pose[i] + share * displacement[i] for i in range(3)), *turned]


def travel(pose: Sequence[float], target: Sequence[float], reach: float) -> float:
    """Return the furthest that a point within a reach [m] of a body's origin goes from a pose to a target [m]."""
    displacement = [target[i] - pose[i] for i in range(3)]
    # The turn costs a call of the engine; a body without extent needs none.
    return _length(displacement) + (reach * _length(rotation_vector(pose[3:], target[3:])) if reach else 0.0)


def _length(vector: Sequence[float]) -> float:
    x, y, z = vector
    return math.sqrt(x * x + y * y + z * z)


class Movers:
    """Poses, twists and targets of several bodies; all that changes lies in ``state.memory``.

    Args:
        kind: begins the names of the arrays, e.g. ``gripper``.
        poses: where they are, shape (count, 7), for a state that does not know it.
        state: the state that keeps them; entries that it lacks are added.
    """

    def __init__(self, kind: str, poses: Array, state: State) -> None:
        self._kind = kind
        self._state = state
        self._planner = Planner()
        self._names = tuple(f"{kind}.{what}" for what in ("pose", "twist", "turn", "target"))
        count = len(poses)
        arrays = poses.copy(), np.zeros((count, 6)), np.zeros((count, 6)), poses.copy()
        for name, array in zip(self._names, arrays, strict=True):
            state.memory.setdefault(name, array)

    def array(self, what: str) -> NDArray:
        """One of the arrays, not to be written into: pose, twist, turn or target."""
        return self._state.memory[f"{self._kind}.{what}"]

    def renewed(self, what: str) -> NDArray:
        """The same, to be written into."""
        return renewed(self._state, f"{self._kind}.{what}")

    @property
    def settled(self) -> bool:
        """Whether each stands at its target, and stood there for a frame."""
        still = not self.array("turn").any() and not self.array("twist").any()
        return still and np.array_equal(self.array("pose"), self.array("target"))

    def aim(self, index: int, position: Vector, orientation: Vector | None) -> Array:
        """Take note of a target [m], without an orientation the one before, and return its pose, shape (7,)."""
        target = renewed(self._state, self._names[3])
        if orientation is None:
            # One by one: an array made of three numbers first takes longer.
            target[index, 0], target[index, 1], target[index, 2] = position
        else:
            target[index] = (*position, *unit(orientation))
        pose: Array = target[index]
        return pose

    def halt(self, indices: Sequence[int]) -> list[int]:
        """Let some stand still where they are, until they are aimed anew; return those of them that moved."""
        going = (self.array("pose") != self.array("target")).any(axis=1) | self.array("twist").any(axis=1)
        moving = [k for k in indices if going[k]]
        if moving:
            self.renewed("target")[moving] = self.array("pose")[moving]
            for what in ("twist", "turn"):
                self.renewed(what)[moving] = 0.0
        return moving

    def paths(self, t: float, duration: float, goal: Goal | None = None) -> tuple[Array, list[float]]:
        """Move each over a frame, and return the paths, shape (count, PATH_NUMBERS), and by how much the way of each
        differs from that over the frame before [m], at most, along an axis.

        Args:
            t: time at which the frame starts [s].
            duration: its length [s].
            goal: where one of an index is to be at its end, of its pose and its target; at its target where left out.
        """
        memory = self._state.memory
        poses, twists, before, targets = map(memory.__getitem__, self._names)
        ends = targets
        if goal is not None:
            given = zip(poses.tolist(), targets.tolist(), strict=True)
            ends = np.array([goal(k, *each) for k, each in enumerate(given)])
        rows, last, turns, changes = self._planner.plan(t, duration, poses, twists, before, ends)
        pose, twist, turn, _ = self._names
        # No array of a state is written into, so two names may share one.
        memory[pose], memory[twist], memory[turn] = ends, last, turns
        return rows, changes
