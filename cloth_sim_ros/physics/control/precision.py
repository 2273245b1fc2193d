# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where runs calculate in single precision: where it was measured what that changes, and the budget has room for it."""

from __future__ import annotations

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.control.choice import Choice
from cloth_sim_ros.physics.integrators.columns import amplification
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Precision
from cloth_sim_ros.physics.state import State

#: Spacing of single precision's numbers: a stretch changes no less than a few tenths of it, relative to the sheet.
_SPACING = 2.0**-24


class PrecisionRule:
    """The choice of one advance.

    Args:
        plan: equations of motion.
        memory: what was measured.
        duration: of the advance [s].
        budget: error that it may have [m].
    """

    def __init__(self, plan: Plan, memory: Precision, duration: float, budget: float) -> None:
        self._plan, self.memory, self._duration = plan, memory, duration
        #: Attempts that missed the budget: from the second on it may be rounding, which finer steps do not mend.
        self.missed = 0
        self._room = CONSTANTS.rounding * budget
        #: What an estimate of the error may be off by [m]: it tells whether an error is far below the budget all the
        #: same, for what was measured is counted `trust` times.
        self._blur = CONSTANTS.trust * CONSTANTS.far * budget

    def measure(self, t: float, state: State, step: float, choice: Choice) -> int:
        """Measure what single precision changes over steps of a length [s], where that is not known and might fit;
        return the force evaluations that it took.
        """
        memory = self.memory
        if memory.rounding >= 0.0 or choice.columns > 1 or not self._plan.narrows(self._duration, state.x, state.v):
            return 0
        extent = float((state.x.max(axis=1) - state.x.min(axis=1)).max())
        if _SPACING * extent > self._room:
            return 0
        # A part of the steps stands for all of them: positions carry what rounding takes, and what is left is a last
        # bit of the sheet's extent, whatever the number of steps.
        steps = max(1, int(steps_for(self._duration, step) // CONSTANTS.sample))
        ends = [
            self._plan.runs(t, steps * step, (state.x, state.v), [steps], narrow=narrow)[0][0].x
            for narrow in (False, True)
        ]
        # It is measured once.
        memory.rounding = CONSTANTS.trust * largest_distance(*ends)
        return 2 * (steps + 1)

    def narrows(self, state: State, choice: Choice) -> bool:
        """Whether the runs of a choice from a state take it: what comes to rest has to find its place, so the motion
        must be large against what their combination makes of it.
        """
        rounding = amplification(choice.columns) * self.memory.rounding
        # A judgement looks at one combination more.
        if self.missed > 1 or not (0.0 <= rounding <= self._room and self.tells(choice.columns + choice.judge)):
            return False
        v, least = state.v, CONSTANTS.motion * rounding
        # The last particle is looked at first: where the sheet moves it mostly does.
        if max(map(abs, v[:, -1].tolist())) * self._duration > least:
            return True
        return float(v.max()) * self._duration > least or -float(v.min()) * self._duration > least

    def tells(self, columns: int) -> bool:
        """Whether a combination of so many such runs still tells what the error is. It is no result, so rounding need
        not be small against it, only against the budget.
        """
        return amplification(columns) * self.memory.rounding <= self._blur
