# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What runs may have missed in the last half step of a stretch.

They see forces at the middle of their steps. A force that changes at once in the last half step is seen by none of
them, and halving a stretch where it does leads right there. So accelerations over that half step are compared.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import PINCHED
from cloth_sim_ros.physics.state import State

#: Places in the half step, from its end to its begin, and weights of the fourth difference.
_WEIGHTS = ((0.25, -4.0), (0.5, 6.0), (0.75, -4.0), (1.0, 1.0))
#: Force evaluations that it takes.
EVALUATIONS = 1 + len(_WEIGHTS)


def missed_velocity(plan: Plan, state: State, t: float, half_step: float) -> float:
    """Return what a change of forces within the last half step [s] before a state at time t may make of a velocity
    [m/s]: by the fourth difference of the accelerations, which a smooth motion has next to nothing of.
    """
    x, v, pads = state.x, state.v, state.memory.get(PINCHED)
    here, there, difference = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    if plan.contact is not None:
        plan.contact.take(state)
    plan.accelerations(t, x, v, here)
    difference[:] = here
    for place, weight in _WEIGHTS:
        back = place * half_step
        if plan.contact is not None and pads is not None:
            plan.contact.lay_pads(np.stack([pads[:, 0] - back * pads[:, 1], pads[:, 1]], axis=1))
        plan.accelerations(t - back, x - back * v + (0.5 * back * back) * here, v - back * here, there)
        difference += weight * there
    return half_step * largest_distance(difference, np.zeros_like(difference))
