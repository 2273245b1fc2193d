# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Multirate rule: hinge forces are integrated with an m times larger step (r-RESPA).

Hinge forces are the most expensive and the slowest. Their impulses are a leapfrog with step m h around that of the
springs; the order stays 2 (Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990, 1992). Impulses may excite waves
whose phase advances by half a period or more between two impulses. Along springs the damping of such waves must exceed
this excitation. Across springs there is no damping, so no such waves may exist. Derivation: docs/time_stepping.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import root
from cloth_sim_ros.physics.remembered import Hinges
from cloth_sim_ros.physics.runs import Told

#: Largest ratio: a ninth of the cost of hinges remains.
MOST = 9
#: Minimum number of impulses in a run; with fewer of them the runs of a combination do not differ enough.
LEAST = 4
#: Fraction of the stability limit that impulses use.
_SHARE = 0.6


class HingeRule:
    """Multirate ratio of one advance.

    Args:
        plan: equations of motion.
        memory: state of the rule.
        allowed: False fixes the ratio to 1.
    """

    def __init__(self, plan: Plan, memory: Hinges, *, allowed: bool) -> None:
        self._plan, self.memory = plan, memory
        self._decay = plan.decay() if allowed and plan.bends else 0.0
        #: Multirate ratio m: steps per evaluation of hinges, an odd number.
        self.every = int(memory.every) if self._decay and memory.omega2 >= 0.0 else 1

    @property
    def told(self) -> Sequence[float]:
        """Bounds of squared frequency [1/s^2] and damping rate [1/s] of hinges, and of squared transverse frequency."""
        return self.memory.omega2, self.memory.damping, self.memory.across2

    @told.setter
    def told(self, bounds: Sequence[float]) -> None:
        self.memory.omega2, self.memory.damping, self.memory.across2 = bounds

    def keep(self, longest: float, duration: float) -> None:
        """Keep the ratio while it pays.

        Args:
            longest: longest stable step [s].
            duration: of the advance [s].
        """
        if self._decay and self._costs(self.every, longest, duration) > self._costs(1, longest, duration):
            self.every = 1

    def choose(self, x: Array, longest: float, duration: float, columns: int) -> None:
        """Choose the ratio of least cost for an advance with an error estimate.

        A refinement for accuracy keeps the ratio, so that the error decreases with its order. The error of impulses is
        m^2 times that of steps. It would cost further runs if more than one is combined, so the ratio is then 1, and
        for some estimates after that.

        Args:
            x: positions [m], shape (3, n).
            longest: longest stable step without impulses [s].
            duration: of the advance [s].
            columns: number of combined runs.
        """
        if not self._decay:
            return
        self.memory.since = 0.0 if columns > 1 else self.memory.since + 1.0
        if self.memory.since < CONSTANTS.wait:
            self.every = 1
        else:
            self.told = self._plan.bounds(x, hinges=True)[2:]
            self.every = min(range(1, MOST + 1, 2), key=lambda every: self._costs(every, longest, duration))

    def _costs(self, every: int, longest: float, duration: float) -> float:
        """Return the estimated cost of an advance by the longest steps; infinite if there would be too few impulses."""
        steps = steps_for(duration, longest / max(1.0, self.least(every, longest)))
        if every > 1 and steps < LEAST * every * steps_for(duration, CONSTANTS.part):
            return math.inf
        return self._plan.cost(every) * every * math.ceil(steps / every)

    def within(self, longest: float, duration: float) -> tuple[int, float]:
        """Return the ratio within an interval, and the refinement that it requires.

        Args:
            longest: longest stable step [s].
            duration: of the interval [s].
        """
        every, part = self.every, min(duration, CONSTANTS.part)
        while every > 1 and steps_for(part, longest / max(1.0, self.least(every, longest))) < LEAST * every:
            every -= 2
        return every, self.least(every, longest)

    def least(self, every: int, longest: float) -> float:
        """Return the refinement of the longest stable step [s] that a ratio requires."""
        return 1.0 if every == 1 else every * longest / self._reach(self.told, _SHARE)

    def exceed(self, length: float, told: Told) -> bool:
        """Return True, and set the ratio to 1, if the bounds at the end of a run make its impulses unstable.

        Args:
            length: interval between two impulses [s].
            told: summary of the run.
        """
        if length <= self._reach(told.hinges, 1.0):
            return False
        self.every = 1
        return True

    def _reach(self, bounds: Sequence[float], share: float) -> float:
        """Return the longest interval between two impulses [s] for bounds as `bounds` has, at a stability fraction."""
        omega2, damping, across2 = bounds
        if omega2 <= 0.0:
            return math.inf
        # Waves along springs with w = pi / interval: excited by omega2 / w, damped by min_damping_time w^2.
        along = math.pi * root(share * self._decay / omega2, 3)
        across = share * math.pi / math.sqrt(across2 + omega2)
        reach = min(share * leapfrog_limit(omega2, damping), along, across)
        if damping > 0.0:
            # Delayed damping forces excite such a wave too.
            reach = min(reach, math.pi * math.sqrt(share * self._decay / damping), 0.5 * share / damping)
        return reach
