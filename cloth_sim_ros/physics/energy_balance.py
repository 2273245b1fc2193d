# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The energy balance of a run: what was put in, what was lost, and what is there."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.base import Observer
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array
from cloth_sim_ros.physics.terms.grips import Grips


class EnergyBalance(Observer):
    """Integrates dissipation, and the work of grippers and wind, over advances.

    residual = E - E at the start - work - wind + lost.

    Args:
        dynamics: equations of motion.
        state: the start.
        t: time at the start [s].
    """

    def __init__(self, dynamics: Dynamics, state: State, t: float = 0.0) -> None:
        self._dynamics = dynamics
        self._grips = [term for term in dynamics.model.terms if isinstance(term, Grips)]
        self._scratch = np.zeros_like(state.x)
        self._start = dynamics.energy(t, state.x, state.v)
        self._still = np.zeros_like(state.v)
        #: Dissipated so far [J].
        self.lost = 0.0
        #: Done on the cloth by grippers so far [J].
        self.work = 0.0
        #: Done on the cloth by moving air so far [J].
        self.wind = 0.0
        self._pending = [0.0, 0.0, 0.0]
        #: Energy that went from one form into another so far, at least [J].
        self.turned_over = 0.0
        self._kinetic = self._start - dynamics.energy(t, state.x, self._still)

    def restart(self) -> None:
        self._pending = [0.0, 0.0, 0.0]

    def observe(self, t: float, x: Array, v: Array, weight: float) -> None:
        self._pending[0] += weight * self._dynamics.dissipation(t, x, v)
        self._pending[2] += weight * self._dynamics.supply(t, x, v)
        for grips in self._grips:
            grips.add_force(t, x, v, self._scratch)
            self._pending[1] += weight * float(grips.wrenches[:, 6].sum())

    def close(self, t: float, state: State) -> float:
        """Book an advance that ended at time t; return the residual [J] so far."""
        lost, work, wind = self._pending
        self.lost += lost
        self.work += work
        self.wind += wind
        self.restart()
        energy = self._dynamics.energy(t, state.x, state.v)
        kinetic = energy - self._dynamics.energy(t, state.x, self._still)
        self.turned_over += abs(kinetic - self._kinetic) + abs(lost) + abs(work) + abs(wind)
        self._kinetic = kinetic
        return energy - self._start - self.work - self.wind + self.lost
