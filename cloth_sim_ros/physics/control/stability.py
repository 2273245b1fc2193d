# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rule of stability: how long steps may be, and in how many parts a frame is extrapolated.

The leapfrog's limit follows from bounds of stiffness and damping. A combination of runs keeps it where damping takes
fast waves out over a frame. Where nothing does, runs of different steps part too far over many steps for their
combination: then a frame is cut into parts of a few steps, and steps are shorter, by the stability function of the
combination (docs/time_stepping.md).
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.forces.force import Force
from cloth_sim_ros.physics.integrators.columns import RATIOS
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import Stability
from cloth_sim_ros.physics.state import State

#: Most runs that are combined; one more judges them.
MOST_COLUMNS = len(RATIOS) - 1
#: Steps of a part, and the part of the leapfrog's limit at which combinations of 1 to 4 runs of four to six steps let
#: no undamped wave grow by more than 1e-5 a step: from the eigenvalues of their stability function. In frames of fewer
#: steps waves may grow by up to 3e-3 a step of three runs; there the error's estimate sees them.
UNDAMPED_STEPS = 6
UNDAMPED_SHARES = (1.0, 0.125, 0.75, 0.25)


def _damps(force: Force) -> bool:
    """Whether a force damps waves: grips and contact damp what they touch alone, air all waves a little."""
    return force.damped and force.damps_waves


class StabilityRule:
    """Steps of one advance.

    Args:
        plan: equations of motion.
        memory: what was known at the end of the last advance.
        state: at the start.
        duration: of the advance [s].
    """

    def __init__(self, plan: Plan, memory: Stability, state: State, duration: float) -> None:
        self._plan, self.memory = plan, memory
        if memory.omega2 < 0.0:
            memory.omega2, memory.damping = plan.rates(state.x)
        #: Highest angular frequency at the start [1/s].
        self.omega = math.sqrt(memory.omega2)
        #: How much finer impulses of hinges ask steps to be.
        self.impulses = 1.0
        self.damped = memory.omega2 == 0.0 or (
            memory.damping * duration >= CONSTANTS.damped and any(map(_damps, plan.model.forces))
        )

    def least(self, columns: int) -> float:
        """Return how much finer than stability asks of one run the steps of a combination must be, at least."""
        return 1.0 if self.damped else 1.0 / UNDAMPED_SHARES[columns - 1]

    def asks(self, columns: int) -> float:
        """Return the same, impulses of hinges included: the error may come to ask for others."""
        return max(self.impulses, self.least(columns))

    def parts(self, columns: int, steps: int, duration: float) -> int:
        """Return into how many parts a frame is cut whose first run takes so many steps."""
        parts = steps_for(duration, CONSTANTS.part)
        if columns == 1 or self.damped:
            return parts
        return max(parts, math.ceil(steps / UNDAMPED_STEPS))
