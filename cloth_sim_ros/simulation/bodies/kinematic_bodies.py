# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kinematic bodies: poses and targets in the state, smooth paths per frame.

Grippers and obstacles are kinematic bodies: commands move them, and the cloth does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import PathPlanner, rotated_by, rotation_vector, unit_quaternion
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.events import Vector

#: Speed limit of surfaces of obstacles and pads, mean over a frame [m/s].
MAX_BODY_SPEED = 10.0
#: Function of a body's index, pose and target that returns its pose at the frame's end. A pose is 7 numbers: position
#: [m] and quaternion x, y, z, w.
EndPose = Callable[[int, Sequence[float], Sequence[float]], Sequence[float]]


def writable_copy(state: State, name: str) -> NDArray:
    """Replace an array of the state's memory by a copy, and return the copy for writing; the old one may be shared.

    The old array stays unchanged, because earlier states share it.
    """
    state.memory[name] = state.memory[name].copy()
    return state.memory[name]


def constant_paths(t: float, poses: Array) -> Array:
    """Return paths of bodies at rest at poses (count, 7) from time t [s] on, engine rows (count, PATH_NUMBERS)."""
    rows = np.zeros((len(poses), PATH_NUMBERS))
    rows[:, 0], rows[:, 1:4], rows[:, 13:17] = t, poses[:, :3], poses[:, 3:]
    return rows


def clamp_motion(pose: Sequence[float], target: Sequence[float], reach: float, max_travel: float) -> Sequence[float]:
    """Return the target pose, or the pose on the way to it at which a limit of travel is reached; 7 numbers each.

    No point within `reach` [m] of the body's origin moves further than `max_travel` [m].
    """
    required_travel = travel(pose, target, reach)
    if required_travel <= max_travel:
        return target
    fraction = max_travel / required_travel
    displacement = [target[i] - pose[i] for i in range(3)]
    rotation = rotation_vector(pose[3:], target[3:])
    end_orientation = rotated_by(pose[3:], [fraction * angle for angle in rotation])
    return [*(pose[i] + fraction * displacement[i] for i in range(3)), *end_orientation]


def travel(pose: Sequence[float], target: Sequence[float], reach: float) -> float:
    """Return an upper bound [m] of the path from pose to target of points within `reach` [m] of the body's origin."""
    displacement = [target[i] - pose[i] for i in range(3)]
    # The rotation costs a call of the engine; a body without extent needs none.
    return _length(displacement) + (reach * _length(rotation_vector(pose[3:], target[3:])) if reach else 0.0)


def _length(vector: Sequence[float]) -> float:
    x, y, z = vector
    return math.sqrt(x * x + y * y + z * z)


class KinematicBodies:
    """Poses, twists and targets of several bodies that commands move, all kept in ``state.memory``.

    Args:
        kind: prefix of the arrays' names, e.g. ``gripper``.
        poses: initial poses, shape (count, 7), for a state that has none.
        state: keeps the arrays; missing entries are added.
    """

    def __init__(self, kind: str, poses: Array, state: State) -> None:
        self._kind = kind
        self._state = state
        self._planner = PathPlanner()
        self._names = tuple(f"{kind}.{quantity}" for quantity in ("pose", "twist", "turn", "target"))
        count = len(poses)
        arrays = poses.copy(), np.zeros((count, 6)), np.zeros((count, 6)), poses.copy()
        for name, array in zip(self._names, arrays, strict=True):
            state.memory.setdefault(name, array)

    def array(self, quantity: str) -> NDArray:
        """Return the state's array `pose`, `twist`, `turn` or `target` of all bodies, for reading only."""
        return self._state.memory[f"{self._kind}.{quantity}"]

    def writable_copy(self, quantity: str) -> NDArray:
        """Replace the state's array `pose`, `twist`, `turn` or `target` by a copy; return it for writing."""
        return writable_copy(self._state, f"{self._kind}.{quantity}")

    @property
    def is_at_rest(self) -> bool:
        """True if each body is at its target and was there for a whole frame."""
        is_still = not self.array("turn").any() and not self.array("twist").any()
        return is_still and np.array_equal(self.array("pose"), self.array("target"))

    def set_target(self, index: int, position: Vector, orientation: Vector | None) -> Array:
        """Store a target position [m] and orientation (None: the present target's); return a view of it, (7,)."""
        target = writable_copy(self._state, self._names[3])
        if orientation is None:
            # Element by element, because building an array of three numbers takes longer.
            target[index, 0], target[index, 1], target[index, 2] = position
        else:
            target[index] = (*position, *unit_quaternion(orientation))
        pose: Array = target[index]
        return pose

    def set_targets(self, indices: Sequence[int], poses: Array) -> None:
        """Store target poses (count, 7) of several bodies: position [m] and quaternion x, y, z, w."""
        x, y, z, w = poses[:, 3:].T
        target = writable_copy(self._state, self._names[3])
        target[indices, :3] = poses[:, :3]
        # As `unit_quaternion` computes it.
        target[indices, 3:] = poses[:, 3:] / np.sqrt(x * x + y * y + z * z + w * w)[:, None]

    def set_poses(self, indices: Sequence[int], poses: Array) -> None:
        """Place several bodies at rest at poses (count, 7), which are their targets too."""
        self.set_targets(indices, poses)
        self.writable_copy("pose")[indices] = self.array("target")[indices]
        for quantity in ("twist", "turn"):
            self.writable_copy(quantity)[indices] = 0.0

    def hold_position(self, indices: Sequence[int]) -> list[int]:
        """Hold the present poses of some bodies until their next targets; return indices of those that were moving."""
        is_moving = (self.array("pose") != self.array("target")).any(axis=1) | self.array("twist").any(axis=1)
        moving = [k for k in indices if is_moving[k]]
        if moving:
            self.writable_copy("target")[moving] = self.array("pose")[moving]
            for quantity in ("twist", "turn"):
                self.writable_copy(quantity)[moving] = 0.0
        return moving

    def move(self, t: float, duration: float, end_pose: EndPose | None = None) -> tuple[Array, list[float]]:
        """Move each body over a frame; return paths, (count, PATH_NUMBERS), and changes of displacement [m].

        Args:
            t: time at which the frame starts [s].
            duration: length of the frame [s].
            end_pose: returns a body's pose at the frame's end from its index, pose and target; by default the target.

        Returns:
            Paths, shape (count, PATH_NUMBERS), and the largest change of each body's displacement from the frame
            before, along an axis [m].
        """
        memory = self._state.memory
        poses, twists, previous_turns, targets = map(memory.__getitem__, self._names)
        ends = targets
        if end_pose is not None and poses is not targets:
            target_poses = targets.tolist()
            end_poses = [end_pose(k, *pair) for k, pair in enumerate(zip(poses.tolist(), target_poses, strict=True))]
            ends = targets if end_poses == target_poses else np.array(end_poses)
        rows, end_twists, turns, changes = self._planner.plan(t, duration, poses, twists, previous_turns, ends)
        pose, twist, turn, _ = self._names
        # Arrays of a state are never written to, so two names may share one.
        memory[pose], memory[twist], memory[turn] = ends, end_twists, turns
        return rows, changes
