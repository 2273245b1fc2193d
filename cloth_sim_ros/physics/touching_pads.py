# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pads of grippers that follow a step of the implicit method, during which they stood."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.contact import Contact
from cloth_sim_ros.physics.forces.force import Array

#: Halvings of the range in which the rate of pads is looked for: down to its last bit.
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
    """Return where pads are, and their rates, after a step of the implicit Euler method, the cloth where it is then.

    Cloth and stops push the harder the further pads go: of their rates, one is what the rate before and the push make.
    It is found by bisection between the stops.

    Args:
        force: contact, with its pads.
        before: half the ways between pads [m] and their rates [m/s] at the start, shape (pinches, 2); open pads where
            left out.
        h: length of the step [s].
        lay: lets what follows have pads in such places.
        accelerations: of half the ways between pads, where they were laid; not finite where they are within the cloth.
        cross: whether pads pass through the cloth on their way from some half ways to where they were laid; left out
            where only particles meet them.
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
        # Where pads stood they were clear of the cloth: it keeps them on that side.
        past = ~np.isfinite(over) & clear
        if cross is not None:
            past |= cross(way)
        inward = np.where(past, middle > 0.0, over > 0.0)
        low, high = np.where(inward, low, middle), np.where(inward, middle, high)
    middle = np.where(force.driven[:, 0], high, 0.0)
    return np.stack([way + h * middle, middle], axis=1)
