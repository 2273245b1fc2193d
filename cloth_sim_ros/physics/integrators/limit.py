# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Step limit of the leapfrog, and number of equal steps."""

from __future__ import annotations

import math


def leapfrog_limit(omega2: float, damping_rate: float) -> float:
    """Return the largest stable step [s], infinite without bounds: the positive root of ``h^2 w^2 / 4 + h c / 2 = 1``.

    At this step a root of the characteristic polynomial for x'' = -w^2 x - c x' leaves the unit circle, at -1.

    Args:
        omega2: squared highest angular frequency [1/s^2].
        damping_rate: highest damping rate c / m [1/s].
    """
    if omega2 == 0.0 and damping_rate == 0.0:
        return math.inf
    # This form avoids cancellation.
    half = 0.5 * damping_rate
    return 2.0 / (half + math.sqrt(half * half + omega2))


def steps_for(duration: float, step: float) -> int:
    """Return the least number, from 1, of equal steps of at most ``step`` [s] that cover a duration, up to rounding."""
    return max(1, math.ceil(duration / step * (1.0 - 1e-12)))
