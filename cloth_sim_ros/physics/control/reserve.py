# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rule of the reserve: what calm frames do not take of the tolerance is left to a lively one.

Frames of a second may lose a share of the tolerance together. Each is granted a part of an equal share; what it does
not take goes to a reserve that holds the rest of a second's share at most. So in no window of one second frames take
more than all of it: what was there at its beginning, and what is granted in it.
"""

from __future__ import annotations

from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.remembered import Reserve


class ReserveRule:
    """Of one advance.

    Args:
        memory: what is left.
        tolerance: largest particle position error in a second [m].
        duration: of the advance [s].
    """

    def __init__(self, memory: Reserve, tolerance: float, duration: float) -> None:
        self.memory = memory
        second = CONSTANTS.share * tolerance
        # Frames aim at a part of what they may take; half of the rest is left over for the reserve.
        granted = 0.5 * (1.0 + CONSTANTS.aim)
        self._granted, self._most = granted * second * duration, (1.0 - granted) * second
        #: Error that the advance may have [m]: of the reserve half, so that frames after it find some too.
        self.budget = self._granted + 0.5 * memory.left

    def took(self, error: float) -> None:
        """Remember the error [m] of the advance."""
        self.memory.left = min(self._most, max(0.0, self.memory.left + self._granted - error))
