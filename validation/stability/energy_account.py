# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Energy account of a simulation, and its spurious energy gain."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros import Simulation
from cloth_sim_ros.physics.control.energy import leapfrog_energy


class EnergyAccount:
    """Energy account from the current state on.

    Args:
        simulation: the simulation, which is advanced elsewhere.
        turned_over: energy that counts as turned over at the start [J]; gains are relative to it and later changes.
    """

    def __init__(self, simulation: Simulation, turned_over: float) -> None:
        self._simulation = simulation
        self._kinetic = kinetic_energy(simulation)
        self._start = simulation.energy()
        self._min_energy = self._min_modified_energy = self._start
        self._external_work = 0.0
        self._energy_turned_over = turned_over
        #: Largest rise of the energy, less external work, above its value at the end of any earlier frame, relative to
        #: the energy turned over.
        self.gain = 0.0

    def close(self, work: float = 0.0, step: float | None = None) -> None:
        """Account for a frame.

        With a fixed step the leapfrog conserves the modified energy E - h^2/8 v'Kv, and E itself oscillates about it.
        When the step changes, E stays and the modified energy jumps. An energy gain is real only if both show it.

        Args:
            work: external work over the frame [J].
            step: length of fixed leapfrog steps [s]; None for any other stepping.
        """
        self._external_work += work
        simulation = self._simulation
        energy = modified_energy = simulation.energy()
        if step is not None:
            modified_energy = leapfrog_energy(simulation.plan, simulation.time, simulation.state, step)
        energy, modified_energy = energy - self._external_work, modified_energy - self._external_work
        kinetic = kinetic_energy(simulation)
        self._energy_turned_over += abs(kinetic - self._kinetic) + abs(work)
        self._energy_turned_over = max(self._energy_turned_over, self._start - energy)
        self._kinetic = kinetic
        gain = min(energy - self._min_energy, modified_energy - self._min_modified_energy)
        self.gain = max(self.gain, gain / self._energy_turned_over)
        self._min_energy = min(self._min_energy, energy)
        self._min_modified_energy = min(self._min_modified_energy, modified_energy)


def kinetic_energy(simulation: Simulation) -> float:
    """Return the kinetic energy of a simulation's cloth [J]."""
    v = simulation.state.v
    return 0.5 * float(np.sum(simulation.model.masses * v * v))
