# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Energy balance of a running simulation, summed over frames."""

from __future__ import annotations

from typing import TypeAlias

import attrs

from cloth_sim_ros.physics.book import Book
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import in_order
from cloth_sim_ros.physics.state import State


@attrs.frozen(kw_only=True)
class EnergyReport:
    """Energies since the watch began [J]."""

    #: Kinetic plus potential energy now.
    total: float
    #: Work of grippers on the cloth.
    work: float
    #: Work of moving air on the cloth.
    wind: float
    #: Dissipated by springs, drag, grips and contact.
    dissipated: float
    #: Part of `dissipated`: friction between layers of the cloth.
    rubbed: float = 0.0
    #: Work on the cloth of contacts that regain their thickness.
    recovered: float = 0.0
    #: Residual of the balance: energy - energy before - work - wind - recovered + dissipated, summed over frames.
    residual: float
    #: Lower bound of the energy that changed its form.
    turned_over: float


#: Kinetic and potential energy before a frame [J], and the sums since the watch began.
Noted: TypeAlias = tuple[tuple[float, float], EnergyReport]


class EnergyWatch:
    """Sums up the energy balance over frames. Changes by events between two frames are left out.

    Args:
        plan: the equations of motion of the simulation.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._before = (0.0, 0.0)
        self._sums = EnergyReport(total=0.0, work=0.0, wind=0.0, dissipated=0.0, residual=0.0, turned_over=0.0)

    def begin(self, state: State, t: float) -> None:
        """Store the energies of a state before a frame that starts at time t [s]."""
        self._before = self._energies(state, t)

    def end(self, state: State, t: float, book: Book) -> EnergyReport:
        """Add the frame that ended at time t [s] and return the sums."""
        kinetic, potential = self._energies(state, t)
        lost, work, wind, recovered = book.lost, book.work, book.given, book.recovered
        sums = self._sums
        self._sums = EnergyReport(
            total=kinetic + potential,
            work=sums.work + work,
            wind=sums.wind + wind,
            dissipated=sums.dissipated + lost,
            rubbed=sums.rubbed + book.rubbed,
            recovered=sums.recovered + recovered,
            residual=sums.residual + (kinetic + potential - in_order(self._before) - work - wind - recovered + lost),
            turned_over=sums.turned_over
            + abs(kinetic - self._before[0])
            + abs(lost)
            + abs(work)
            + abs(wind)
            + abs(recovered),
        )
        return self._sums

    def stop(self, ended: State) -> EnergyReport:
        """Add the kinetic energy that the cloth loses when it falls asleep, as dissipated, and return the sums.

        Args:
            end_state: the state at the end of the frame, still moving.
        """
        kinetic = self._plan.energies(0.0, ended.x, ended.v)[0]
        sums = self._sums
        self._sums = attrs.evolve(sums, total=sums.total - kinetic, dissipated=sums.dissipated + kinetic)
        return self._sums

    def noted(self) -> Noted:
        """Return the sums so far, for `restore`."""
        return self._before, self._sums

    def go_back(self, noted: Noted) -> None:
        """Continue from sums that `save` returned."""
        self._before, self._sums = noted

    def _energies(self, state: State, t: float) -> tuple[float, float]:
        if self._plan.contact is not None:
            self._plan.contact.take(state)
        return self._plan.energies(t, state.x, state.v)
