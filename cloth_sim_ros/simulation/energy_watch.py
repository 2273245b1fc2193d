# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Energy balance of a running simulation, summed over frames."""

from __future__ import annotations

from typing import TypeAlias

import attrs

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State


@with_old_names(rubbed="friction_work")
@attrs.frozen(kw_only=True)
class EnergyReport:
    """Energy balance since the watch began [J]: energy, works, dissipation and residual."""

    #: Kinetic plus potential energy now.
    total: float
    #: Work of grippers on the cloth.
    work: float
    #: Work of moving air on the cloth.
    wind: float
    #: Dissipated by springs, drag, grips and contact.
    dissipated: float
    #: Part of `total`: kinetic energy of the air that the cloth carries along.
    air: float = 0.0
    #: Part of `dissipated`: friction between layers of the cloth.
    friction_work: float = 0.0
    #: Work on the cloth of contacts that regain their thickness.
    recovered: float = 0.0
    #: Residual of the balance: energy - energy before - work - wind - recovered + dissipated, summed over frames.
    residual: float
    #: Lower bound of the energy that changed its form.
    turned_over: float


#: Kinetic and potential energy before a frame [J], and the sums since the watch began.
SavedBalance: TypeAlias = tuple[tuple[float, float], EnergyReport]


class EnergyWatch:
    """Sums of the energy balance over frames, `begin` to `end`. Changes by events between two frames are left out.

    Args:
        plan: the equations of motion of the simulation.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._before = (0.0, 0.0)
        self._sums = EnergyReport(total=0.0, work=0.0, wind=0.0, dissipated=0.0, residual=0.0, turned_over=0.0)

    def begin(self, state: State, t: float) -> None:
        """Store the energies of a state before a frame that starts at time t [s]; `end` follows."""
        self._before = self._energies(state, t)

    def end(self, state: State, t: float, accumulator: WorkAccumulator) -> EnergyReport:
        """Add to the sums the frame since `begin`, which ended at time t [s]; return the sums."""
        kinetic, potential = self._energies(state, t)
        dissipation, work = accumulator.dissipation, accumulator.work
        wind, recovered, sums = accumulator.wind_work, accumulator.recovery_work, self._sums
        residual = kinetic + potential - ordered_sum(self._before) - work - wind - recovered + dissipation
        turned_over = sums.turned_over + abs(kinetic - self._before[0]) + abs(dissipation)
        self._sums = EnergyReport(
            total=kinetic + potential,
            air=self._plan.air_energy(state.x, state.v),
            work=sums.work + work,
            wind=sums.wind + wind,
            dissipated=sums.dissipated + dissipation,
            friction_work=sums.friction_work + accumulator.friction_work,
            recovered=sums.recovered + recovered,
            residual=sums.residual + residual,
            turned_over=turned_over + abs(work) + abs(wind) + abs(recovered),
        )
        return self._sums

    def add_sleep_loss(self, end_state: State) -> EnergyReport:
        """Add the kinetic energy that the cloth loses when it falls asleep, as dissipated, and return the sums.

        Args:
            end_state: the state at the end of the frame, still moving.
        """
        kinetic = self._plan.energies(0.0, end_state.x, end_state.v, end_state.memory)[0]
        sums = self._sums
        self._sums = attrs.evolve(sums, total=sums.total - kinetic, air=0.0, dissipated=sums.dissipated + kinetic)
        return self._sums

    def save(self) -> SavedBalance:
        """Return the energies before the frame and the sums so far, for `restore`."""
        return self._before, self._sums

    def restore(self, saved: SavedBalance) -> None:
        """Continue from energies and sums that `save` returned."""
        self._before, self._sums = saved

    def _energies(self, state: State, t: float) -> tuple[float, float]:
        return self._plan.energies(t, state.x, state.v, state.memory)
