# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Order of particles in which neighbours lie close together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.band import cuthill_mckee

#: An order is kept if its bandwidth is at most this factor times the root of the particle count; a sheet has little
#: less.
_MAX_BANDWIDTH_FACTOR = 3.0


def local_order(particle_count: int, pairs: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return the particles in an order that brings interacting ones close together; None if the present one does.

    It is the reversed order of Cuthill and McKee, shape (particle_count,), and depends on the pairs alone. Chains and
    grids are in such an order already.

    Args:
        particle_count: number of particles.
        pairs: particles that interact, shape (m, 2), in any order; repeated pairs are allowed.
    """
    if bandwidth(pairs) <= _MAX_BANDWIDTH_FACTOR * np.sqrt(particle_count):
        return None
    return cuthill_mckee(particle_count, np.ascontiguousarray(pairs, dtype=np.int64))


def bandwidth(pairs: NDArray[np.int64]) -> int:
    """Return the largest index difference of two interacting particles, for pairs (m, 2); 0 without pairs."""
    return int(np.abs(pairs[:, 1] - pairs[:, 0]).max(initial=0))
