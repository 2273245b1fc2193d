# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of jaws in a step of the implicit method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.force import Array

#: Bisections of the range of the jaw speed, down to its last bit.
_BISECTIONS = 60


def step_jaws(
    force: Contact,
    start: Array,
    h: float,
    *,
    accelerations: Callable[[Array], Array],
    find_hits: Callable[[Array, Array], NDArray[np.bool_]] | None,
) -> Array:
    """Return jaw states (pinches, 2) after an implicit Euler step, given the cloth at its end.

    The load of cloth and stops grows with the half opening's displacement. Therefore one jaw speed is consistent with
    the speed before and the load. Bisection between the stops finds it.

    Args:
        force: contact, with its jaws.
        start: half openings [m] and jaw speeds [m/s] at the start, shape (pinches, 2).
        h: length of the step [s].
        accelerations: returns the accelerations of the half openings [m/s^2] in given jaw states; not finite inside the
            cloth.
        find_hits: returns whether jaws in given states have passed through the cloth since given half openings [m];
            None if only particles meet them.
    """
    half_opening, jaw_speed = start.T.copy()
    inner, outer = _half_opening_ranges(force)
    low, high = (inner - 0.75 * force.thickness - half_opening) / h, (outer + force.thickness - half_opening) / h
    is_clear = np.isfinite(accelerations(np.stack([half_opening, np.zeros_like(half_opening)], axis=1)))
    for _ in range(_BISECTIONS):
        mid_speed = 0.5 * (low + high)
        jaws = np.stack([half_opening + h * mid_speed, mid_speed], axis=1)
        excess = mid_speed - jaw_speed - h * accelerations(jaws)
        # If jaws were clear of the cloth at the start, the cloth keeps them on that side.
        is_past = ~np.isfinite(excess) & is_clear
        if find_hits is not None:
            is_past |= find_hits(jaws, half_opening)
        inward = np.where(is_past, mid_speed > 0.0, excess > 0.0)
        low, high = np.where(inward, low, mid_speed), np.where(inward, mid_speed, high)
    mid_speed = np.where(force.jaw_commands[:, 0], high, 0.0)
    return np.stack([half_opening + h * mid_speed, mid_speed], axis=1)


def _half_opening_ranges(force: Contact) -> tuple[Array, Array]:
    """Return the least and the largest half opening [m] that each gripper's drive moves to, (pinches,) each."""
    setpoints, closed = force.controls.jaw_setpoints, force.jaw_commands[:, 1].tolist()
    targets = [-1.0] * len(force.jaws) if setpoints is None else setpoints[:, 0].tolist()
    jaws = zip(force.jaws, closed, targets, strict=True)
    stops = np.array([jaw.half_opening_range(closes, target, force.thickness) for jaw, closes, target in jaws])
    return stops[:, 0], stops[:, 1]
