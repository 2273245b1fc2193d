# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Part of a scene from which the model is built."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeAlias

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.scene import sections

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.obstacles import Obstacle

Sheet: TypeAlias = GridSheet | MeshSheet | RawSprings


class PhysicsScene(Protocol):
    """Protocol of a `Scene` for building the model: the parameters on which masses and forces depend."""

    @property
    def cloth(self) -> sections.ClothParameters: ...

    @property
    def material(self) -> sections.MaterialParameters: ...

    @property
    def membrane(self) -> sections.MembraneParameters: ...

    @property
    def bending(self) -> sections.BendingParameters: ...

    @property
    def gravity(self) -> tuple[float, ...]: ...

    @property
    def air(self) -> sections.AirParameters: ...

    @property
    def wind(self) -> sections.WindParameters: ...

    @property
    def files(self) -> dict[str, bytes]: ...

    @property
    def gripper_names(self) -> list[str]: ...

    @property
    def contact(self) -> sections.ContactParameters: ...

    @property
    def initial_state(self) -> str: ...

    @property
    def obstacle_names(self) -> list[str]: ...

    @property
    def described(self) -> dict[str, sections.ObstacleParameters]: ...

    @property
    def solids(self) -> list[Obstacle]: ...

    @property
    def gripper(self) -> sections.GripperParameters: ...

    @property
    def pinching(self) -> list[str]: ...

    @property
    def sheet(self) -> Sheet: ...

    def initial_positions(self) -> Array: ...
