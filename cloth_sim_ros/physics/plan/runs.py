# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Result types of an engine run: end state, integrals, contact summary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from cloth_sim_ros.engine import binding
from cloth_sim_ros.engine.binding import RECORD_NUMBERS
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.model.forces.force import Array

#: Index of the number among the integrals of a run with contact that tells if the run was repeated without culling.
VIOLATION_INDEX = 2 - binding.CONTACT_SUMMARY_NUMBERS


class Run(NamedTuple):
    """Result of one leapfrog run over an interval: end state, memory, and integrals of wrenches and powers."""

    #: Positions [m] and velocities [m/s] at the end, shape (2, 3, n).
    end_state: Array
    #: Integrals in this order. For each gripper RECORD_NUMBERS. Powers of damping and of moving air [J]. For each
    #: obstacle RECORD_NUMBERS. With contact also: largest energy per mass in obstacle contacts, in U^2/2; least gap
    #: [m]; 1 if the requested runs were repeated without culling, else 0; spectral bounds of self-contact; friction
    #: work between layers [J]; recovery work [J].
    integrals: Array
    #: Numbers of grippers and obstacles.
    grippers: int
    obstacles: int
    #: Largest difference of a particle's velocity changes over both halves of the run [m/s].
    half_difference: float
    #: Largest change of a particle's jerk from the start to the middle of the run, times T^2/4 [m/s]; 0 if unknown.
    jerk_change: float
    #: Friction anchors at the end; None without friction.
    anchors: Array | None = None
    #: States of jaws at the end, shape (pinches, JAW_NUMBERS); None without jaws.
    jaw_states: Array | None = None
    #: Plastic lengths at the end [m], shape (hinges,); None without friction of bending.
    plastic_lengths: Array | None = None

    @property
    def x(self) -> Array:
        """Positions at the end [m], shape (3, n)."""
        x: Array = self.end_state[0]
        return x

    @property
    def v(self) -> Array:
        """Velocities at the end [m/s], shape (3, n)."""
        v: Array = self.end_state[1]
        return v

    @property
    def gripper_integrals(self) -> Array:
        """Integrals of wrench, power and dissipation of each gripper over the run, shape (grippers, 8)."""
        return self.integrals[: RECORD_NUMBERS * self.grippers].reshape(-1, RECORD_NUMBERS)

    @property
    def power_integrals(self) -> Array:
        """Energy that damping dissipated and work of moving air over the run [J], shape (2,)."""
        first = RECORD_NUMBERS * self.grippers
        return self.integrals[first : first + 2]

    @property
    def obstacle_integrals(self) -> Array:
        """Integrals of wrench, power and dissipation of each obstacle over the run, shape (obstacles, 8)."""
        first = RECORD_NUMBERS * self.grippers + 2
        return self.integrals[first : self._base_size].reshape(-1, RECORD_NUMBERS)

    @property
    def encountered_energy(self) -> float:
        """Largest energy per mass (unit U^2/2) that an obstacle contact had to absorb in the run; 0 without contact."""
        return self.contact_summary[0]

    @property
    def min_gap(self) -> float:
        """Least gap between particles and obstacles during the run [m]; infinite without contact."""
        return self.contact_summary[1]

    @property
    def self_contact(self) -> tuple[float, float]:
        """Bounds of squared frequency [1/s^2] and damping rate [1/s] of self-contact during the run."""
        return self.contact_summary[2]

    @property
    def contact_summary(self) -> tuple[float, float, tuple[float, float]]:
        """`encountered_energy`, `min_gap` and `self_contact` of the run, in one read."""
        size = self._base_size
        if len(self.integrals) == size:
            return 0.0, math.inf, (0.0, 0.0)
        energy, gap, _, omega2, damping = self.integrals[size : size + 5].tolist()
        return energy, gap, (omega2, damping)

    @property
    def repeated_without_culling(self) -> bool:
        """True if this and the other requested runs are repetitions, because one of them violated contact's culling."""
        return self._has_contact and bool(self.integrals[VIOLATION_INDEX])

    @property
    def contact_work(self) -> tuple[float, float]:
        """Energy that friction between layers dissipated [J], and work on the cloth by contacts that regain thickness.

        They require `record_power`.
        """
        if not self._has_contact:
            return 0.0, 0.0
        friction_work, recovery_work = self.integrals[-2:].tolist()
        return friction_work, recovery_work

    @property
    def _has_contact(self) -> bool:
        return len(self.integrals) > self._base_size

    @property
    def _base_size(self) -> int:
        return RECORD_NUMBERS * (self.grippers + self.obstacles) + 2


def n_integrals(grippers: int, obstacles: int) -> int:
    """Return the number of entries of `Run.integrals` without those of contact: grippers, obstacles and two powers."""
    return RECORD_NUMBERS * (grippers + obstacles) + 2


def activity_of(change: float, difference: float) -> float:
    """Return the activity [m/s] of an interval: unsteadiness of its force, from particles' velocity changes.

    A constant force causes no error, one that turns causes much, even if its size stays.

    Args:
        change: largest change of a particle's velocity over the interval [m/s].
        difference: largest difference of a particle's velocity changes over both halves of the interval [m/s].
    """
    return max(CONSTANTS.steady_fraction * change, difference)


class RunSummary(NamedTuple):
    """Summary of combined runs: activity, spectral bounds and contact at the end."""

    #: Activity [m/s], see `activity_of`. It is infinite if a number is not finite, a particle is inside an obstacle, or
    #: the cloth may intersect itself.
    activity: float
    #: A quarter of the largest difference of a particle's velocity change from that of the interval before, per time
    #: [m/s]. In a smooth motion it equals the difference of both halves.
    change_from_before: float
    #: Angle by which a spring turns in a step of the first run [rad], see `PlanQueries.turn_in_step`.
    turn: float
    #: Bounds of the squared highest angular frequency [1/s^2] and of the highest damping rate [1/s] at the end.
    omega2: float
    damping: float
    #: Energy per mass that contact has to take up from the end on, in U^2/2.
    contact_energy: float
    #: Squared frequency [1/s^2] and damping rate [1/s] of self-contact from the end on.
    self_contact: tuple[float, float] = (0.0, 0.0)
    #: Bounds of hinges alone: squared frequency [1/s^2], damping rate [1/s], squared frequency across springs [1/s^2].
    #: They are zeros if every step evaluates hinges.
    hinge_bounds: Sequence[float] = (0.0, 0.0, 0.0)

    @property
    def is_finite(self) -> bool:
        """True if the result is finite, no particle is inside an obstacle, and the cloth does not intersect itself."""
        return self.activity < math.inf
