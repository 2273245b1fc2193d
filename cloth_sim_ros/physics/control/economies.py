# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the single runs of a loose tolerance save on: single precision, and weak springs at every second step.

Both are taken only where it was measured what they change, and where the budget has room for it. Single precision
rounds alike whatever the motion does; leaving out weak springs costs an error that grows with the motion, of first
order in the step where they are damped, so each judgement measures it anew.
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.control.control import (
    ALTERNATE_LEAST,
    ALTERNATE_SHARE,
    FAR,
    LIVELIER,
    LONGEST_WAIT,
    NARROW_LEAST,
    NARROW_MOTION,
    NARROW_SHARE,
    ROUNDING,
    ROUNDING_MARGIN,
    ROUNDING_PART,
    Memory,
)
from cloth_sim_ros.physics.control.economy import Economy
from cloth_sim_ros.physics.integrators.fixed import SAFETY, steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.powers import power
from cloth_sim_ros.physics.state import State


class Economies:
    """The choice of one advance.

    Args:
        plan: equations of motion.
        memory: what was measured, and is to be remembered.
        stretch: length of a stretch [s].
        budget: error that it may have [m].
    """

    def __init__(self, plan: Plan, memory: Memory, stretch: float, budget: float) -> None:
        self._plan, self._memory, self._stretch, self._budget = plan, memory, stretch, budget

    def of(self, state: State) -> Economy:
        """Return what a single run from this state saves on."""
        return Economy(self._narrows(state, 1.0), self._alternates())

    def of_combined(self, state: State, amplified: float) -> Economy:
        """Return what runs from this state save on whose combination amplifies rounding by a factor."""
        return Economy(narrow=self._narrows(state, amplified))

    def share(self, economy: Economy, otherwise: float) -> float:
        """Return the share of the step limit that runs take, `otherwise` where they save on no springs."""
        return min(otherwise, self._plan.alternate_share) if economy.alternate else otherwise

    def estimate(self, economy: Economy, activity: float) -> float:
        """Return the error [m] of a run that was not judged, from the last judgement; `activity` [m/s] says how violent
        it was.
        """
        memory = self._memory
        livelier = max(1.0, activity / memory.activity) if memory.activity else math.inf
        if economy.alternate:
            return memory.alternating * livelier
        error = max(memory.error, ROUNDING) * power(livelier, LIVELIER)
        return error + (memory.rounding if economy.narrow else 0.0)

    def prepare(self, t: float, state: State, limit: float) -> None:
        """Before a judgement, find out about what is not known yet: measure what rounding does, over the first of the
        steps from this state at time t [s], and let weak springs be left out, for the judgement to see.

        What single precision changes does not grow with the number of steps: positions carry what rounding takes, and
        what is left is a last bit of the sheet's extent.
        """
        memory, plan = self._memory, self._plan
        if memory.columns > 1:
            return
        extent = _extent(state)
        if memory.rounding < 0.0 and NARROW_LEAST * extent <= NARROW_SHARE * self._budget and plan.narrows():
            memory.rounding = ROUNDING_MARGIN * self._rounding(t, state, SAFETY * limit)
        waited = memory.alternating < 0.0 or memory.interval >= LONGEST_WAIT
        if waited and not self._alternates() and self._may_alternate(extent):
            memory.alternating = 0.0

    def _narrows(self, state: State, amplified: float) -> bool:
        """Whether single precision is taken: it was measured what rounding does, and the motion is large against that:
        what comes to rest has to find its place.
        """
        rounding = amplified * self._memory.rounding
        if not 0.0 <= rounding <= NARROW_SHARE * self._budget:
            return False
        fastest = max(float(state.v.max()), -float(state.v.min()))
        return fastest * self._stretch > NARROW_MOTION * rounding

    def _alternates(self) -> bool:
        memory = self._memory
        fits = 0.0 <= memory.alternating <= ALTERNATE_SHARE * self._budget and memory.refine == 1.0
        return fits and memory.omega2 <= memory.stiffest

    def _may_alternate(self, extent: float) -> bool:
        """Whether leaving out weak springs comes into question: it is not tried where it can't fit the budget."""
        memory, plan = self._memory, self._plan
        far = memory.refine == 1.0 and memory.error <= FAR * self._budget
        fits = ALTERNATE_LEAST * extent <= ALTERNATE_SHARE * self._budget
        if not far or not fits or plan.alternate_share == 0.0:
            return False
        if memory.stiffest < 0.0:
            memory.stiffest = plan.alternate_stiffest()
        return memory.omega2 <= memory.stiffest

    def _rounding(self, t: float, state: State, step: float) -> float:
        """Largest distance of a particle [m] after a part of a stretch in single precision from the same in double."""
        steps = max(1, steps_for(self._stretch, step) // ROUNDING_PART)
        ends = [
            self._plan.runs(t, steps * step, (state.x, state.v), [steps], narrow=narrow)[0][0].x
            for narrow in (False, True)
        ]
        return largest_distance(*ends)


def _extent(state: State) -> float:
    """Longest edge of the box around the sheet [m]."""
    x = state.x
    return float((x.max(axis=1) - x.min(axis=1)).max())
