# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Energy rule: bounds the energy that leapfrog steps create.

The leapfrog conserves E - h^2/8 v'Kv, for linear springs exactly, and not the physical energy E. E oscillates around
the conserved energy. Growth of the conserved energy is an instability: a spring that was compressed nearly to a point
turns faster than the step resolves. Smaller steps resolve it.

The oscillation is harmless while the step size is constant. A change of step size makes the current deviation of E
permanent. The first run may start with all fast waves in phase; therefore its oscillation is bounded too. So is that of
a run that tries longer steps than the previous ones.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import largest_component, weighted_dot
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import EnergyState
from cloth_sim_ros.physics.state.state import State

#: Relative rounding error of a sum of energies; rounding error of coordinates of a sheet at rest, in units of epsilon.
_ROUNDING, _COORDINATE_ROUNDINGS = 1e-12, 8.0

#: A time [s] and its state, with the friction anchors and jaws that contribute to the energy.
Moment = tuple[float, State]


class EnergyRule:
    """Rule that bounds the energy that the leapfrog steps of one advance create.

    Args:
        plan: equations of motion.
        memory: state of the rule.
        last_refinement: refinement of the previous advance if this one tries longer steps, else 0.
    """

    def __init__(self, plan: Plan, memory: EnergyState, last_refinement: float = 0.0) -> None:
        self._plan, self.memory, self._last_refinement = plan, memory, last_refinement
        self._is_first_run = memory.min_omega2 < 0.0

    def check(
        self,
        tableau: ExtrapolationTableau,
        start: State,
        n_runs: int,
        omega2: tuple[float, float],
        refinement: float,
        *,
        steps_differ: bool,
    ) -> tuple[bool, int]:
        """Return False if combined runs create energy, and evaluations spent; otherwise record their energy drift.

        A single run needs the check only at the start, and after a change of stiffness.

        Args:
            tableau: runs whose error is unknown.
            start: state at their start.
            n_runs: number of combined runs.
            omega2: bounds of the squared frequency at their start and at their end [1/s^2].
            refinement: refinement of their steps.
            steps_differ: True for a combination of runs, or if other pieces of the advance have other step sizes.
        """
        memory, evaluations = self.memory, 0
        min_omega2 = min(omega2) if memory.min_omega2 < 0.0 else min(memory.min_omega2, *omega2)
        # A start is a first run, or one with longer steps than the previous run.
        is_start = self._is_first_run or refinement < self._last_refinement
        if steps_differ or is_start or max(omega2) > CONSTANTS.energy_check_stiffening * min_omega2:
            end = start.shallow_copy()
            tableau.commit(n_runs, end)
            work, evaluations = _measure_external_work(self._plan, start, tableau, n_runs)
            # The energy of a combination does not oscillate; a change of step size makes the deviation permanent.
            step = 0.0 if steps_differ else tableau.duration / tableau.counts[0]
            moments = (tableau.t, start), (tableau.t + tableau.duration, end)
            energy_drift = self._measure_drift(*moments, step, work, is_start=is_start)
            if energy_drift is None:
                return False, evaluations
            memory.energy_drift, self._is_first_run, self._last_refinement = energy_drift, False, 0.0
        memory.min_omega2 = min_omega2
        return True, evaluations

    def _measure_drift(self, start: Moment, end: Moment, step: float, work: float, *, is_start: bool) -> float | None:
        """Return the energy drift [J], this run included; None if the run created too much energy or is not finite.

        Args:
            start: time and state at its start.
            end: time and state at its end.
            step: step size [s].
            work: external work over the run [J].
            is_start: True bounds the oscillation of the energy too.
        """
        conserved, energy, kinetic_energy = zip(self._energies(start, step), self._energies(end, step), strict=True)
        rise = conserved[1] - conserved[0] - work
        turnover = max(kinetic_energy) + abs(work)
        rounding_energy = _ROUNDING * abs(conserved[0]) + self._rounding_energy(end[1].x)
        energy_drift = max(0.0, self.memory.energy_drift + rise)
        max_drift = CONSTANTS.max_energy_gain * turnover + rounding_energy
        max_oscillation = CONSTANTS.max_energy_oscillation * turnover + rounding_energy
        if not np.isfinite(rise):
            return None
        if is_start and energy[1] - energy[0] - work > max_oscillation:
            return None
        return None if rise > 0.0 and energy_drift > max_drift else energy_drift

    def _rounding_energy(self, x: Array) -> float:
        """Return the energy [J] that rounding coordinates by e [m] causes in a sheet at rest: m w^2 e^2 / 2."""
        displacement = _COORDINATE_ROUNDINGS * float(np.finfo(np.float64).eps) * largest_component(x)
        omega2, _ = self._plan.spectral_bounds(x)
        return 0.5 * self._plan.model.mass * omega2 * displacement * displacement

    def _energies(self, moment: Moment, step: float) -> tuple[float, float, float]:
        """Return the energy that the leapfrog conserves, the physical energy and the kinetic energy [J]."""
        t, state = moment
        kinetic, potential = self._plan.energies(t, state.x, state.v, state.memory)
        return leapfrog_energy(self._plan, t, state, step), kinetic + potential, kinetic


def leapfrog_energy(plan: Plan, t: float, state: State, step: float) -> float:
    """Return the energy [J] that the leapfrog conserves at a step h [s]: E - h^2/8 v'Kv, by two evaluations.

    Args:
        plan: equations of motion.
        t: time [s].
        state: the state.
        step: step size [s].
    """
    x, v, memory = state.x, state.v, state.memory
    zeros, forward, backward = np.zeros_like(v), np.empty_like(v), np.empty_like(v)
    plan.accelerations(t, x + 0.5 * step * v, zeros, forward, memory)
    plan.accelerations(t, x - 0.5 * step * v, zeros, backward, memory)
    energy = plan.energy(t, x, v, memory)
    if plan.carries_air:
        unit_masses = np.ones_like(plan.model.masses)
        return energy + 0.125 * step * weighted_dot(unit_masses, plan.momenta(x, v), forward - backward)
    return energy + 0.125 * step * weighted_dot(plan.model.masses, v, forward - backward)


def _measure_external_work(plan: Plan, state: State, tableau: ExtrapolationTableau, n_runs: int) -> tuple[float, int]:
    """Return external work on the cloth [J] in a tableau's interval, and evaluations spent: runs may be repeated.

    Args:
        plan: equations of motion.
        state: at the start.
        tableau: runs.
        n_runs: K, the number of combined runs.
    """
    (x, v), t, memory = tableau.combine(n_runs), tableau.t, state.memory
    moving = plan.contact is not None and not plan.contact.force.steady()
    if not (moving or plan.external_power(t, state.x, state.v, memory) or plan.external_power(t, x, v, memory)):
        return tableau.work(n_runs), 0
    # Runs record the work of air and obstacles on demand alone.
    span, counts, ratio, single = tableau.duration, tableau.counts, tableau.ratio, tableau.single_precision
    recorded = ExtrapolationTableau(
        plan, state, t, span, counts, record_power=True, record_obstacles=moving, single_precision=single, ratio=ratio
    )
    return recorded.work(n_runs), recorded.evaluations
