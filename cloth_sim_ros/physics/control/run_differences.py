# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Differences between the combination T_K of K runs and T_(K-1) in successive pieces, and their second differences.

Without damping the errors of a run are a series in h^2. Then T_2 - T_1 is proportional to H^2 times a derivative of
the motion. The error of T_2 is proportional to H^4 times the second time derivative of that. Second differences of
T_2 - T_1, from piece to piece, contain the same. A slow motion has large differences, and small second ones.
"""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import lengths
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau, coefficient_of
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import RUN_DIFFERENCES_KEY
from cloth_sim_ros.physics.state.state import State

#: Number of pieces before the present one that second differences need. Their ratio to differences that pieces do not
#: have in common, as of waves faster than a piece: the root of 1 + 4 + 1.
_HISTORY, _GROWTH = 2, math.sqrt(6.0)


class RunDifferences:
    """Differences of positions [m] and velocities [m/s], (2, 3, n), over their error coefficient, of the last pieces.

    Args:
        state: at the start of the advance.
    """

    def __init__(self, state: State) -> None:
        self._at_start = list(state.memory.get(RUN_DIFFERENCES_KEY, ()))
        self.restart()

    def restart(self) -> None:
        """Return to the start of the advance."""
        self._pieces = self._at_start
        #: Runs of the present piece, their number, their differences, and second ones or None.
        self._present: tuple[ExtrapolationTableau, int, Array, Array | None] | None = None

    def second_differences(self, tableau: ExtrapolationTableau, n_runs: int) -> Array | None:
        """Return second differences of each particle's position [m] and velocity [m/s], (2, n), over the root of 6.

        Args:
            tableau: runs of the piece.
            n_runs: number of combined runs, from 2; the same in the pieces before.

        Returns:
            The second differences; None if they are unknown.
        """
        coefficient = coefficient_of(tableau.counts[: n_runs - 1], tableau.duration)
        (x, v), (y, w) = tableau.combine(n_runs), tableau.combine(n_runs - 1)
        present = np.stack((x - y, v - w)) / coefficient
        second = None
        if len(self._pieces) == _HISTORY:
            older, newer = self._pieces
            changes = coefficient / _GROWTH * (present - newer - (newer - older))
            second = np.stack((lengths(changes[0]), lengths(changes[1])))
        self._present = tableau, n_runs, present, second
        return second

    def accept(self, tableau: ExtrapolationTableau, n_runs: int) -> Array | None:
        """Keep the differences of an accepted piece; forget all pieces if its second ones were not asked for.

        Returns:
            Its second differences; None if unknown.
        """
        present, self._present = self._present, None
        if present is None or present[0] is not tableau or present[1] != n_runs:
            self._pieces = []
            return None
        self._pieces = [*self._pieces[1 - _HISTORY :], present[2]]
        return present[3]

    def store(self, state: State, *, is_known: bool) -> None:
        """Store the last pieces in a state's memory; remove them if they are not known for the next number of runs."""
        if is_known and self._pieces:
            state.memory[RUN_DIFFERENCES_KEY] = np.stack(self._pieces)
        else:
            state.memory.pop(RUN_DIFFERENCES_KEY, None)
