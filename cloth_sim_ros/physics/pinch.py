# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pinching: two pads that a gripper's drive closes on the cloth (docs/contact.md)."""

from __future__ import annotations

import math
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.obstacles import Obstacle

#: Time in which a drive without load gets to its speed [s].
LAG = 1e-3


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in np.asarray(values, dtype=np.float64).ravel())


@attrs.frozen(kw_only=True)
class Pads:
    """The two pads of a gripper, boxes that move apart and together along its axis y, and what drives them.

    With q half the way between their faces, M the inertia, F the force of each pad at rest, u the speed of each without
    load and R the force of the cloth that opens them, ``M q'' = R - 2 F (1 + q'/u)`` while they close, ``R + 2 F (1 -
    q'/u)`` while they open. They stop at each other, and at their opening.

    Raises:
        ValueError: for a number out of range.
    """

    #: Name of the gripper.
    gripper: str
    #: Edge lengths of a pad along the gripper's axes [m].
    size: tuple[float, ...] = attrs.field(converter=_numbers)
    #: Coefficients of static and kinetic friction.
    friction: tuple[float, ...] = attrs.field(converter=_numbers)
    #: F [N], above 0.
    force: float
    #: u [m/s], above 0.
    speed: float
    #: Way between the faces of open pads [m], above 0.
    opening: float
    #: M [kg], above 0.
    inertia: float

    def __attrs_post_init__(self) -> None:
        """Refuse what can't be driven."""
        for what, value, unit in (
            ("force", self.force, "N"),
            ("speed", self.speed, "m/s"),
            ("opening", self.opening, "m"),
            ("inertia", self.inertia, "kg"),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{what} of the pads of '{self.gripper}' is {value} {unit}; it must be above 0")
        self.boxes()

    def boxes(self) -> tuple[Obstacle, Obstacle]:
        """The pads: the left one, on the positive side, first. No obstacle of a scene has such a name."""
        both = (f"{self.gripper}.left_pad", f"{self.gripper}.right_pad")
        first, second = (Obstacle(name=name, shape="box", size=self.size, friction=self.friction) for name in both)
        return first, second

    @property
    def start(self) -> tuple[float, float]:
        """Half the way between the faces of open pads at rest [m], and its rate."""
        return 0.5 * self.opening, 0.0

    @property
    def reach(self) -> float:
        """Radius of a sphere about the gripper's place that holds both pads [m]."""
        x, y, z = self.size
        out = self.opening + y
        return math.sqrt(0.25 * (x * x + z * z) + out * out)

    def numbers(self, present: bool, closed: bool) -> tuple[float, ...]:
        """What the engine is told, see `binding.DRIVE_NUMBERS`."""
        state = float(present), float(closed)
        return (*state, self.inertia, self.force, self.speed, 0.5 * self.opening, 0.5 * self.size[1])


def inertia(cloth: float, force: float, speed: float) -> float:
    """Return the inertia [kg] of a drive: what it gets to its speed [m/s] within `LAG` by twice its force [N], and the
    mass [kg] of the cloth, so that pads are never light against what they touch.
    """
    return cloth + 2.0 * force * LAG / speed
