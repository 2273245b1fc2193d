# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parallel grippers: two jaws that a drive closes on the cloth (docs/derivations/parallel_jaw.md)."""

from __future__ import annotations

import math
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.contact.obstacles import Obstacle

#: Time in which a drive without load reaches its speed [s].
DRIVE_LAG = 1e-3


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in np.asarray(values, dtype=np.float64).ravel())


@attrs.frozen(kw_only=True)
class ParallelJaw:
    """The two jaws of a gripper, boxes that move symmetrically along its axis y, and their drive.

    Let q be half the opening between the faces and M the inertia. F is the force of each jaw at rest, u its speed
    without load and R the opening force of the cloth. Closing jaws move by ``M q'' = R - 2 F (1 + q'/u)``. Opening jaws
    move by ``M q'' = R + 2 F (1 - q'/u)``. The jaws stop at each other, and at their full opening.

    Raises:
        ValueError: for a quantity out of range.
    """

    #: Name of the gripper.
    gripper: str
    #: Edge lengths of a jaw along the gripper's axes [m].
    size: tuple[float, ...] = attrs.field(converter=_floats)
    #: Coefficients of static and kinetic friction.
    friction: tuple[float, ...] = attrs.field(converter=_floats)
    #: F [N], above 0.
    force: float
    #: u [m/s], above 0.
    speed: float
    #: Distance between the faces of open jaws [m], above 0.
    opening: float
    #: M [kg], above 0.
    inertia: float

    def __attrs_post_init__(self) -> None:
        """Refuse quantities that are not above 0, and invalid boxes."""
        units = {"force": "N", "speed": "m/s", "opening": "m", "inertia": "kg"}
        for name, unit in units.items():
            quantity = getattr(self, name)
            if not (math.isfinite(quantity) and quantity > 0.0):
                raise ValueError(f"{name} of the pads of '{self.gripper}' is {quantity} {unit}; it must be above 0")
        self.boxes()

    def boxes(self) -> tuple[Obstacle, Obstacle]:
        """The jaws as obstacles: the left one, on the positive side, first. No obstacle of a scene has such a name."""
        names = (f"{self.gripper}.left_pad", f"{self.gripper}.right_pad")
        first, second = (Obstacle(name=name, shape="box", size=self.size, friction=self.friction) for name in names)
        return first, second

    @property
    def initial_state(self) -> tuple[float, float]:
        """Half opening of open jaws [m] and jaw speed [m/s] at rest."""
        return 0.5 * self.opening, 0.0

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the gripper's position that contains both jaws [m]."""
        x, y, z = self.size
        extent = self.opening + y
        return math.sqrt(0.25 * (x * x + z * z) + extent * extent)

    def engine_row(self, present: bool, closed: bool) -> tuple[float, ...]:
        """Return the engine's row of a drive, see `binding.DRIVE_NUMBERS`.

        Args:
            present: true if the gripper has a pose.
            closed: true if the jaws close.
        """
        state = float(present), float(closed)
        return (*state, self.inertia, self.force, self.speed, 0.5 * self.opening, 0.5 * self.size[1])


def drive_inertia(cloth_mass: float, force: float, speed: float) -> float:
    """Return the inertia [kg] of a drive.

    It is the mass that twice the force accelerates to the speed within `DRIVE_LAG`, plus the mass of the cloth.
    Therefore jaws are never light against the cloth.

    Args:
        cloth_mass: mass of the cloth [kg].
        force: force of each jaw [N].
        speed: speed without load [m/s].
    """
    return cloth_mass + 2.0 * force * DRIVE_LAG / speed
