# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the engine's runs give."""

from __future__ import annotations

import math
from typing import NamedTuple

from cloth_sim_ros.physics.forces.force import Array


class Run(NamedTuple):
    """One run of the leapfrog over a stretch of time."""

    x: Array
    v: Array
    #: What was noted for each gripper, shape (grippers, BOOKED_NUMBERS), and powers' integrals [J], shape (2,).
    grips: Array
    powers: Array
    #: What was noted for each obstacle, shape (obstacles, BOOKED_NUMBERS); energy per mass that contact had to take up,
    #: in U^2/2, and the least gap [m].
    touches: Array
    reached: float = 0.0
    gap: float = math.inf
    #: Friction's anchors at its end; None without friction.
    anchors: Array | None = None


class Told(NamedTuple):
    """What a frame's call tells of the result."""

    #: Largest change of a particle's velocity [m/s]; infinite where a number is none, or a particle within an obstacle.
    activity: float
    #: Bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate [1/s] there.
    omega2: float
    damping: float
    #: Energy per mass that contact has to take up from there, in U^2/2.
    contact: float

    @property
    def finite(self) -> bool:
        """Whether every number of the result is one."""
        return self.activity < float("inf")
