# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accumulator of wrench, work and dissipation integrals along a motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.engine.binding import RECORD_NUMBERS
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.plan.runs import Run, n_integrals
from cloth_sim_ros.physics.state.controller_state import StateMemory


class WorkAccumulator:
    """Accumulator of the wrenches, work and dissipation of one advance, integrated over time; `reset` begins the next.

    The integrals have the order of accuracy of the motion itself. Accumulation changes no bit of the motion.

    Args:
        gripper_count: number of grippers.
        record_power: true to record dissipated power and wind power; it costs about as much as the forces.
        obstacle_count: number of obstacles.
    """

    def __init__(self, gripper_count: int, *, record_power: bool = False, obstacle_count: int = 0) -> None:
        self.gripper_count, self.record_power, self.obstacle_count = gripper_count, record_power, obstacle_count
        # One array: sums of each gripper, of damping and wind, of each obstacle, as in `Run.integrals`. The array is
        # replaced, never written into.
        self._zeros = self._sums = np.zeros(n_integrals(gripper_count, obstacle_count))
        # Work of friction between layers of the cloth [J].
        self._friction_work = 0.0
        # Work of contacts that regain their thickness [J].
        self._recovery_work = 0.0
        self._empty_wrenches = np.zeros((0, 6))
        self._duration = 0.0

    def reset(self) -> None:
        """Set all sums to zero for an advance, or for a new attempt of it."""
        self._sums, self._friction_work, self._recovery_work, self._duration = self._zeros, 0.0, 0.0, 0.0

    def save(self) -> tuple[Array, float, float, float]:
        """Return the present sums as an opaque tuple for `restore`."""
        return self._sums, self._friction_work, self._recovery_work, self._duration

    def restore(self, saved: tuple[Array, float, float, float]) -> None:
        """Replace the sums by those that `save` returned, for a new attempt of an interval."""
        self._sums, self._friction_work, self._recovery_work, self._duration = saved

    def add_runs(self, weights: Sequence[float], runs: Sequence[Run], duration: float) -> None:
        """Add the integrals of a weighted combination of runs over the same interval.

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
            integrals = run.integrals[:size]
            self._sums = self._sums + (integrals if weight == 1.0 else weight * integrals)
            if len(run.integrals) > size:
                friction_work, recovery_work = run.contact_work
                self._friction_work += weight * friction_work
                self._recovery_work += weight * recovery_work
        self._duration += duration

    def add_obstacle_work(self, rates: Array) -> None:
        """Add each obstacle's linear and angular impulse, work and dissipation over an interval, (obstacles, 8)."""
        self._sums = self._sums.copy()
        self._obstacle_sums[:] += rates

    def add_gripper_impulses(self, impulses: Array) -> None:
        """Add each gripper's impulse, work and dissipation at a jump of velocities, shape (grippers, 8)."""
        self._sums = self._sums.copy()
        self._gripper_sums[:] += impulses

    def add_dissipation(self, work: float) -> None:
        """Add energy [J] that bending friction dissipated; ignored unless powers are recorded."""
        if self.record_power and work:
            self._sums = self._sums.copy()
            self._power_sums[0] += work

    def add_recovery_work(self, work: float) -> None:
        """Add work [J] on the cloth by contacts that regain their thickness."""
        self._recovery_work += work

    def add_sample(self, integrals: Array, duration: float, friction_work: float, recovery_work: float) -> None:
        """Add the wrenches and powers at one quadrature point, already multiplied by its weight [s].

        Args:
            integrals: numbers of grippers, dissipation and wind work, numbers of obstacles, as in `Run.integrals`.
            duration: weight of the point [s].
            friction_work: work of friction between layers [J].
            recovery_work: work of contacts that regain their thickness [J].
        """
        self._sums = self._sums + integrals
        self._friction_work += friction_work
        self._recovery_work += recovery_work
        self._duration += duration

    @property
    def _gripper_sums(self) -> Array:
        return self._sums[: RECORD_NUMBERS * self.gripper_count].reshape(-1, RECORD_NUMBERS)

    @property
    def _obstacle_sums(self) -> Array:
        return self._sums[RECORD_NUMBERS * self.gripper_count + 2 :].reshape(-1, RECORD_NUMBERS)

    @property
    def _power_sums(self) -> Array:
        first = RECORD_NUMBERS * self.gripper_count
        return self._sums[first : first + 2]

    @property
    def wrenches(self) -> Array:
        """Mean force [N] and torque [N m] of the cloth on each gripper about its pose, (grippers, 6); 0 at first."""
        return self._mean(self._gripper_sums)

    @property
    def obstacle_wrenches(self) -> Array:
        """Mean force [N] and torque [N m] of the cloth on each obstacle about its position, (obstacles, 6)."""
        return self._mean(self._obstacle_sums) if self.obstacle_count else self._empty_wrenches

    def _mean(self, sums: Array) -> Array:
        if self._duration == 0.0:
            return np.zeros((len(sums), 6))
        mean: Array = sums[:, :6] / self._duration
        return mean

    @property
    def work(self) -> float:
        """Work done on the cloth by grippers and obstacles [J]."""
        return ordered_sum(self._obstacle_sums[:, 6].tolist(), ordered_sum(self._gripper_sums[:, 6].tolist()))

    @property
    def dissipation(self) -> float:
        """Energy that springs, drag, grips and contact dissipated [J]; springs and drag require `record_power`."""
        start = float(self._power_sums[0]) + ordered_sum(self._gripper_sums[:, 7].tolist())
        return ordered_sum(self._obstacle_sums[:, 7].tolist(), start)

    @property
    def friction_work(self) -> float:
        """Part of `dissipation` by friction between layers of the cloth [J]; requires `record_power`."""
        return self._friction_work

    @property
    def recovery_work(self) -> float:
        """Work on the cloth by contacts that regain their thickness [J]; requires `record_power`."""
        return self._recovery_work

    @property
    def wind_work(self) -> float:
        """Work of moving air on the cloth [J]; requires `record_power`."""
        return float(self._power_sums[1])


def accumulate(
    sums: WorkAccumulator,
    plan: Plan,
    t: float,
    x: Array,
    v: Array,
    weight: float,
    memory: StateMemory,
    *,
    record_obstacles: bool = True,
) -> None:
    """Add the wrenches and powers at one point of the motion, times a quadrature weight [s], to an accumulator.

    Args:
        sums: the sums.
        plan: equations of motion.
        t: time [s].
        x: positions [m], shape (3, n).
        v: velocities [m/s], shape (3, n).
        weight: quadrature weight [s].
        memory: memory of the state.
        record_obstacles: true to include obstacles and contacts that regain their thickness.
    """
    dissipated, supplied = plan.powers(t, x, v, memory) if sums.record_power else (0.0, 0.0)
    empty = np.zeros((0, RECORD_NUMBERS))
    gripper_rates = plan.grip_wrench_rates(t, x, v, weight, memory) if sums.gripper_count else empty
    obstacle_rates = empty
    if plan.contact is not None and sums.obstacle_count:
        obstacle_rates = np.zeros((sums.obstacle_count, RECORD_NUMBERS))
        if record_obstacles:
            obstacle_rates = plan.contact.wrench_rates(t, x, v, memory, weight)
    friction_work = recovery_work = 0.0
    if plan.contact is not None and sums.record_power:
        friction_work = weight * plan.contact.friction_power(t, x, v, memory)
        recovery_work = weight * plan.contact.recovery_power(t, x, v, memory) if record_obstacles else 0.0
    powers = weight * dissipated, weight * supplied
    integrals = np.concatenate([gripper_rates.ravel(), powers, obstacle_rates.ravel()])
    sums.add_sample(integrals, weight, friction_work, recovery_work)
