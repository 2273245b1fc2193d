# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A tolerance that is relaxed for a while, because the machine is too slow for it: by how much lies in the state.

Whoever decides it (the node, by wall time) says so with a `Relax` event. The scene's tolerance stays what its user set.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.state import State

#: Most that a tolerance is multiplied by, and the tolerance that none is relaxed beyond [m].
MOST_FACTOR, MOST_TOLERANCE = 10.0, 1e-2
#: Name in ``State.memory``: the factor, shape (1,), float64. It is not there while the tolerance is the scene's own.
MEMORY = "relaxed"


def factor_of(state: State) -> float:
    """Return what the scene's tolerance is multiplied by, at least 1."""
    stored = state.memory.get(MEMORY)
    return 1.0 if stored is None else float(stored[0])


def set_factor(state: State, factor: float) -> None:
    """Let the scene's tolerance be multiplied by a factor, from 1 to `MOST_FACTOR`."""
    if factor == 1.0:
        state.memory.pop(MEMORY, None)
    else:
        state.memory[MEMORY] = np.array([factor])


def relaxed(tolerance: float, factor: float) -> float:
    """Return a tolerance [m] times a factor, yet none beyond `MOST_TOLERANCE` that was not so by itself."""
    return min(factor * tolerance, max(tolerance, MOST_TOLERANCE))
