# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time integrals along a motion: wrenches on grippers, work, what damping takes and wind gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.runs import Run


class Book:
    """What integrators note along an advance, without changing a bit of it, to the order of the motion itself.

    Args:
        gripper_count: number of grippers.
        powers: whether to note what damping takes and wind gives; it costs about as much as the forces.
        obstacle_count: number of obstacles.
    """

    def __init__(self, gripper_count: int, *, powers: bool = False, obstacle_count: int = 0) -> None:
        self.gripper_count, self.powers, self.obstacle_count = gripper_count, powers, obstacle_count
        self._grips = np.zeros((gripper_count, BOOKED_NUMBERS))
        self._touches = np.zeros((obstacle_count, BOOKED_NUMBERS))
        self._powers = np.zeros(2)
        self._duration = 0.0

    def restart(self) -> None:
        """Forget what was noted since the advance began: it is attempted anew."""
        self._grips.fill(0.0)
        self._touches.fill(0.0)
        self._powers.fill(0.0)
        self._duration = 0.0

    def noted(self) -> tuple[Array, Array, Array, float]:
        """Return what was noted so far, for `go_back`."""
        return self._grips.copy(), self._touches.copy(), self._powers.copy(), self._duration

    def go_back(self, noted: tuple[Array, Array, Array, float]) -> None:
        """Forget what was noted since then: that stretch is attempted anew."""
        self._grips, self._touches, self._powers = (array.copy() for array in noted[:3])
        self._duration = noted[3]

    def add_runs(self, weights: Sequence[float], runs: Sequence[Run], duration: float) -> None:
        """Note a combination of runs over the same stretch [s]: the weighted sum of what each run noted."""
        for weight, run in zip(weights, runs, strict=True):
            self._grips += weight * run.grips
            if self.obstacle_count:
                self._touches += weight * run.touches
            if self.powers:
                self._powers += weight * run.powers
        self._duration += duration

    def add(self, grips: Array, touches: Array, powers: tuple[float, float], duration: float) -> None:
        """Note one point of a quadrature, already multiplied by its weight [s]."""
        self._grips += grips
        self._touches += touches
        self._powers += powers
        self._duration += duration

    @property
    def wrenches(self) -> Array:
        """Mean force [N] and torque [N m] of the cloth on each gripper about its pose, shape (grippers, 6)."""
        if self._duration == 0.0:
            return np.zeros((self.gripper_count, 6))
        mean: Array = self._grips[:, :6] / self._duration
        return mean

    @property
    def loads(self) -> Array:
        """Mean force [N] and torque [N m] of the cloth on each obstacle about its place, shape (obstacles, 6)."""
        if self._duration == 0.0:
            return np.zeros((self.obstacle_count, 6))
        mean: Array = self._touches[:, :6] / self._duration
        return mean

    @property
    def work(self) -> float:
        """Work done on the cloth by grippers and obstacles [J]."""
        return sum(self._touches[:, 6].tolist(), sum(self._grips[:, 6].tolist()))

    @property
    def lost(self) -> float:
        """Energy that springs, drag, grips and contact dissipated [J]; of springs and drag only with `powers`."""
        return sum(self._touches[:, 7].tolist(), float(self._powers[0]) + sum(self._grips[:, 7].tolist()))

    @property
    def given(self) -> float:
        """Energy that moving air put into the motion [J]; only with `powers`."""
        return float(self._powers[1])


def note(book: Book, plan: Plan, t: float, x: Array, v: Array, weight: float) -> None:
    """Note one point of a quadrature: time [s], positions and velocities (3, n), weight [s]."""
    lost, given = plan.powers(t, x, v) if book.powers else (0.0, 0.0)
    none = np.zeros((0, BOOKED_NUMBERS))
    grips = plan.grip_rates(t, x, v, weight) if book.gripper_count else none
    touches = plan.contact.rates(t, x, v, weight) if plan.contact is not None and book.obstacle_count else none
    book.add(grips, touches, (weight * lost, weight * given), weight)
