# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rule of the energy: what a run of leapfrog steps makes of it, beside what the leapfrog's own energy does.

The leapfrog does not keep the energy E of its positions and velocities but, for linear springs exactly, E - h^2/8 v'Kv:
E swings by that with the motion and comes back. What makes this energy grow is an instability: a spring that was
pushed nearly to a point within the run turned faster than the step follows. Smaller steps follow it.

The swing itself is harmless while the step stays. Where it changes, E goes on from where the swing has brought it, for
good. So the first run, which may begin with all fast waves at once and in step, may not swing far either; nor may one
that tries longer steps than those before.
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

#: Rounding of a sum of energies, relative to it; coordinates of a sheet at rest are off by so many roundings.
_ROUNDING, _ROUNDINGS = 1e-12, 8.0

#: A time [s] and the state then: what contact remembers, anchors and pads, is part of its energy.
Moment = tuple[float, State]


class EnergyRule:
    """Judges the runs of one advance.

    Args:
        plan: equations of motion.
        memory: of the rule.
        settled: refinement of the steps of the advance before, where longer ones may be tried.
    """

    def __init__(self, plan: Plan, memory: Energy, settled: float = 0.0) -> None:
        self._plan, self.memory, self._settled = plan, memory, settled
        self._begins = memory.softest < 0.0

    def looks(self, before: float, after: float, *, varied: bool, refine: float) -> bool:
        """Whether the energy of a run whose error is unknown is looked at: a single run's only where it begins, and
        where stiffness changed or may have.

        Args:
            before: bound of the squared frequency at its start [1/s^2].
            after: the same at its end.
            varied: whether it is a combination of runs, or other stretches of the advance take other steps.
            refine: refinement of its steps.
        """
        memory = self.memory
        least, most = min(before, after), max(before, after)
        memory.softest = least if memory.softest < 0.0 else min(memory.softest, least)
        stiffened = most > CONSTANTS.stiffened * memory.softest
        return varied or self._starts(refine) or stiffened

    def exceeds(self, start: Moment, end: Moment, step: float, work: float, *, refine: float) -> bool:
        """Book a run with steps of a length [s]; return whether it made more energy than it may.

        Args:
            start: where it began.
            end: where it ended.
            step: length of its steps [s].
            work: done by grippers and moving air over the run [J].
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
        """Whether a run is a first one, as one is whose steps are longer than those before."""
        return self._begins or refine < self._settled

    def _noise(self, x: Array) -> float:
        """Energy [J] of a sheet at rest that rounding of its coordinates leaves: w^2 / 2 times their squares."""
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
    """Return the leapfrog's own energy [J] at steps of a length [s]; v'Kv by the forces half a step ahead and back."""
    still, ahead, back = np.zeros_like(v), np.empty_like(v), np.empty_like(v)
    plan.accelerations(t, x + 0.5 * step * v, still, ahead)
    plan.accelerations(t, x - 0.5 * step * v, still, back)
    return plan.energy(t, x, v) + 0.125 * step * weighted_dot(plan.model.masses, v, ahead - back)


def put_in(plan: Plan, state: State, columns: Columns, t: float, count: int) -> tuple[float, int]:
    """Return the work [J] that grippers, obstacles and moving air did over T_K, K = count, from a state at t [s] on,
    and the force evaluations that it took to tell.
    """
    x, v = columns.combine(count)
    moved = plan.contact is not None and not plan.contact.force.steady()
    if not (moved or plan.supply(t, state.x, state.v) or plan.supply(t, x, v)):
        return columns.work(count), 0
    # The work of air and of obstacles is noted on demand alone.
    narrow, every = columns.narrow, columns.every
    noted = Columns(
        plan, state, t, columns.duration, columns.counts, powers=True, touches=moved, narrow=narrow, every=every
    )
    return noted.work(count), noted.evaluations
