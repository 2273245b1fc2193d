# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a scene's values that no single parameter's range shows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Protocol

from cloth_sim_ros.physics.plan.gripper_path import normalized
from cloth_sim_ros.scene import cameras, gripper_parameters, obstacles, sections
from cloth_sim_ros.scene.camera_section import CameraParameters
from cloth_sim_ros.scene.limits import MAX_PARTICLES, MIN_TOLERANCE
from cloth_sim_ros.scene.parameters.declare import Faults


class SceneValues(Protocol):
    """Protocol of a `Scene` for checks of values: the parameters that they read."""

    @property
    def cloth(self) -> sections.ClothParameters: ...

    @property
    def material(self) -> sections.MaterialParameters: ...

    @property
    def contact(self) -> sections.ContactParameters: ...

    @property
    def gripper(self) -> sections.GripperParameters: ...

    @property
    def robot(self) -> sections.RobotParameters: ...

    @property
    def ensemble(self) -> sections.EnsembleParameters: ...

    @property
    def tolerance(self) -> float: ...

    @property
    def frame_id(self) -> str: ...

    @property
    def tf(self) -> sections.TfParameters: ...

    @property
    def gripper_names(self) -> list[str]: ...

    @property
    def individual(self) -> dict[str, Any]: ...

    @property
    def obstacle_names(self) -> list[str]: ...

    @property
    def described(self) -> dict[str, sections.ObstacleParameters]: ...

    @property
    def camera_names(self) -> list[str]: ...

    @property
    def views(self) -> dict[str, CameraParameters]: ...

    @staticmethod
    def groups() -> frozenset[str]: ...


def check_values(scene: SceneValues) -> None:
    """Raise a single ParameterError on all invalid numbers and names of a scene, before its sheet is built.

    Raises:
        ParameterError: naming each parameter.
    """
    faults = Faults()
    faults.add(_faults(scene))
    grippers, names = scene.gripper_names, scene.obstacle_names
    faults.collect(lambda: obstacles.check_distinct("gripper", grippers))
    faults.collect(lambda: gripper_parameters.check_grippers(scene.individual, grippers))
    faults.collect(lambda: obstacles.check_names(names, scene.described, grippers, scene.groups()))
    faults.collect(
        lambda: cameras.check_cameras(
            scene.camera_names,
            scene.views,
            grippers=grippers,
            obstacles=[*names, *scene.described],
            groups=scene.groups(),
        )
    )
    faults.collect(lambda: obstacles.check_friction("contact.friction", scene.contact.friction))
    faults.collect(lambda: obstacles.check_friction("robot.friction", scene.robot.friction))
    faults.refuse()


def _faults(scene: SceneValues) -> Iterator[str]:
    rows, columns = scene.cloth.resolution
    if rows * columns > MAX_PARTICLES:
        yield f"cloth.resolution {rows} x {columns} makes {rows * columns} particles; at most {MAX_PARTICLES}"
    if 0.0 < scene.tolerance < MIN_TOLERANCE:
        yield f"tolerance is {scene.tolerance} m, finer than rounding; take {MIN_TOLERANCE} m or more, or 0.0"
    if not scene.frame_id:
        yield "frame_id is empty; name the coordinate frame, e.g. 'world'"
    if scene.tf.publish and "cloth" in scene.gripper_names:
        yield "a gripper is named 'cloth', as the cloth's own frame is (tf.publish); rename it"
    if not any(scene.material.warp_direction):
        yield "material.warp_direction is [0.0, 0.0, 0.0]; give a direction, e.g. [0.0, 1.0, 0.0]"
    viscosity, modulus = scene.material.viscosity, scene.material.stretch_modulus
    if not math.isfinite(viscosity / modulus):
        yield (
            f"material.viscosity is {viscosity} N s/m and material.stretch_modulus {modulus} N/m; their ratio must be "
            "finite: raise the modulus, or set the viscosity to 0.0"
        )
    if scene.ensemble.members == 1:
        yield "ensemble.members is 1, and a single cloth has no deviation; take 2 or more, or 0 for sigma points"
    orientations = {
        "cloth.orientation": scene.cloth.orientation,
        "gripper.sensor_orientation": scene.gripper.sensor_orientation,
        "robot.orientation": scene.robot.orientation,
    }
    for name, orientation in orientations.items():
        try:
            normalized(orientation)
        except ValueError as error:
            yield f"{name}: {error}"
