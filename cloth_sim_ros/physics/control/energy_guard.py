# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Energy that a run of fixed leapfrog steps makes, beside what the leapfrog's own energy does.

The leapfrog does not keep the energy E of its positions and velocities but, for linear springs exactly, E - h^2/8 v'Kv:
E swings by that with the motion and comes back. What makes this energy grow is an instability: a spring that was
pushed nearly to a point within the run turned faster than the step follows. Smaller steps follow it.

The swing itself is harmless while the step stays. Where it changes, E goes on from where the swing has brought it, for
good. So the first run, which may begin with all fast waves at once and in step, may not swing far either.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.arrays import weighted_dot
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import Plan

#: Energy that may be made in all, relative to the kinetic energy, and to all energy (rounding).
_SHARE, _ROUNDING = 2e-3, 1e-12
#: The same of what E itself rises by over a run that begins.
_SWING = 5e-3
#: Coordinates of a sheet at rest are off by so many roundings, and its springs stretched by them.
_ROUNDINGS = 8.0


class EnergyGuard:
    """Judges runs that start from one state.

    Args:
        plan: equations of motion.
        t: time at the start [s].
        x: positions at the start (3, n) [m]; kept, so nobody may write into them.
        v: velocities at the start (3, n) [m/s]; likewise.
    """

    def __init__(self, plan: Plan, t: float, x: Array, v: Array) -> None:
        self._plan, self._t, self._x, self._v = plan, t, x, v

    def made(
        self, t: float, x: Array, v: Array, step: float, before: float, *, work: float, begins: bool
    ) -> tuple[float, bool]:
        """Book a run with steps of this length [s] that ended at t, x, v.

        Args:
            t: time at its end [s].
            x: positions at its end (3, n) [m].
            v: velocities at its end (3, n) [m/s].
            step: length of its steps [s].
            before: energy that earlier runs made [J].
            work: done by grippers over the run [J].
            begins: whether no run was before it.

        Returns:
            Energy that is made by now [J], and whether the run made more than may be; nothing where air moves, whose
            work is not known.
        """
        if self._plan.supply(self._t, self._x, self._v) or self._plan.supply(t, x, v):
            return before, False
        start = own_energy(self._plan, self._t, self._x, self._v, step)
        rise = own_energy(self._plan, t, x, v, step) - start - work
        moved = max(self._kinetic(self._v), self._kinetic(v)) + abs(work)
        little = _ROUNDING * abs(start) + self._noise(x)
        most = _SHARE * moved + little
        made = max(0.0, before + rise)
        if not np.isfinite(rise):
            return before, True
        if begins:
            swing = self._plan.energy(t, x, v) - self._plan.energy(self._t, self._x, self._v) - work
            if swing > _SWING * moved + little:
                return min(made, most), True
        return min(made, most), rise > 0.0 and made > most

    def _noise(self, x: Array) -> float:
        """Energy [J] of a sheet at rest that rounding of its coordinates leaves: w^2 / 2 times their squares."""
        place = _ROUNDINGS * float(np.finfo(np.float64).eps) * max(float(x.max()), -float(x.min()))
        omega2, _ = self._plan.rates(x)
        return 0.5 * self._plan.model.mass * omega2 * place * place

    def _kinetic(self, v: Array) -> float:
        return self._plan.energies(self._t, self._x, v)[0]


def own_energy(plan: Plan, t: float, x: Array, v: Array, step: float) -> float:
    """Return the leapfrog's own energy [J] at steps of a length [s]; v'Kv by the forces half a step ahead and back."""
    still, ahead, back = np.zeros_like(v), np.empty_like(v), np.empty_like(v)
    plan.accelerations(t, x + 0.5 * step * v, still, ahead)
    plan.accelerations(t, x - 0.5 * step * v, still, back)
    return plan.energy(t, x, v) + 0.125 * step * weighted_dot(plan.model.masses, v, ahead - back)
