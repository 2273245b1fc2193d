# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The linear systems of an implicit step: M + d^2 K + d D, assembled from the terms and factorised within a band."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import band
from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.band_matrix import BandMatrix
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.terms.base import Array, Term

#: Pairs whose stiffness is below this share of the largest at either end do not widen the band: what of them lies
#: outside is left to the iteration, which then converges by about this factor a step.
_NEGLIGIBLE = 0.05


class StageMatrix:
    """Matrix of one model, positive definite by construction: compression's negative stiffness is left out.

    Particles that move are numbered so that coupled ones lie close together (reverse Cuthill-McKee), row by row on a
    grid.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        moving = self._model.inverse_masses > 0.0
        self._coupled: list[tuple[Term, NDArray[np.int64]]] = []
        self._single: list[Term] = []
        for term in self._model.terms:
            pairs = term.coupled_pairs()
            if pairs is None:
                self._single.append(term)
            else:
                self._coupled.append((term, np.ascontiguousarray(pairs)))
        places, width = _order(self._band_pairs(), moving)
        self._matrix = BandMatrix(places, width, [pairs for _, pairs in self._coupled])

    @property
    def size(self) -> tuple[int, int]:
        """Block rows, and blocks in a row."""
        return self._matrix.count, self._matrix.width + 1

    def _band_pairs(self) -> NDArray[np.int64]:
        """The pairs that the band has to hold: all but those that are negligible beside others at both their ends."""
        # At coincident places a block is the stiffness times the unit matrix: the order does not depend on the state.
        x = np.zeros((3, self._model.particle_count))
        pairs = [np.empty((0, 2), dtype=np.int64), *(pairs for _, pairs in self._coupled)]
        blocks = [np.empty((0, 6)), *(term.pair_blocks(x, 1.0, 0.0) for term, _ in self._coupled)]
        ends, (xx, yy, zz) = np.concatenate(pairs), np.concatenate(blocks)[:, :3].T
        size = xx + yy + zz
        largest = np.zeros(self._model.particle_count)
        for side in (0, 1):
            np.maximum.at(largest, ends[:, side], size)
        return ends[size >= _NEGLIGIBLE * largest[ends].min(axis=1)]

    def update(self, x: Array, d: float) -> None:
        """Factorise M + d^2 K + d D at positions x (3, n), d [s]; K and D are stiffness and damping matrices.

        Raises:
            UnstableError: if an entry is not finite.
        """
        stiffness, damping = np.zeros((2, 6, self._model.particle_count))
        for term in self._single:
            term.add_stiffness(x, stiffness)
            term.add_damping(x, damping)
        total = d * d * stiffness + d * damping
        blocks = [term.pair_blocks(x, d * d, d) for term, _ in self._coupled]
        self._matrix.update(blocks, self._model.masses, total)

    def solve(self, right: Array) -> None:
        """Replace ``right`` (3, n) by the solution; zero for anchored particles."""
        self._matrix.solve(right)


_MATRICES: WeakKeyDictionary[Model, StageMatrix] = WeakKeyDictionary()


def stage_matrix(dynamics: Dynamics) -> StageMatrix:
    """Return the matrix of a model, made when it is first asked for."""
    if dynamics.model not in _MATRICES:
        _MATRICES[dynamics.model] = StageMatrix(dynamics.model)
    return _MATRICES[dynamics.model]


def _order(pairs: NDArray[np.int64], moving: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Return the block row of each particle, -1 for anchored ones, and the largest distance of coupled ones."""
    places = np.where(moving, np.cumsum(moving) - 1, -1).astype(np.int64)
    ends = places[pairs]
    ends = ends[(ends >= 0).all(axis=1)]
    if not len(ends):
        return places, 0
    width = int(np.abs(ends[:, 0] - ends[:, 1]).max())
    count = int(moving.sum())
    order = band.cuthill_mckee(count, ends)
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    better = int(np.abs(rank[ends[:, 0]] - rank[ends[:, 1]]).max())
    if better >= width:
        return places, width
    return np.where(places >= 0, rank[places], -1), better
