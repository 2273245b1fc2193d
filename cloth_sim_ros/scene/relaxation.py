# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A tolerance that is relaxed for a while because the machine is too slow for it; the factor is part of the state.

The node decides by wall time and sends a `Relax` event. The scene's tolerance stays as its user set it.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.state import State

#: Largest factor, and the largest tolerance that relaxing may lead to [m].
MOST_FACTOR, MOST_TOLERANCE = 10.0, 1e-2
#: Name in ``State.memory``: the factor, shape (1,), float64. It is not there while the tolerance is the scene's own.
MEMORY = "relaxed"


def factor_of(state: State) -> float:
    """Return what the scene's tolerance is multiplied by, at least 1."""
    stored = state.memory.get(MEMORY)
    return 1.0 if stored is None else float(stored[0])


def set_factor(state: State, factor: float) -> None:
    """Set the factor on the scene's tolerance, from 1 to `MOST_FACTOR`."""
    if factor == 1.0:
        state.memory.pop(MEMORY, None)
    else:
        state.memory[MEMORY] = np.array([factor])


def relaxed(tolerance: float, factor: float) -> float:
    """Return a tolerance [m] times a factor, at most `MOST_TOLERANCE`; a larger tolerance stays as it is."""
    return min(factor * tolerance, max(tolerance, MOST_TOLERANCE))
