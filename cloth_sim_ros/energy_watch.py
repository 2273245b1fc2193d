# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The energy balance of a live simulation: each frame is run a second time beside it, watched, and thrown away.

Watching needs every step of the motion, which the compiled loop does not show. So the watched run goes term by term,
from the same state: it differs
from the real one by rounding alone, and the real one never knows of it.
"""

from __future__ import annotations

import attrs
import numpy as np

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.energy_balance import EnergyBalance
from cloth_sim_ros.physics.integrators.base import Integrator
from cloth_sim_ros.physics.state import State


@attrs.frozen(kw_only=True)
class EnergyReport:
    """Energies since the watch began [J]."""

    #: Kinetic plus potential energy now.
    total: float
    #: Done on the cloth by grippers.
    work: float
    #: Done on the cloth by moving air.
    wind: float
    #: Dissipated by springs, drag and grips.
    dissipated: float
    #: What the balance leaves over: energy - energy before - work - wind + dissipated, summed over all frames.
    residual: float
    #: Energy that went from one form into another, at least.
    turned_over: float


class EnergyWatch:
    """Adds up the energy balance over frames; what events change between two frames is nobody's work and left out.

    Args:
        dynamics: the equations of the simulation.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        self._dynamics = Dynamics(dynamics.model)
        self._sums = EnergyReport(total=0.0, work=0.0, wind=0.0, dissipated=0.0, residual=0.0, turned_over=0.0)

    def follow(self, integrator: Integrator, before: State, t: float, duration: float) -> EnergyReport:
        """Run one frame of length duration [s] from the state before it, which is used up, and report."""
        balance = EnergyBalance(self._dynamics, before, t)
        integrator.advance(self._dynamics, before, t, duration, balance)
        residual = balance.close(t + duration, before)
        sums = self._sums
        self._sums = EnergyReport(
            total=self._dynamics.energy(t + duration, before.x, before.v),
            work=sums.work + balance.work,
            wind=sums.wind + balance.wind,
            dissipated=sums.dissipated + balance.lost,
            residual=sums.residual + residual,
            turned_over=sums.turned_over + balance.turned_over,
        )
        return self._sums

    def stop(self, ended: State) -> EnergyReport:
        """Book what is lost by bringing the cloth to a stop, as dissipated, and report.

        Args:
            ended: the state that `follow` was given last: it stands at the frame's end.
        """
        masses = self._dynamics.model.masses
        kinetic = 0.5 * float(np.sum(masses * ended.v * ended.v))
        sums = self._sums
        self._sums = attrs.evolve(sums, total=sums.total - kinetic, dissipated=sums.dissipated + kinetic)
        return self._sums
