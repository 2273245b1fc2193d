# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check for a force jump in the first or last half step of an interval.

Runs evaluate forces at the middle of their steps, so none of them samples these half steps. Halving an interval at a
force jump moves the jump there. Therefore this check compares accelerations over such a half step.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import drift_jaws
from cloth_sim_ros.physics.state.state import State

#: Fractions of the half step, measured back from its end, and weights of the fourth difference.
_DIFFERENCE_WEIGHTS = ((0.25, -4.0), (0.5, 6.0), (0.75, -4.0), (1.0, 1.0))
#: Force evaluations of the check.
EVALUATIONS = 1 + len(_DIFFERENCE_WEIGHTS)


def missed_velocity_change(plan: Plan, state: State, t: float, half_step: float) -> Array:
    """Return the velocity changes [m/s] that a force jump within a half step may cause, about 0 if smooth, (3, n).

    It is the fourth difference of the accelerations times the half step; for smooth motion it is nearly zero.

    Args:
        plan: equations of motion.
        state: at the end of the half step, or at its start.
        t: its time [s].
        half_step: length [s]; negative for a half step that starts with the state.
    """
    x, v, memory = state.x, state.v, state.memory
    a, earlier, difference = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    plan.accelerations(t, x, v, a, memory)
    difference[:] = a
    for fraction, weight in _DIFFERENCE_WEIGHTS:
        dt = fraction * half_step
        plan.accelerations(t - dt, x - dt * v + (0.5 * dt * dt) * a, v - dt * a, earlier, drift_jaws(memory, -dt))
        difference += weight * earlier
    difference *= half_step
    return difference
