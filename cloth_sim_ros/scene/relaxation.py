# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relaxation of the tolerance on a machine that is too slow.

The node decides by wall time and sends a `Relax` event. The factor is part of the state, and the scene's tolerance
stays as set.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.state.state import State

#: Largest factor [1], and largest relaxed tolerance [m].
MAX_FACTOR, MAX_TOLERANCE = 10.0, 1e-2
#: Key of the factor in ``State.memory``, shape (1,), float64; absent while the tolerance is the scene's own.
MEMORY_KEY = "relaxed"


def factor_of(state: State) -> float:
    """Return the factor by which the tolerance is relaxed, from a state's memory; 1 if it is not."""
    stored = state.memory.get(MEMORY_KEY)
    return 1.0 if stored is None else float(stored[0])


def set_factor(state: State, factor: float) -> None:
    """Store in a state's memory the factor on the scene's tolerance, from 1 (no entry) to `MAX_FACTOR`, unchecked."""
    if factor == 1.0:
        state.memory.pop(MEMORY_KEY, None)
    else:
        state.memory[MEMORY_KEY] = np.array([factor])


def relaxed_tolerance(tolerance: float, factor: float) -> float:
    """Return a tolerance [m] times a factor, at most `MAX_TOLERANCE`; a larger tolerance stays unchanged."""
    return min(factor * tolerance, max(tolerance, MAX_TOLERANCE))
