# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How often hinges are asked for: they take most of a step and pull least, so one impulse may stand for m steps.

The impulses are a leapfrog of their own, with a step of m h about that of the springs, so the result stays of order 2
(Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990, 1992). Waves that swing through half a turn or more between two
impulses may be driven by them. Along springs such waves have to be damped by more than that; across them nothing damps,
so there must be no such waves. Derived in docs/time_stepping.md.
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

#: Most steps of an impulse: a ninth is left of what hinges take.
MOST = 9
#: Least impulses in a run: fewer of them could not tell runs apart.
LEAST = 4
#: Part of what stability allows that impulses take.
_SHARE = 0.6


class HingeRule:
    """Impulses of one advance.

    Args:
        plan: equations of motion.
        memory: what was known at the end of the last advance.
        allowed: whether one may stand for several steps at all.
    """

    def __init__(self, plan: Plan, memory: Hinges, *, allowed: bool) -> None:
        self._plan, self.memory = plan, memory
        self._decay = plan.decay() if allowed and plan.bends else 0.0
        #: Steps that an impulse stands for, an odd number.
        self.every = int(memory.every) if self._decay and memory.omega2 >= 0.0 else 1

    @property
    def told(self) -> Sequence[float]:
        """Bounds of squared frequency [1/s^2] and damping rate [1/s] of hinges, and of the first across springs."""
        return self.memory.omega2, self.memory.damping, self.memory.across2

    @told.setter
    def told(self, bounds: Sequence[float]) -> None:
        self.memory.omega2, self.memory.damping, self.memory.across2 = bounds

    def keep(self, longest: float, duration: float) -> None:
        """Keep them for an advance of a duration [s] where steps may be so long [s], while that pays."""
        if self._decay and self._costs(self.every, longest, duration) > self._costs(1, longest, duration):
            self.every = 1

    def choose(self, x: Array, longest: float, duration: float, columns: int) -> None:
        """Choose them anew for an advance that is judged: what costs least where the error asks for nothing. Steps that
        get shorter for its sake keep them, so that it falls as its order says.

        Args:
            x: positions [m].
            longest: stable step without [s].
            duration: of the advance [s].
            columns: runs that the error asks for. Where it wants more than the second order, the error of impulses,
                m squared times that of steps, would cost more runs and shorter steps; so it does for a while after.
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
        """Estimated cost of an advance by the longest steps; infinite where impulses would be too few."""
        steps = steps_for(duration, longest / max(1.0, self.least(every, longest)))
        if every > 1 and steps < LEAST * every * steps_for(duration, CONSTANTS.part):
            return math.inf
        return self._plan.cost(every) * every * math.ceil(steps / every)

    def within(self, longest: float, duration: float) -> tuple[int, float]:
        """Return the steps that an impulse stands for in a stretch of a duration [s], where steps may be so long [s],
        and how much finer these must be.
        """
        every, part = self.every, min(duration, CONSTANTS.part)
        while every > 1 and steps_for(part, longest / max(1.0, self.least(every, longest))) < LEAST * every:
            every -= 2
        return every, self.least(every, longest)

    def least(self, every: int, longest: float) -> float:
        """Return how much finer than the longest [s] steps must be where an impulse stands for so many."""
        return 1.0 if every == 1 else every * longest / self._reach(self.told, _SHARE)

    def exceed(self, length: float, told: Told) -> bool:
        """Whether impulses so far apart [s] were unstable by what was told afterwards; then each step has its own."""
        if length <= self._reach(told.hinges, 1.0):
            return False
        self.every = 1
        return True

    def _reach(self, bounds: Sequence[float], share: float) -> float:
        """Return how far apart impulses may be [s] with such bounds as `told` has, by a share of what is stable."""
        omega2, damping, across2 = bounds
        if omega2 <= 0.0:
            return math.inf
        # Waves of w = pi over that, along springs: driven by omega2 / w, damped by decay w^2.
        along = math.pi * root(share * self._decay / omega2, 3)
        across = share * math.pi / math.sqrt(across2 + omega2)
        reach = min(share * leapfrog_limit(omega2, damping), along, across)
        if damping > 0.0:
            # Damping that sees such a wave in another phase than it is in drives it as well.
            reach = min(reach, math.pi * math.sqrt(share * self._decay / damping), 0.5 * share / damping)
        return reach
