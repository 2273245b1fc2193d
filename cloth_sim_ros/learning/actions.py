# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decoder of action arrays of environments and rollouts into events.

The row of a gripper holds its target position x, y, z [m] and its grasp. A grasp of at least 0.5 closes the gripper.
Actions with orientations hold a quaternion x, y, z, w before the grasp. It is normalized.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies.kinematic_bodies import clamp_motion
from cloth_sim_ros.simulation.event_checks import MAX_COORDINATE
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: Size of a gripper's row without and with an orientation.
ACTION_SIZE, ORIENTED_ACTION_SIZE = 4, 8
#: Least grasp that closes a gripper.
CLOSING_THRESHOLD = 0.5
#: Lever arm that converts the speed limit to a limit of the turning rate [m].
_LEVER_ARM = 0.1


class ActionDecoder:
    """Decoder of action arrays into events of a simulation. Raises ValueError for a scene without grippers.

    Args:
        scene: the cloth's scene.
        has_orientations: true if actions have orientations.
        speed: speed limit of a gripper's target [m/s]; infinite by default, so that targets are commanded unchanged.

    Raises:
        ValueError: if the scene has no grippers, or the speed is not above 0.
    """

    def __init__(self, scene: Scene, *, has_orientations: bool = False, speed: float = math.inf) -> None:
        self.names = scene.gripper_names
        if not self.names:
            raise ValueError("the scene has no grippers, so actions have no effect; name some by `grippers`")
        if not speed > 0.0:
            raise ValueError(f"speed is {speed} m/s; it must be above 0, or math.inf for no limit")
        self.has_orientations, self._max_travel = has_orientations, speed * scene.period
        #: Shape of the action of one cloth.
        self.shape = (len(self.names), ORIENTED_ACTION_SIZE if has_orientations else ACTION_SIZE)

    def validate(self, actions: Any, leading_shape: tuple[int, ...], *, dtype: type = np.float64) -> NDArray[Any]:
        """Return actions as an array of shape (*leading_shape, grippers, 4 or 8). Raises ValueError for invalid ones.

        Raises:
            ValueError: if the shape differs, a number is not finite, or a quaternion has no length.
        """
        shape = (*leading_shape, *self.shape)
        try:
            array: NDArray[Any] = np.ascontiguousarray(actions, dtype=dtype)
        except (TypeError, ValueError) as error:
            raise ValueError(f"actions are {actions!r}; they must be numbers of shape {shape}") from error
        if array.shape != shape:
            layout = ", ".join(["x", "y", "z", *(["qx", "qy", "qz", "qw"] if self.has_orientations else []), "grasp"])
            raise ValueError(f"actions have shape {array.shape}; they must be {shape}, for each gripper {layout}")
        position, bound = array[..., :3], float(MAX_COORDINATE)
        if not (np.isfinite(array).all() and (np.abs(position) <= bound).all()):
            wrong = np.argwhere(~np.isfinite(array))
            if len(wrong):
                raise ValueError(f"actions{wrong[0].tolist()} is {array[tuple(wrong[0])]}; it must be finite")
            wrong = np.argwhere(np.abs(position) > bound)
            raise ValueError(f"actions{wrong[0].tolist()} is {position[tuple(wrong[0])]} m; the limit is {bound:g} m")
        if self.has_orientations:
            length = np.sqrt((array[..., 3:7].astype(np.float64) ** 2).sum(axis=-1))
            wrong = np.argwhere(length < 1e-6)
            if len(wrong):
                cause = f"actions{wrong[0].tolist()} has a quaternion without length"
                raise ValueError(f"{cause}; the identity is 0, 0, 0, 1")
        return array

    def to_events(self, action: NDArray[Any], simulation: Simulation) -> list[Event]:
        """Return the target, and the grasp if it changes, of each gripper from one cloth's action (grippers, 4 or 8).

        A gripper gets a `Grasp` event only if its grasp changes.

        Args:
            action: shape (grippers, 4 or 8).
            simulation: the cloth; its state is read.
        """
        memory = simulation.state.memory
        closed, placed = memory["gripper.closed"].tolist(), memory["gripper.placed"].tolist()
        events: list[Event] = []
        for g, row in enumerate(action.tolist()):
            position, orientation = row[:3], row[3:7] if self.has_orientations else None
            if placed[g] and self._max_travel < math.inf:
                position, orientation = self._limit_travel(memory["gripper.target"][g].tolist(), position, orientation)
            events.append(Target(self.names[g], position, orientation))
            if (row[-1] >= CLOSING_THRESHOLD) != closed[g]:
                events.append(Grasp(self.names[g], not closed[g]))
        return events

    def _limit_travel(
        self, previous: Sequence[float], position: Sequence[float], orientation: Sequence[float] | None
    ) -> tuple[Sequence[float], Sequence[float] | None]:
        """Return the pose towards the commanded one that a target can reach in a frame at the speed limit."""
        if orientation is not None:
            length = math.sqrt(ordered_sum(component * component for component in orientation))
            unit = [component / length for component in orientation]
            pose = clamp_motion(previous, [*position, *unit], _LEVER_ARM, self._max_travel)
            return pose[:3], pose[3:]
        displacement = [end - start for start, end in zip(previous, position, strict=False)]
        x, y, z = displacement
        length = math.sqrt(x * x + y * y + z * z)
        if length <= self._max_travel:
            return position, None
        fraction = self._max_travel / length
        return [start + fraction * delta for start, delta in zip(previous, displacement, strict=False)], None
