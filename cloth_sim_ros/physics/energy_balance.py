# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The energy balance of a run: what was put in, what was lost, and what is there."""

from __future__ import annotations

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.state import State


class EnergyBalance:
    """Sums up dissipation, and the work of grippers and wind, over advances.

    residual = E - E at the start - work - wind - recovered + lost. Hand `book` to the integrator, then `close` the
    advance.

    Args:
        plan: equations of motion.
        state: the start.
        t: time at the start [s].
    """

    def __init__(self, plan: Plan, state: State, t: float = 0.0) -> None:
        self._plan = plan
        #: Notes what an advance takes and gives.
        self.book = Book(plan.gripper_count, powers=True, obstacle_count=plan.obstacle_count)
        #: Dissipated so far [J].
        self.lost = 0.0
        #: Of it, by friction between layers [J].
        self.rubbed = 0.0
        #: Done on the cloth by grippers and obstacles so far [J].
        self.work = 0.0
        #: Done on the cloth by moving air so far [J].
        self.wind = 0.0
        #: Energy that went from one form into another so far, at least [J].
        self.turned_over = 0.0
        #: Done on the cloth by contacts that regained their thickness so far [J].
        self.recovered = 0.0
        self._kinetic, potential = self._energies(t, state)
        self._start = self._kinetic + potential

    def close(self, t: float, state: State) -> float:
        """Sum up an advance that ended at time t; return the residual [J] so far."""
        lost, work, wind, recovered = self.book.lost, self.book.work, self.book.given, self.book.recovered
        self.lost += lost
        self.rubbed += self.book.rubbed
        self.work += work
        self.wind += wind
        self.recovered += recovered
        self.book.restart()
        kinetic, potential = self._energies(t, state)
        self.turned_over += abs(kinetic - self._kinetic) + abs(lost) + abs(work) + abs(wind) + abs(recovered)
        self._kinetic = kinetic
        return kinetic + potential - self._start - self.work - self.wind - self.recovered + self.lost

    def _energies(self, t: float, state: State) -> tuple[float, float]:
        # With the state's own anchors: seen from older ones, what slid would count as stretched.
        if self._plan.contact is not None:
            self._plan.contact.take(state)
        return self._plan.energies(t, state.x, state.v)
