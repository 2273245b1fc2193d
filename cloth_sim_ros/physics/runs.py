# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the engine's runs give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.forces.force import Array


class Run(NamedTuple):
    """One run of the leapfrog over a stretch of time."""

    #: Positions and velocities at its end, shape (2, 3, n).
    ends: Array
    #: What was noted: for each gripper BOOKED_NUMBERS; integrals of the powers of damping and of moving air [J]; for
    #: each obstacle BOOKED_NUMBERS; and, where there is contact, the energy per mass that obstacles' had to take up, in
    #: U^2/2, the least gap [m], a number for the engine, the rates of the cloth's contact with itself, what friction
    #: between its layers took, and what contacts gave that regained their thickness [J].
    notes: Array
    #: Numbers of grippers and obstacles.
    grippers: int
    obstacles: int
    #: Friction's anchors at its end; None without friction.
    anchors: Array | None = None
    #: Where pads are at its end, shape (pinches, PINCH_NUMBERS); None without any.
    pinched: Array | None = None

    @property
    def x(self) -> Array:
        """Positions at its end [m], shape (3, n)."""
        x: Array = self.ends[0]
        return x

    @property
    def v(self) -> Array:
        """Velocities at its end [m/s], shape (3, n)."""
        v: Array = self.ends[1]
        return v

    @property
    def grips(self) -> Array:
        """What was noted for each gripper, shape (grippers, BOOKED_NUMBERS)."""
        return self.notes[: BOOKED_NUMBERS * self.grippers].reshape(-1, BOOKED_NUMBERS)

    @property
    def powers(self) -> Array:
        """Integrals of the powers of damping and of moving air [J], shape (2,)."""
        first = BOOKED_NUMBERS * self.grippers
        return self.notes[first : first + 2]

    @property
    def touches(self) -> Array:
        """What was noted for each obstacle, shape (obstacles, BOOKED_NUMBERS)."""
        first = BOOKED_NUMBERS * self.grippers + 2
        return self.notes[first : self._size].reshape(-1, BOOKED_NUMBERS)

    @property
    def reached(self) -> float:
        """Energy per mass that obstacles' contact had to take up, in U^2/2."""
        return float(self.notes[self._size]) if self._touches else 0.0

    @property
    def gap(self) -> float:
        """The least gap [m]."""
        return float(self.notes[self._size + 1]) if self._touches else math.inf

    @property
    def own(self) -> tuple[float, float]:
        """Squared frequency [1/s^2] and damping rate [1/s] at which the cloth's contact with itself was followed."""
        if not self._touches:
            return 0.0, 0.0
        return float(self.notes[self._size + 3]), float(self.notes[self._size + 4])

    @property
    def met(self) -> tuple[float, float, tuple[float, float]]:
        """`reached`, `gap` and `own`, read at once."""
        size = self._size
        if len(self.notes) == size:
            return 0.0, math.inf, (0.0, 0.0)
        reached, gap, _, omega2, damping = self.notes[size : size + 5].tolist()
        return reached, gap, (omega2, damping)

    @property
    def rubbed(self) -> float:
        """What friction between layers took [J]; with `powers` alone."""
        return float(self.notes[self._size + 5]) if self._touches else 0.0

    @property
    def recovered(self) -> float:
        """What contacts gave that regained their thickness [J]; with `powers` alone."""
        return float(self.notes[self._size + 6]) if self._touches else 0.0

    @property
    def _touches(self) -> bool:
        return len(self.notes) > self._size

    @property
    def _size(self) -> int:
        return booked_size(self.grippers, self.obstacles)


def booked_size(grippers: int, obstacles: int) -> int:
    """Return how many numbers are booked for so many grippers and obstacles, powers included."""
    return BOOKED_NUMBERS * (grippers + obstacles) + 2


class Told(NamedTuple):
    """What a frame's call tells of the result."""

    #: Largest change of a particle's velocity [m/s]; infinite where a number is none, a particle within an
    #: obstacle, or the cloth may have passed through itself.
    activity: float
    #: Bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate [1/s] there.
    omega2: float
    damping: float
    #: Energy per mass that contact has to take up from there, in U^2/2.
    contact: float
    #: Squared frequency and damping rate of the cloth's contact with itself from there.
    own: tuple[float, float] = (0.0, 0.0)
    #: Bounds of squared frequency and damping rate of hinges alone, and of the squared frequency across springs; zeros
    #: where each step asks for hinges.
    hinges: Sequence[float] = (0.0, 0.0, 0.0)

    @property
    def finite(self) -> bool:
        """Whether every number of the result is one."""
        return self.activity < float("inf")
