# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An order of particles in which neighbours lie close together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.band import cuthill_mckee

#: An order whose bandwidth is at most so many times the root of the particle count is kept: a sheet has little less.
_NARROW = 3.0


def local_order(particle_count: int, pairs: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return the particles in an order in which those that interact lie close together, shape (particle_count,).

    None where they do already, as in a chain or a grid. The order is that of Cuthill and McKee, reversed, and
    depends on the pairs alone.

    Args:
        particle_count: number of particles.
        pairs: particles that interact, shape (m, 2); any order, repeated ones too.
    """
    if bandwidth(pairs) <= _NARROW * np.sqrt(particle_count):
        return None
    return cuthill_mckee(particle_count, np.ascontiguousarray(pairs, dtype=np.int64))


def bandwidth(pairs: NDArray[np.int64]) -> int:
    """Return the largest difference of the numbers of two particles that interact."""
    return int(np.abs(pairs[:, 1] - pairs[:, 0]).max(initial=0))
