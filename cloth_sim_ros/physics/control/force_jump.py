# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check for a force jump in the last half step of an interval.

Runs evaluate forces at the middle of their steps, so none of them samples the last half step. Halving an interval at a
force jump moves the jump there. Therefore this check compares accelerations over that half step.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY
from cloth_sim_ros.physics.state.state import State

#: Fractions of the half step, measured back from its end, and weights of the fourth difference.
_DIFFERENCE_WEIGHTS = ((0.25, -4.0), (0.5, 6.0), (0.75, -4.0), (1.0, 1.0))
#: Force evaluations of the check.
EVALUATIONS = 1 + len(_DIFFERENCE_WEIGHTS)


def missed_velocity_change(plan: Plan, state: State, t: float, half_step: float) -> float:
    """Return the velocity change that a force jump in the last half step may cause [m/s].

    It is the fourth difference of the accelerations times the half step; for smooth motion it is nearly zero.

    Args:
        plan: equations of motion.
        state: at the end of the half step.
        t: its time [s].
        half_step: length [s].
    """
    x, v, jaws = state.x, state.v, state.memory.get(JAWS_KEY)
    a, earlier, difference = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    if plan.contact is not None:
        plan.contact.load_state(state)
    plan.accelerations(t, x, v, a)
    difference[:] = a
    for fraction, weight in _DIFFERENCE_WEIGHTS:
        dt = fraction * half_step
        if plan.contact is not None and jaws is not None:
            plan.contact.set_jaws(np.stack([jaws[:, 0] - dt * jaws[:, 1], jaws[:, 1]], axis=1))
        plan.accelerations(t - dt, x - dt * v + (0.5 * dt * dt) * a, v - dt * a, earlier)
        difference += weight * earlier
    return half_step * largest_distance(difference, np.zeros_like(difference))
