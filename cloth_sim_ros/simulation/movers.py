# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is moved from outside, grippers and obstacles: poses and targets in the state, a smooth path for each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import normalised, path_row
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.simulation.events import Vector

#: Where one of an index is to be at a frame's end, of its pose and its target, 7 numbers each.
Goal = Callable[[int, Sequence[float], Sequence[float]], Sequence[float]]


def renewed(state: State, name: str) -> NDArray:
    """Put a copy of an array of the state's memory in its place, to write into: who holds the array holds the state
    before.
    """
    state.memory[name] = state.memory[name].copy()
    return state.memory[name]


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
        count = len(poses)
        for what, array in (
            ("pose", poses.copy()),
            ("twist", np.zeros((count, 6))),
            ("turn", np.zeros((count, 6))),
            ("target", poses.copy()),
        ):
            state.memory.setdefault(f"{kind}.{what}", array)

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
        target = self.renewed("target")
        target[index, :3] = position
        if orientation is not None:
            target[index, 3:] = normalised(orientation)
        pose: Array = target[index]
        return pose

    def paths(self, t: float, duration: float, goal: Goal | None = None) -> tuple[Array, list[float]]:
        """Move each over a frame, and return the paths, shape (count, PATH_NUMBERS), and by how much the way of each
        differs from that over the frame before [m], at most, along an axis.

        Args:
            t: time at which the frame starts [s].
            duration: its length [s].
            goal: where one of an index is to be at its end, of its pose and its target; at its target where left out.
        """
        poses, twists, before, targets = (self.array(what).tolist() for what in ("pose", "twist", "turn", "target"))
        ends = targets
        if goal is not None:
            ends = [goal(k, *given) for k, given in enumerate(zip(poses, targets, strict=True))]
        planned = [path_row(t, duration, *given) for given in zip(poses, twists, before, ends, strict=True)]
        rows, last, turns = (list(column) for column in zip(*planned, strict=True))
        # No array of a state is written into, so two names may share one.
        pose = self.array("target") if goal is None else np.array(ends)
        for what, array in (("pose", pose), ("twist", np.array(last)), ("turn", np.array(turns))):
            self._state.memory[f"{self._kind}.{what}"] = array
        changes = [max(abs(new[i] - old[i]) for i in range(3)) for new, old in zip(turns, before, strict=True)]
        return np.array(rows), changes
