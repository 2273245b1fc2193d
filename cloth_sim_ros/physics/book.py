# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accumulator of wrench, work and dissipation integrals along a motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import BOOKED_NUMBERS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import in_order
from cloth_sim_ros.physics.runs import Run, booked_size


class Book:
    """Accumulates integrals of wrenches and powers during an advance.

    The integrals have the order of accuracy of the motion itself. Accumulation changes no bit of the motion.

    Args:
        gripper_count: number of grippers.
        powers: true to record dissipated power and wind power; it costs about as much as the forces.
        obstacle_count: number of obstacles.
    """

    def __init__(self, gripper_count: int, *, powers: bool = False, obstacle_count: int = 0) -> None:
        self.gripper_count, self.powers, self.obstacle_count = gripper_count, powers, obstacle_count
        # One array: sums of each gripper, of damping and wind, of each obstacle, as in `Run.integrals`. The array is
        # replaced, never written into.
        self._nothing = self._sums = np.zeros(booked_size(gripper_count, obstacle_count))
        # Work of friction between layers of the cloth [J].
        self._rubbed = 0.0
        # Work of contacts that regain their thickness [J].
        self._recovered = 0.0
        self._no_loads = np.zeros((0, 6))
        self._duration = 0.0

    def restart(self) -> None:
        """Set all sums to zero for a new attempt of the advance."""
        self._sums, self._rubbed, self._recovered, self._duration = self._nothing, 0.0, 0.0, 0.0

    def noted(self) -> tuple[Array, float, float, float]:
        """Return the present sums for `restore`."""
        return self._sums, self._rubbed, self._recovered, self._duration

    def go_back(self, noted: tuple[Array, float, float, float]) -> None:
        """Return to sums that `save` returned, for a new attempt of an interval."""
        self._sums, self._rubbed, self._recovered, self._duration = noted

    def add_runs(self, weights: Sequence[float], runs: Sequence[Run], duration: float) -> None:
        """Add a weighted combination of runs over the same interval.

        Args:
            weights: dimensionless weight of each run.
            runs: runs from the same start.
            duration: length of the interval [s].

        Raises:
            ValueError: if a run has another number of grippers.
        """
        size = len(self._sums)
        for weight, run in zip(weights, runs, strict=True):
            if run.grippers != self.gripper_count:
                raise ValueError(
                    f"the work accumulator is for {self.gripper_count} grippers, the run has {run.grippers}"
                )
            noted = run.notes[:size]
            self._sums = self._sums + (noted if weight == 1.0 else weight * noted)
            if len(run.notes) > size:
                self._rubbed += weight * run.rubbed
                self._recovered += weight * run.recovered
        self._duration += duration

    def add_touches(self, touches: Array) -> None:
        """Add integrals of obstacles, shape (obstacles, BOOKED_NUMBERS)."""
        self._sums = self._sums.copy()
        self._touches[:] += touches

    def add_recovered(self, recovered: float) -> None:
        """Add work [J] of contacts that regain their thickness."""
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
        """Add one quadrature point, already multiplied by its weight [s].

        Args:
            grips: rates of each gripper, shape (grippers, BOOKED_NUMBERS).
            touches: rates of each obstacle, shape (obstacles, BOOKED_NUMBERS).
            powers: dissipation and wind work [J].
            duration: weight of the point [s].
            rubbed: work of friction between layers [J].
            recovered: work of contacts that regain their thickness [J].
        """
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
        """Mean force [N] and torque [N m] of the cloth on each obstacle about its position, shape (obstacles, 6)."""
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
        """Energy that springs, drag, grips and contact dissipated [J]; springs and drag require `record_power`."""
        return in_order(self._touches[:, 7].tolist(), float(self._powers[0]) + in_order(self._grips[:, 7].tolist()))

    @property
    def rubbed(self) -> float:
        """Part of `dissipation` by friction between layers of the cloth [J]; requires `record_power`."""
        return self._rubbed

    @property
    def recovered(self) -> float:
        """Work on the cloth by contacts that regain their thickness [J]; requires `record_power`."""
        return self._recovered

    @property
    def given(self) -> float:
        """Work of moving air on the cloth [J]; requires `record_power`."""
        return float(self._powers[1])


def note(book: Book, plan: Plan, t: float, x: Array, v: Array, weight: float, *, touches: bool = True) -> None:
    """Accumulate one quadrature point.

    Args:
        book: the accumulator.
        plan: equations of motion.
        t: time [s].
        x: positions [m], shape (3, n).
        v: velocities [m/s], shape (3, n).
        weight: quadrature weight [s].
        touches: true to include obstacles and contacts that regain their thickness.
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
