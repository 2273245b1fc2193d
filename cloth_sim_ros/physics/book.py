# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time integrals along a motion: wrenches on grippers, work, what damping takes and wind gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan


class Book:
    """What integrators note along an advance, without changing a bit of it, to the order of the motion itself.

    Args:
        gripper_count: number of grippers.
        powers: whether to note what damping takes and wind gives; it costs about as much as the forces.
    """

    def __init__(self, gripper_count: int, *, powers: bool = False) -> None:
        self.gripper_count, self.powers = gripper_count, powers
        self._grips = np.zeros((gripper_count, BOOKED_NUMBERS))
        self._powers = np.zeros(2)
        self._duration = 0.0

    def restart(self) -> None:
        """Forget what was noted since the advance began: it is attempted anew."""
        self._grips.fill(0.0)
        self._powers.fill(0.0)
        self._duration = 0.0

    def noted(self) -> tuple[Array, Array, float]:
        """Return what was noted so far, for `go_back`."""
        return self._grips.copy(), self._powers.copy(), self._duration

    def go_back(self, noted: tuple[Array, Array, float]) -> None:
        """Forget what was noted since then: that stretch is attempted anew."""
        self._grips, self._powers, self._duration = noted[0].copy(), noted[1].copy(), noted[2]

    def add_runs(
        self, weights: Sequence[float], grips: Sequence[Array], powers: Sequence[Array], duration: float
    ) -> None:
        """Note a combination of runs over the same stretch [s]: the weighted sum of what each run noted."""
        for weight, grip, power in zip(weights, grips, powers, strict=True):
            self._grips += weight * grip
            if self.powers:
                self._powers += weight * power
        self._duration += duration

    def add(self, grips: Array, powers: tuple[float, float], duration: float) -> None:
        """Note one point of a quadrature, already multiplied by its weight [s]."""
        self._grips += grips
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
    def work(self) -> float:
        """Work done on the cloth by grippers [J]."""
        return sum(self._grips[:, 6].tolist())

    @property
    def lost(self) -> float:
        """Energy that springs, drag and grips dissipated [J]; of springs and drag only with `powers`."""
        return float(self._powers[0]) + sum(self._grips[:, 7].tolist())

    @property
    def given(self) -> float:
        """Energy that moving air put into the motion [J]; only with `powers`."""
        return float(self._powers[1])


def note(book: Book, plan: Plan, t: float, x: Array, v: Array, weight: float) -> None:
    """Note one point of a quadrature: time [s], positions and velocities (3, n), weight [s]."""
    lost, given = plan.powers(t, x, v) if book.powers else (0.0, 0.0)
    grips = plan.grip_rates(t, x, v, weight) if book.gripper_count else np.zeros((0, BOOKED_NUMBERS))
    book.add(grips, (weight * lost, weight * given), weight)
