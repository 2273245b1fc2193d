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

from cloth_sim_ros.physics.powers import in_order
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import REACH
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.movers import within
from cloth_sim_ros.simulation.simulation import Simulation

#: Size of a gripper's row without and with an orientation.
NUMBERS, TURNED_NUMBERS = 4, 8
#: Least grasp that closes a gripper.
CLOSED = 0.5
#: Lever arm that converts the speed limit to a limit of the turning rate [m].
_ARM = 0.1


class Commands:
    """Decodes action arrays into events of a simulation.

    Args:
        scene: the cloth's scene.
        has_orientations: true if actions have orientations.
        speed: speed limit of a gripper's target [m/s]; infinite by default, so that targets are commanded unchanged.

    Raises:
        ValueError: if the scene has no grippers, or the speed is not above 0.
    """

    def __init__(self, scene: Scene, *, turned: bool = False, speed: float = math.inf) -> None:
        self.names = scene.gripper_names
        if not self.names:
            raise ValueError("the scene has no grippers, so actions have no effect; name some by `grippers`")
        if not speed > 0.0:
            raise ValueError(f"speed is {speed} m/s; it must be above 0, or math.inf for no limit")
        self.turned, self._way = turned, speed * scene.period
        #: Shape of the action of one cloth.
        self.shape = (len(self.names), TURNED_NUMBERS if turned else NUMBERS)

    def checked(self, actions: Any, lead: tuple[int, ...], *, dtype: type = np.float64) -> NDArray[Any]:
        """Return actions as an array of shape (*lead, grippers, 4 or 8), checked.

        Raises:
            ValueError: if the shape differs, a number is not finite, or a quaternion has no length.
        """
        shape = (*lead, *self.shape)
        try:
            array: NDArray[Any] = np.ascontiguousarray(actions, dtype=dtype)
        except (TypeError, ValueError) as error:
            raise ValueError(f"actions are {actions!r}; they must be numbers of shape {shape}") from error
        if array.shape != shape:
            what = ", ".join(["x", "y", "z", *(["qx", "qy", "qz", "qw"] if self.turned else []), "grasp"])
            raise ValueError(f"actions have shape {array.shape}; they must be {shape}, for each gripper {what}")
        place, bound = array[..., :3], float(REACH)
        if not (np.isfinite(array).all() and (np.abs(place) <= bound).all()):
            wrong = np.argwhere(~np.isfinite(array))
            if len(wrong):
                raise ValueError(f"actions{wrong[0].tolist()} is {array[tuple(wrong[0])]}; it must be finite")
            wrong = np.argwhere(np.abs(place) > bound)
            raise ValueError(f"actions{wrong[0].tolist()} is {place[tuple(wrong[0])]} m; the limit is {bound:g} m")
        if self.turned:
            length = np.sqrt((array[..., 3:7].astype(np.float64) ** 2).sum(axis=-1))
            wrong = np.argwhere(length < 1e-6)
            if len(wrong):
                raise ValueError(
                    f"actions{wrong[0].tolist()} has a quaternion without length; the identity is 0, 0, 0, 1"
                )
        return array

    def events(self, action: NDArray[Any], simulation: Simulation) -> list[Event]:
        """Return the events of one cloth's action for the next frame.

        A gripper gets a `Grasp` event only if its grasp changes.

        Args:
            action: shape (grippers, 4 or 8).
            simulation: the cloth; its state is read.
        """
        memory = simulation.state.memory
        closed, placed = memory["gripper.closed"].tolist(), memory["gripper.placed"].tolist()
        found: list[Event] = []
        for g, numbers in enumerate(action.tolist()):
            position, turn = numbers[:3], numbers[3:7] if self.turned else None
            if placed[g] and self._way < math.inf:
                position, turn = self._near(memory["gripper.target"][g].tolist(), position, turn)
            found.append(Target(self.names[g], position, turn))
            if (numbers[-1] >= CLOSED) != closed[g]:
                found.append(Grasp(self.names[g], not closed[g]))
        return found

    def _near(
        self, before: Sequence[float], position: Sequence[float], turn: Sequence[float] | None
    ) -> tuple[Sequence[float], Sequence[float] | None]:
        """Return the commanded pose, moved towards the previous target until the speed limit holds."""
        if turn is not None:
            length = math.sqrt(in_order(number * number for number in turn))
            unit = [number / length for number in turn]
            pose = within(before, [*position, *unit], _ARM, self._way)
            return pose[:3], pose[3:]
        way = [end - start for start, end in zip(before, position, strict=False)]
        x, y, z = way
        length = math.sqrt(x * x + y * y + z * z)
        if length <= self._way:
            return position, None
        share = self._way / length
        return [start + share * part for start, part in zip(before, way, strict=False)], None
