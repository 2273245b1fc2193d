# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parallel grippers: two jaws that a drive closes on the cloth (docs/derivations/parallel_jaw.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.contact.obstacles import Obstacle

#: Time in which a drive without load reaches its speed [s].
DRIVE_LAG = 1e-3
#: Setpoint of a drive without one: half opening [m], force [N] and speed [m/s].
NO_SETPOINT = (-1.0, 0.0, 0.0)


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
        """Raise ValueError for quantities that are not above 0, and for invalid boxes."""
        units = {"force": "N", "speed": "m/s", "opening": "m", "inertia": "kg"}
        for name, unit in units.items():
            quantity = getattr(self, name)
            if not (math.isfinite(quantity) and quantity > 0.0):
                raise ValueError(f"{name} of the pads of '{self.gripper}' is {quantity} {unit}; it must be above 0")
        self.boxes()

    def boxes(self) -> tuple[Obstacle, Obstacle]:
        """Return both jaws as box obstacles, the one on the positive side first; their names are unique."""
        names = (f"{self.gripper}.left_pad", f"{self.gripper}.right_pad")
        first, second = (Obstacle(name=name, shape="box", size=self.size, friction=self.friction) for name in names)
        return first, second

    @property
    def initial_state(self) -> tuple[float, float]:
        """Jaw state at the start: half opening of open jaws [m], and speed 0 [m/s]."""
        return 0.5 * self.opening, 0.0

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the gripper's position that contains both jaws [m]."""
        x, y, z = self.size
        extent = self.opening + y
        return math.sqrt(0.25 * (x * x + z * z) + extent * extent)

    def with_limits(self, force: float, speed: float) -> ParallelJaw:
        """Return jaws with force [N] and speed [m/s] lowered to these, 0 for the present ones; inertia follows."""
        new_force, new_speed = min(force or self.force, self.force), min(speed or self.speed, self.speed)
        if (new_force, new_speed) == (self.force, self.speed):
            return self
        cloth_mass = self.inertia - drive_inertia(0.0, self.force, self.speed)
        inertia = drive_inertia(cloth_mass, new_force, new_speed)
        return attrs.evolve(self, force=new_force, speed=new_speed, inertia=inertia)

    def half_opening_range(self, closed: bool, half_opening: float, thickness: float) -> tuple[float, float]:
        """Return the least and the largest half opening [m] to which the drive moves the jaws.

        The stop towards which the drive moves begins to act at the commanded half opening. Jaws that close entirely
        stop at each other, so that cloth between them acts first.

        Args:
            closed: true if the jaws close.
            half_opening: commanded half opening [m]; below 0 for none.
            thickness: contact thickness [m].
        """
        widest = 0.5 * self.opening
        if half_opening < 0.0:
            return 0.0, widest
        return (max(half_opening - 0.25 * thickness, 0.0), widest) if closed else (0.0, min(half_opening, widest))

    def engine_row(
        self, present: bool, closed: bool, setpoint: Sequence[float] = NO_SETPOINT, thickness: float = 0.0
    ) -> tuple[float, ...]:
        """Return an engine row (8): two flags, inertia, force, speed, outer stop, half a jaw's width, inner stop.

        Args:
            present: true if the gripper has a pose.
            closed: true if the jaws close.
            setpoint: commanded half opening [m], force [N] and speed [m/s], as in `ContactControls.jaw_setpoints`.
            thickness: contact thickness [m].
        """
        half_opening, force, speed = setpoint
        drive, (inner, outer) = self.with_limits(force, speed), self.half_opening_range(closed, half_opening, thickness)
        flags = float(present), float(closed)
        return (*flags, drive.inertia, drive.force, drive.speed, outer, 0.5 * self.size[1], inner)


def drive_inertia(cloth_mass: float, force: float, speed: float) -> float:
    """Return the inertia [kg] of jaws with their drive, from the cloth's mass and the drive's force and speed.

    It is the mass that twice the force accelerates to the speed within `DRIVE_LAG`, plus the mass of the cloth.
    Therefore jaws are never light against the cloth.

    Args:
        cloth_mass: mass of the cloth [kg].
        force: force of each jaw [N].
        speed: speed without load [m/s].
    """
    return cloth_mass + 2.0 * force * DRIVE_LAG / speed
