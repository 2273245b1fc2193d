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

from cloth_sim_ros.physics.arrays import weighted_dot
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.columns import Columns
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Energy
from cloth_sim_ros.physics.state import State

#: Relative rounding error of a sum of energies; rounding error of coordinates of a sheet at rest, in units of epsilon.
_ROUNDING, _ROUNDINGS = 1e-12, 8.0

#: A time [s] and its state, with the friction anchors and jaws that contribute to the energy.
Moment = tuple[float, State]


class EnergyRule:
    """Energy check of the runs of one advance.

    Args:
        plan: equations of motion.
        memory: state of the rule.
        settled: refinement of the previous advance if this one tries longer steps, else 0.
    """

    def __init__(self, plan: Plan, memory: Energy, settled: float = 0.0) -> None:
        self._plan, self.memory, self._settled = plan, memory, settled
        self._begins = memory.softest < 0.0

    def looks(self, before: float, after: float, *, varied: bool, refine: float) -> bool:
        """Return True if the energy of a run with unknown error must be checked.

        A single run needs the check only at the start, and after a change of stiffness.

        Args:
            before: bound of the squared frequency at its start [1/s^2].
            after: the same at its end.
            varied: True for a combination of runs, or if other intervals of the advance have other step sizes.
            refine: refinement of its steps.
        """
        memory = self.memory
        least, most = min(before, after), max(before, after)
        memory.softest = least if memory.softest < 0.0 else min(memory.softest, least)
        stiffened = most > CONSTANTS.stiffened * memory.softest
        return varied or self._starts(refine) or stiffened

    def exceeds(self, start: Moment, end: Moment, step: float, work: float, *, refine: float) -> bool:
        """Add the energy that a run created to the drift; return True if it exceeds the limit.

        Args:
            start: time and state at its start.
            end: time and state at its end.
            step: step size [s].
            work: external work over the run [J].
            refine: refinement of its steps.
        """
        memory = self.memory
        before = self._own(start, step)
        rise = self._own(end, step) - before - work
        moved = max(self._kinetic(start), self._kinetic(end)) + abs(work)
        little = _ROUNDING * abs(before) + self._noise(end[1].x)
        made, most = max(0.0, memory.made + rise), CONSTANTS.gain * moved + little
        if not np.isfinite(rise):
            return True
        if self._starts(refine) and self._energy(end) - self._energy(start) - work > CONSTANTS.swing * moved + little:
            return True
        if rise > 0.0 and made > most:
            return True
        memory.made, self._begins, self._settled = made, False, 0.0
        return False

    def _starts(self, refine: float) -> bool:
        """True for a first run, and for one with longer steps than the previous run."""
        return self._begins or refine < self._settled

    def _noise(self, x: Array) -> float:
        """Return the energy [J] that rounding of coordinates causes in a sheet at rest: m w^2 / 2 times its square."""
        place = _ROUNDINGS * float(np.finfo(np.float64).eps) * max(float(x.max()), -float(x.min()))
        omega2, _ = self._plan.rates(x)
        return 0.5 * self._plan.model.mass * omega2 * place * place

    def _kinetic(self, moment: Moment) -> float:
        t, state = moment
        return self._plan.energies(t, state.x, state.v)[0]

    def _own(self, moment: Moment, step: float) -> float:
        t, state = moment
        self._lay(state)
        return own_energy(self._plan, t, state.x, state.v, step)

    def _energy(self, moment: Moment) -> float:
        t, state = moment
        self._lay(state)
        return self._plan.energy(t, state.x, state.v)

    def _lay(self, state: State) -> None:
        if self._plan.contact is not None:
            self._plan.contact.take(state)


def own_energy(plan: Plan, t: float, x: Array, v: Array, step: float) -> float:
    """Return the energy that the leapfrog conserves at a step size [J]; half steps forward and back give v'Kv.

    Args:
        plan: equations of motion.
        t: time [s].
        x: positions [m], shape (3, n).
        v: velocities [m/s], shape (3, n).
        step: step size [s].
    """
    still, ahead, back = np.zeros_like(v), np.empty_like(v), np.empty_like(v)
    plan.accelerations(t, x + 0.5 * step * v, still, ahead)
    plan.accelerations(t, x - 0.5 * step * v, still, back)
    return plan.energy(t, x, v) + 0.125 * step * weighted_dot(plan.model.masses, v, ahead - back)


def put_in(plan: Plan, state: State, columns: Columns, t: float, count: int) -> tuple[float, int]:
    """Return the external work over T_K [J], and the force evaluations of its computation.

    Args:
        plan: equations of motion.
        state: at the start.
        columns: runs.
        t: time at the start [s].
        count: K, the number of combined runs.
    """
    x, v = columns.combine(count)
    moved = plan.contact is not None and not plan.contact.force.steady()
    if not (moved or plan.supply(t, state.x, state.v) or plan.supply(t, x, v)):
        return columns.work(count), 0
    # Runs record the work of air and obstacles on demand alone.
    narrow, every = columns.narrow, columns.every
    noted = Columns(
        plan, state, t, columns.duration, columns.counts, powers=True, touches=moved, narrow=narrow, every=every
    )
    return noted.work(count), noted.evaluations
