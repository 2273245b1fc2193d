# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Result types of an engine run: end state, integrals, contact summary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.forces.force import Array


class Run(NamedTuple):
    """Result of one leapfrog run over an interval."""

    #: Positions [m] and velocities [m/s] at the end, shape (2, 3, n).
    ends: Array
    #: Integrals in this order. For each gripper BOOKED_NUMBERS. Powers of damping and of moving air [J]. For each
    #: obstacle BOOKED_NUMBERS. With contact also: largest energy per mass in obstacle contacts, in U^2/2; least gap
    #: [m]; a number for the engine; spectral bounds of self-contact; friction work between layers [J]; recovery work
    #: [J].
    notes: Array
    #: Numbers of grippers and obstacles.
    grippers: int
    obstacles: int
    #: Friction anchors at the end; None without friction.
    anchors: Array | None = None
    #: States of jaws at the end, shape (pinches, PINCH_NUMBERS); None without jaws.
    pinched: Array | None = None

    @property
    def x(self) -> Array:
        """Positions at the end [m], shape (3, n)."""
        x: Array = self.ends[0]
        return x

    @property
    def v(self) -> Array:
        """Velocities at the end [m/s], shape (3, n)."""
        v: Array = self.ends[1]
        return v

    @property
    def grips(self) -> Array:
        """Integrals of each gripper, shape (grippers, BOOKED_NUMBERS)."""
        return self.notes[: BOOKED_NUMBERS * self.grippers].reshape(-1, BOOKED_NUMBERS)

    @property
    def powers(self) -> Array:
        """Integrals of the powers of damping and of moving air [J], shape (2,)."""
        first = BOOKED_NUMBERS * self.grippers
        return self.notes[first : first + 2]

    @property
    def touches(self) -> Array:
        """Integrals of each obstacle, shape (obstacles, BOOKED_NUMBERS)."""
        first = BOOKED_NUMBERS * self.grippers + 2
        return self.notes[first : self._size].reshape(-1, BOOKED_NUMBERS)

    @property
    def reached(self) -> float:
        """Largest energy per mass that an obstacle contact took up during the run, in U^2/2."""
        return float(self.notes[self._size]) if self._touches else 0.0

    @property
    def gap(self) -> float:
        """Least gap during the run [m]; infinite without contact."""
        return float(self.notes[self._size + 1]) if self._touches else math.inf

    @property
    def own(self) -> tuple[float, float]:
        """Squared frequency [1/s^2] and damping rate [1/s] of self-contact that the run resolved."""
        if not self._touches:
            return 0.0, 0.0
        return float(self.notes[self._size + 3]), float(self.notes[self._size + 4])

    @property
    def met(self) -> tuple[float, float, tuple[float, float]]:
        """`encountered_energy`, `min_gap` and `self_contact` in one read."""
        size = self._size
        if len(self.notes) == size:
            return 0.0, math.inf, (0.0, 0.0)
        reached, gap, _, omega2, damping = self.notes[size : size + 5].tolist()
        return reached, gap, (omega2, damping)

    @property
    def rubbed(self) -> float:
        """Work of friction between layers [J]; requires `record_power`."""
        return float(self.notes[self._size + 5]) if self._touches else 0.0

    @property
    def recovered(self) -> float:
        """Work of contacts that regain their thickness [J]; requires `record_power`."""
        return float(self.notes[self._size + 6]) if self._touches else 0.0

    @property
    def _touches(self) -> bool:
        return len(self.notes) > self._size

    @property
    def _size(self) -> int:
        return booked_size(self.grippers, self.obstacles)


def booked_size(grippers: int, obstacles: int) -> int:
    """Return the number of integrals for some grippers and obstacles, powers included."""
    return BOOKED_NUMBERS * (grippers + obstacles) + 2


class Told(NamedTuple):
    """Summary of the combined result of runs."""

    #: Largest change of a particle's velocity [m/s]. It is infinite if a number is not finite, a particle is inside an
    #: obstacle, or the cloth may intersect itself.
    activity: float
    #: Bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate [1/s] at the end.
    omega2: float
    damping: float
    #: Energy per mass that contact has to take up from the end on, in U^2/2.
    contact: float
    #: Squared frequency [1/s^2] and damping rate [1/s] of self-contact from the end on.
    own: tuple[float, float] = (0.0, 0.0)
    #: Bounds of hinges alone: squared frequency [1/s^2], damping rate [1/s], squared frequency across springs [1/s^2].
    #: They are zeros if every step evaluates hinges.
    hinges: Sequence[float] = (0.0, 0.0, 0.0)

    @property
    def finite(self) -> bool:
        """True if every number of the result is finite."""
        return self.activity < float("inf")
