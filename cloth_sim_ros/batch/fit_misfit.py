# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Misfit: residuals that neither noise nor uncertain parameters explain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.batch.fit_solver import Linear
from cloth_sim_ros.physics.forces.force import Array

#: Residuals that are so many times larger than the noise are not explained by the model.
WORSE = 1.5
#: Standard deviations by which parameters may be off.
_DEVIATIONS = 2.0

MISFIT = (
    "the simulated cloth follows only a part of the recording. The scene lacks something that moves the cloth (what a "
    "gripper holds, wind, an obstacle, a parameter that is not sought, a start in motion): give it, and fit again"
)
UNSTEADY = (
    "only the first window could be followed, and no later cloud confirms what it tells. Record a gentler motion, or "
    "take these clouds for the whole recording by --until"
)
UNSETTLED = (
    "the search did not settle within its steps: what was found is no least square. Begin nearer by --start, or seek "
    "fewer parameters"
)


def root_mean_square(r: Array) -> float:
    """Return the deviation of residuals [m]; 0 for none."""
    return float(np.sqrt(np.square(r).mean())) if r.size else 0.0


def is_misfit(r: Array, earlier: int, noise: float) -> bool:
    """Return whether a longer window's residuals exceed the noise: all of them, or those of the clouds that it adds.

    Args:
        r: residuals of the longer window [m], shape (n,).
        earlier: number of residuals of the window before.
        noise: their deviation in shorter windows [m].
    """
    return max(root_mean_square(r), root_mean_square(r[earlier:])) > WORSE * noise


def is_rest_misfit(linear: Linear, offsets: NDArray[np.int64], cloud: int, noise: float) -> bool:
    """Return whether the clouds from one on, at which a fit ended, are further off than uncertain parameters explain.

    A difference step is one standard deviation of a parameter, so that the differences say what two of them do.

    Args:
        linear: residuals and differences at the answer, with the clouds that are not used.
        offsets: where each cloud's residuals begin, shape (clouds + 1,).
        cloud: the first one that is not used.
        noise: deviation of residuals in what is used [m].
    """
    begin = int(offsets[cloud])
    r = linear.r[begin:]
    if not r.size:
        return False
    slopes = np.square(linear.jacobian[:, begin:] * linear.steps[:, None]).sum(axis=0)
    bends = np.square(linear.bend[:, begin:]).sum(axis=0)
    allowed = (WORSE * noise) ** 2 + _DEVIATIONS**2 * (slopes + bends)
    return float(np.square(r).sum()) > float(allowed.sum())
