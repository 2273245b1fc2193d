# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time integrals along a motion: wrenches on grippers, work, what damping takes and wind gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import in_order
from cloth_sim_ros.physics.runs import Run, booked_size


class Book:
    """What integrators note along an advance, without changing a bit of it, to the order of the motion itself.

    Args:
        gripper_count: number of grippers.
        powers: whether to note what damping takes and wind gives; it costs about as much as the forces.
        obstacle_count: number of obstacles.
    """

    def __init__(self, gripper_count: int, *, powers: bool = False, obstacle_count: int = 0) -> None:
        self.gripper_count, self.powers, self.obstacle_count = gripper_count, powers, obstacle_count
        # For each gripper, of damping and moving air, for each obstacle: as a run notes them, see `Run.notes`. They are
        # replaced, never written into.
        self._nothing = self._sums = np.zeros(booked_size(gripper_count, obstacle_count))
        # Of friction between layers.
        self._rubbed = 0.0
        # Of contacts that regain their thickness.
        self._recovered = 0.0
        self._no_loads = np.zeros((0, 6))
        self._duration = 0.0

    def restart(self) -> None:
        """Forget what was noted since the advance began: it is attempted anew."""
        self._sums, self._rubbed, self._recovered, self._duration = self._nothing, 0.0, 0.0, 0.0

    def noted(self) -> tuple[Array, float, float, float]:
        """Return what was noted so far, for `go_back`."""
        return self._sums, self._rubbed, self._recovered, self._duration

    def go_back(self, noted: tuple[Array, float, float, float]) -> None:
        """Forget what was noted since then: that stretch is attempted anew."""
        self._sums, self._rubbed, self._recovered, self._duration = noted

    def add_runs(self, weights: Sequence[float], runs: Sequence[Run], duration: float) -> None:
        """Note a combination of runs over the same stretch [s]: the weighted sum of what each run noted."""
        size = len(self._sums)
        for weight, run in zip(weights, runs, strict=True):
            if run.grippers != self.gripper_count:
                raise ValueError(f"a book of {self.gripper_count} grippers for a run with {run.grippers}")
            noted = run.notes[:size]
            self._sums = self._sums + (noted if weight == 1.0 else weight * noted)
            if len(run.notes) > size:
                self._rubbed += weight * run.rubbed
                self._recovered += weight * run.recovered
        self._duration += duration

    def add_touches(self, touches: Array) -> None:
        """Note more of what obstacles did: shape (obstacles, BOOKED_NUMBERS)."""
        self._sums = self._sums.copy()
        self._touches[:] += touches

    def add_recovered(self, recovered: float) -> None:
        """Note what contacts that regain their thickness put in [J]."""
        self._recovered += recovered

    def add(
        self,
        grips: Array,
        touches: Array,
        powers: tuple[float, float],
        duration: float,
        rubbed: float = 0.0,
        recovered: float = 0.0,
    ) -> None:
        """Note one point of a quadrature, already multiplied by its weight [s]."""
        self._sums = self._sums + np.concatenate([grips.ravel(), powers, touches.ravel()])
        self._rubbed += rubbed
        self._recovered += recovered
        self._duration += duration

    @property
    def _grips(self) -> Array:
        return self._sums[: BOOKED_NUMBERS * self.gripper_count].reshape(-1, BOOKED_NUMBERS)

    @property
    def _touches(self) -> Array:
        return self._sums[BOOKED_NUMBERS * self.gripper_count + 2 :].reshape(-1, BOOKED_NUMBERS)

    @property
    def _powers(self) -> Array:
        first = BOOKED_NUMBERS * self.gripper_count
        return self._sums[first : first + 2]

    @property
    def wrenches(self) -> Array:
        """Mean force [N] and torque [N m] of the cloth on each gripper about its pose, shape (grippers, 6)."""
        return self._mean(self._grips)

    @property
    def loads(self) -> Array:
        """Mean force [N] and torque [N m] of the cloth on each obstacle about its place, shape (obstacles, 6)."""
        return self._mean(self._touches) if self.obstacle_count else self._no_loads

    def _mean(self, booked: Array) -> Array:
        if self._duration == 0.0:
            return np.zeros((len(booked), 6))
        mean: Array = booked[:, :6] / self._duration
        return mean

    @property
    def work(self) -> float:
        """Work done on the cloth by grippers and obstacles [J]."""
        return in_order(self._touches[:, 6].tolist(), in_order(self._grips[:, 6].tolist()))

    @property
    def lost(self) -> float:
        """Energy that springs, drag, grips and contact dissipated [J]; of springs and drag only with `powers`."""
        return in_order(self._touches[:, 7].tolist(), float(self._powers[0]) + in_order(self._grips[:, 7].tolist()))

    @property
    def rubbed(self) -> float:
        """What of `lost` friction between layers of the cloth took [J]; only with `powers`."""
        return self._rubbed

    @property
    def recovered(self) -> float:
        """Energy that contacts put in that regained their thickness [J]; only with `powers`."""
        return self._recovered

    @property
    def given(self) -> float:
        """Energy that moving air put into the motion [J]; only with `powers`."""
        return float(self._powers[1])


def note(book: Book, plan: Plan, t: float, x: Array, v: Array, weight: float, *, touches: bool = True) -> None:
    """Note one point of a quadrature: time [s], positions and velocities (3, n), weight [s]; obstacles and growing
    contacts by `touches`.
    """
    lost, given = plan.powers(t, x, v) if book.powers else (0.0, 0.0)
    none = np.zeros((0, BOOKED_NUMBERS))
    grips = plan.grip_rates(t, x, v, weight) if book.gripper_count else none
    met = none
    if plan.contact is not None and book.obstacle_count:
        met = plan.contact.rates(t, x, v, weight) if touches else np.zeros((book.obstacle_count, BOOKED_NUMBERS))
    rubbed = recovered = 0.0
    if plan.contact is not None and book.powers:
        rubbed = weight * plan.contact.rubbed(t, x, v)
        recovered = weight * plan.contact.recovering(t, x, v) if touches else 0.0
    book.add(grips, met, (weight * lost, weight * given), weight, rubbed, recovered)
