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

from cloth_sim_ros.physics.constants import CONSTANTS
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
        self._decay = plan.decay() if allowed and plan.bends and memory.omega2 >= 0.0 else 0.0
        #: Steps that an impulse stands for, an odd number.
        self.every = int(memory.every) if self._decay else 1

    @property
    def told(self) -> tuple[float, float, float]:
        """Bounds of squared frequency [1/s^2] and damping rate [1/s] of hinges, and of the first across springs."""
        return self.memory.omega2, self.memory.damping, self.memory.across2

    @told.setter
    def told(self, bounds: tuple[float, float, float]) -> None:
        self.memory.omega2, self.memory.damping, self.memory.across2 = bounds

    def choose(self, longest: float, duration: float, *, anew: bool) -> None:
        """Choose them for an advance: what costs least where the error asks for nothing. Where it asks for shorter
        steps they stay, so that it falls as its order says.

        Args:
            longest: stable step without [s].
            duration: of the advance [s].
            anew: whether they may become more; else they stay while that pays.
        """
        if not self._decay:
            return

        def cost(every: int) -> float:
            steps = duration / longest * max(1.0, self.least(every, longest))
            return self._plan.cost(every) * every * math.ceil(steps / every)

        if anew or cost(self.every) > cost(1):
            self.every = min(range(1, MOST + 1, 2), key=cost)

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

    def _reach(self, bounds: tuple[float, float, float], share: float) -> float:
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
