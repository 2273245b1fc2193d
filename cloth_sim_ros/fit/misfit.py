# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Misfit test: residuals that neither noise nor parameter uncertainty explains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.solver import Linearization
from cloth_sim_ros.physics.model.forces.force import Array

#: Ratio of residuals to noise above which the model does not explain the clouds.
MISFIT_RATIO = 1.5
#: Accepted parameter error [standard deviations].
_DEVIATIONS = 2.0

MISFIT = (
    "the simulated cloth follows only a part of the recording. The scene lacks something that moves the cloth "
    "(a grasped particle, wind, an obstacle, a parameter that is not fitted, an initial motion): add it, and fit again"
)
UNCONFIRMED = (
    "only the first window was fitted, and no later cloud confirms its result. Record a gentler motion, or "
    "restrict the recording to these clouds by --until"
)
NOT_CONVERGED = (
    "the search did not converge within its iterations: the result is no least-squares minimum. Start closer by "
    "--start, or fit fewer parameters"
)


def root_mean_square(r: Array) -> float:
    """Return the root mean square of residuals [m]; 0 if there are none."""
    return float(np.sqrt(np.square(r).mean())) if r.size else 0.0


def is_misfit(r: Array, n_earlier: int, noise: float) -> bool:
    """Return true if the residuals of a longer window, all or the added ones, exceed the noise.

    Args:
        r: residuals of the longer window [m], shape (n,).
        n_earlier: number of residuals of the previous window.
        noise: standard deviation of the residuals of shorter windows [m].
    """
    return max(root_mean_square(r), root_mean_square(r[n_earlier:])) > MISFIT_RATIO * noise


def is_remainder_misfit(
    linearization: Linearization, offsets: NDArray[np.int64], first_cloud: int, noise: float
) -> bool:
    """Return true if the uncertainty of the parameters does not explain the residuals of the unused clouds.

    A difference step is one standard deviation of a parameter. The limit is two of them, and 1.5 times the noise.

    Args:
        linearization: residuals and differences at the result, including the unused clouds.
        offsets: index of each cloud's first residual, shape (clouds + 1,).
        first_cloud: index of the first unused cloud.
        noise: standard deviation of the residuals of the used clouds [m].
    """
    begin = int(offsets[first_cloud])
    r = linearization.r[begin:]
    if not r.size:
        return False
    slope_squares = np.square(linearization.jacobian[:, begin:] * linearization.steps[:, None]).sum(axis=0)
    curvature_squares = np.square(linearization.curvature[:, begin:]).sum(axis=0)
    allowed = (MISFIT_RATIO * noise) ** 2 + _DEVIATIONS**2 * (slope_squares + curvature_squares)
    return float(np.square(r).sum()) > float(allowed.sum())
