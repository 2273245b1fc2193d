# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check for a jump or kink of forces in the first or last half step of an interval.

Runs evaluate forces at the middle of their steps, so none of them samples these half steps. Halving an interval at a
force jump moves the jump there. Therefore this check compares accelerations over such a half step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import combine
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import drift_jaws
from cloth_sim_ros.physics.state.state import State

#: Fractions of the half step, measured back from its end, at which accelerations are compared, and the weights of
#: fourth differences of five in a row. The last one is beyond the half step, so that a kink at its start shows.
_FRACTIONS, _WEIGHTS = (0.25, 0.5, 0.75, 1.0, 1.25), (1.0, -4.0, 6.0, -4.0, 1.0)
#: A kink changes the velocity by up to seven times the larger of two differences; at most places by less than this.
_MISSED_DIFFERENCES = 2.0
#: Force evaluations of the check.
EVALUATIONS = 1 + len(_FRACTIONS)


def missed_velocity_changes(plan: Plan, state: State, t: float, half_step: float) -> tuple[Array, float]:
    """Return what a jump or kink of forces within a half step changes: velocities (3, n), and speeds of jaws [m/s].

    A fourth difference of accelerations times the half step is nearly zero for smooth motion. At a kink it vanishes at
    two places in the half step. So there are two, a quarter of the half step apart, and the larger one counts.

    Args:
        plan: equations of motion.
        state: at the end of the half step, or at its start.
        t: its time [s].
        half_step: length [s]; negative for a half step that starts with the state.

    Returns:
        Velocity changes, about 0 if forces are smooth; and the largest change of a jaw's speed, 0 without jaws.
    """
    x, v, memory = state.x, state.v, state.memory
    accelerations = np.empty((EVALUATIONS, *x.shape))
    plan.accelerations(t, x, v, accelerations[0], memory)
    a, contact = accelerations[0], plan.contact
    jaws: list[Array] = []
    if contact is not None and contact.force.jaws:
        jaws.append(contact.jaw_accelerations(t, x, v, memory))
    for fraction, earlier in zip(_FRACTIONS, accelerations[1:], strict=True):
        dt = fraction * half_step
        state_then = t - dt, x - dt * v + (0.5 * dt * dt) * a, v - dt * a
        memory_then = drift_jaws(memory, -dt)
        plan.accelerations(*state_then, earlier, memory_then)
        if contact is not None and jaws:
            jaws.append(contact.jaw_accelerations(*state_then, memory_then))
    factor = _MISSED_DIFFERENCES * half_step
    jaw_change = float(np.abs(_largest_differences(jaws) * factor).max()) if jaws else 0.0
    return _largest_differences(accelerations) * factor, jaw_change


def _largest_differences(values: Sequence[Array] | Array) -> Array:
    """Return the larger of two fourth differences of values at the six times."""
    last, next_to_last = (combine(list(part), _WEIGHTS) for part in (values[:-1], values[1:]))
    return np.where(np.abs(next_to_last) > np.abs(last), next_to_last, last)
