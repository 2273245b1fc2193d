# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stability rule: step limit, and number of parts in which a frame is extrapolated.

The leapfrog's limit follows from bounds of stiffness and damping. A combination of runs has the same limit if damping
removes fast waves within a frame. Without such damping, runs with different steps diverge too far over many steps. Then
a frame is divided into parts of a few steps, and the stability function of the combination shortens the steps
(docs/step_control.md).
"""

from __future__ import annotations

import math

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIOS
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import StabilityState
from cloth_sim_ros.physics.state.state import State

#: Maximum number of combined runs; one further run estimates their error.
MAX_COMBINED_RUNS = len(RATIOS) - 1
#: Maximum steps of an undamped part, and fractions of the leapfrog's limit for combinations of 1 to 4 runs. With four
#: to six steps no undamped wave grows by more than 1e-5 per step (eigenvalues of the stability function). In frames of
#: fewer steps waves may grow by up to 3e-3 per step with three runs; there the error estimate detects them.
MAX_UNDAMPED_STEPS = 6
UNDAMPED_LIMIT_FRACTIONS = (1.0, 0.125, 0.75, 0.25)


def _damps_waves(force: Force) -> bool:
    """Return True if a force damps all waves strongly; grips and contact act locally, and air damps weakly."""
    return force.damped and force.damps_waves


class StabilityRule:
    """Step limits of one advance.

    Args:
        plan: equations of motion.
        memory: state of the rule.
        state: at the start.
        duration: of the advance [s].
    """

    def __init__(self, plan: Plan, memory: StabilityState, state: State, duration: float) -> None:
        self._plan, self.memory = plan, memory
        if memory.omega2 < 0.0:
            memory.omega2, memory.damping = plan.spectral_bounds(state.x)
        #: Highest angular frequency at the start [1/s].
        self.omega = math.sqrt(memory.omega2)
        #: Refinement that the multirate ratio requires.
        self.multirate_refinement = 1.0
        decays = memory.damping * duration >= CONSTANTS.damped_wave_decay
        self.is_damped = memory.omega2 == 0.0 or (decays and any(map(_damps_waves, plan.model.forces)))

    def min_refinement(self, n_runs: int) -> float:
        """Return the minimum refinement of a combination relative to the stable step of one run."""
        return 1.0 if self.is_damped else 1.0 / UNDAMPED_LIMIT_FRACTIONS[n_runs - 1]

    def required_refinement(self, n_runs: int) -> float:
        """Return the minimum refinement, that of the multirate ratio included."""
        return max(self.multirate_refinement, self.min_refinement(n_runs))

    def n_parts(self, n_runs: int, steps: int, duration: float) -> int:
        """Return the number of parts of a frame.

        Args:
            n_runs: number of combined runs.
            steps: steps of the first run.
            duration: of the frame [s].
        """
        n_parts = steps_for(duration, CONSTANTS.max_interval)
        if n_runs == 1 or self.is_damped:
            return n_parts
        return max(n_parts, math.ceil(steps / MAX_UNDAMPED_STEPS))
