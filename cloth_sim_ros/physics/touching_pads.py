# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of jaws in a step of the implicit method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.contact import Contact
from cloth_sim_ros.physics.forces.force import Array

#: Bisections of the range of the jaw speed, down to its last bit.
_BISECTIONS = 60


def moved(
    force: Contact,
    before: Array | None,
    h: float,
    *,
    lay: Callable[[Array], Any],
    accelerations: Callable[[], Array],
    cross: Callable[[Array], NDArray[np.bool_]] | None,
) -> Array:
    """Return the states of jaws after an implicit Euler step, given the cloth at its end.

    The load of cloth and stops grows with the half opening's displacement. Therefore one jaw speed is consistent with
    the speed before and the load. Bisection between the stops finds it.

    Args:
        force: contact, with its jaws.
        before: half openings [m] and jaw speeds [m/s] at the start, shape (pinches, 2); None for open jaws.
        h: length of the step [s].
        lay: sets the jaw states in the engine.
        accelerations: returns the accelerations of the half openings [m/s^2] in the present states; not finite inside
            the cloth.
        cross: returns whether jaws pass through the cloth from given half openings [m] to the present ones; None if
            only particles meet them.
    """
    if before is None:
        before = np.array([pads.start for pads in force.pads])
    way, rate = before.T.copy()
    opening = np.array([0.5 * pads.opening for pads in force.pads])
    low, high = (-0.75 * force.thickness - way) / h, (opening + force.thickness - way) / h
    lay(np.stack([way, np.zeros_like(way)], axis=1))
    clear = np.isfinite(accelerations())
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        lay(np.stack([way + h * middle, middle], axis=1))
        over = middle - rate - h * accelerations()
        # If jaws were clear of the cloth at the start, the cloth keeps them on that side.
        past = ~np.isfinite(over) & clear
        if cross is not None:
            past |= cross(way)
        inward = np.where(past, middle > 0.0, over > 0.0)
        low, high = np.where(inward, low, middle), np.where(inward, middle, high)
    middle = np.where(force.driven[:, 0], high, 0.0)
    return np.stack([way + h * middle, middle], axis=1)
