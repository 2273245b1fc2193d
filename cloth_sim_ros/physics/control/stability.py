# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stability rule: refinement of steps, and number of pieces, that combinations of runs require.

The leapfrog's limit follows from bounds of stiffness and damping. A combination of runs has the same limit if damping
removes fast waves within a piece. Without such damping, runs with different steps diverge too far over many steps. Then
a piece has few steps, and the stability function of the combination shortens them (docs/step_control.md).
"""

from __future__ import annotations

import math
from functools import cached_property

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.extrapolation_tableau import RATIOS
from cloth_sim_ros.physics.integrators.limit import steps_for
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import StabilityState

#: Maximum number of combined runs; one further run estimates their error.
MAX_COMBINED_RUNS = len(RATIOS) - 1
#: Maximum steps of an undamped piece, and fractions of the leapfrog's limit for combinations of 1 to 4 runs. With four
#: to six steps no undamped wave grows by more than 1e-5 per step (eigenvalues of the stability function). In frames of
#: fewer steps waves may grow by up to 3e-3 per step with three runs; there the error estimate detects them.
MAX_UNDAMPED_STEPS = 6
UNDAMPED_LIMIT_FRACTIONS = (1.0, 0.125, 0.75, 0.25)


class StabilityRule:
    """Rule for the refinement and the number of pieces that stable combinations of runs require.

    Args:
        plan: equations of motion.
        memory: spectral bounds; those of the state if they are unknown.
        x: positions [m], shape (3, n).
    """

    def __init__(self, plan: Plan, memory: StabilityState, x: Array) -> None:
        self._plan, self.memory = plan, memory
        if memory.omega2 < 0.0:
            memory.omega2, memory.damping = plan.spectral_bounds(x)

    @cached_property
    def _damps_waves(self) -> bool:
        # Grips and contact act locally, and air damps weakly.
        return any(force.damped and force.damps_waves for force in self._plan.model.forces)

    def is_damped(self, length: float) -> bool:
        """Return True if damping removes the fastest waves within a time [s]."""
        memory = self.memory
        return memory.omega2 == 0.0 or (memory.damping * length >= CONSTANTS.damped_wave_decay and self._damps_waves)

    def min_refinement(self, n_runs: int, length: float) -> float:
        """Return the least refinement at which a combination of runs is stable over a length [s]; 1 for one run."""
        return 1.0 if n_runs == 1 or self.is_damped(length) else 1.0 / UNDAMPED_LIMIT_FRACTIONS[n_runs - 1]

    def n_pieces(self, n_runs: int, steps: int, length: float) -> int:
        """Return the number of pieces to divide a length [s] into: each short, and of few steps without damping.

        Args:
            n_runs: number of combined runs.
            steps: steps of the first run over the length.
            length: to divide [s].
        """
        n_pieces = 1 if length <= CONSTANTS.max_interval else steps_for(length, CONSTANTS.max_interval)
        if n_runs == 1 or self.is_damped(length):
            return n_pieces
        return max(n_pieces, math.ceil(steps / MAX_UNDAMPED_STEPS))
