# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pads of a scene's pinching grippers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.parameters.declare import ParameterError

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw


class PinchScene(Protocol):
    """Protocol of a `Scene` for pads: parameters of grippers, and names of those that pinch."""

    @property
    def gripper(self) -> sections.GripperParameters: ...

    @property
    def pinching(self) -> list[str]: ...


def pads_of(scene: PinchScene, mass: float) -> list[ParallelJaw]:
    """Build each pinching gripper's `ParallelJaw`, or raise; the cloth's mass [kg] sets the inertia of the drive.

    Raises:
        ParameterError: for invalid values.
    """
    if not scene.pinching:
        return []
    from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw, drive_inertia

    gripper = scene.gripper
    if len(gripper.friction) not in (1, 2):
        raise ParameterError(
            f"gripper.friction has {len(gripper.friction)} entries, {list(gripper.friction)}; give one number, or "
            "static and kinetic"
        )
    try:
        return [
            ParallelJaw(
                gripper=name,
                size=gripper.pad_size,
                friction=(gripper.friction[0], gripper.friction[-1]),
                force=gripper.force,
                speed=gripper.speed,
                opening=gripper.opening,
                inertia=drive_inertia(mass, gripper.force, gripper.speed),
            )
            for name in scene.pinching
        ]
    except ValueError as error:
        raise ParameterError(str(error)) from error
