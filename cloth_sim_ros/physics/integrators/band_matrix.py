# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Symmetric positive definite band matrix, factorised from both ends by two threads.

The upper and the lower block rows are eliminated independently, the lower ones in reverse order. A matrix with as many
block rows as the band is wide remains. The size alone determines the parts; one and two threads give the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import band
from cloth_sim_ros.physics.cores import available
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import UnstableError

_Index = NDArray[np.int64]

#: Minimum multiplications of a factorisation, and minimum matrix entries of a solution, for a second thread.
_FACTOR_ASIDE, _SOLVE_ASIDE = 8_000_000, 2_000_000


@cache
def _helper() -> ThreadPoolExecutor:
    """The second thread."""
    return ThreadPoolExecutor(1, thread_name_prefix="band")


class _Here(Executor):
    """Executor that runs a task in the calling thread, for tasks shorter than waking a thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


_HERE = _Here()


def _side(aside: bool) -> Executor:
    """Return the executor of the lower part: the second thread if it pays and is available, else the caller's."""
    return _helper() if aside and available() > 1 else _HERE


class BandMatrix:
    """Band matrix of 3x3 blocks for particle pairs and single particles.

    Args:
        places: block row of each particle, -1 for fixed ones, shape (n,).
        width: block half bandwidth.
        pairs: particle pairs of each group of blocks, each of shape (m, 2); pairs outside the band are ignored.
    """

    def __init__(self, places: _Index, width: int, pairs: list[_Index]) -> None:
        self._places, self.width = places, width
        self.count = int(places.max(initial=-1)) + 1
        # Two ends only if each is longer than the shared part.
        self._shared = width if self.count >= 4 * width else 0
        self._upper = (self.count - self._shared) // 2 if self._shared else self.count
        self._lower = self.count - self._shared - self._upper
        numbers = 9 * self.count * (width + 1)
        self._factors_aside = numbers * (width + 1) >= 2 * _FACTOR_ASIDE
        self._solves_aside = numbers >= _SOLVE_ASIDE
        self._pairs = pairs
        self._made = False

    def _make(self) -> None:
        """Allocate the arrays of the factorisation; its cost is known before, from the size alone."""
        last, places = self.count - 1, self._places
        above = places < self._upper + self._shared
        below = places >= self._upper
        self._maps = (np.where(above, places, -1), np.where(below, last - places, -1))
        self._chosen = [self._split(ends) for ends in self._pairs]
        # The upper part alone assembles the diagonal of the shared rows.
        self._owned = (self._maps[0], np.where(self._maps[1] < self._lower, self._maps[1], -1))
        upper, lower = (band.rows(own + self._shared, self.width) for own in (self._upper, self._lower))
        self._rows = upper, lower
        self._middle = band.rows(self._shared, max(self._shared - 1, 0))
        self._made = True

    def _split(self, pairs: _Index) -> tuple[_Index, _Index]:
        """Return the indices of the pairs of the upper and of the lower part."""
        ends = self._places[pairs]
        near = (np.abs(ends[:, 0] - ends[:, 1]) <= self.width) | (ends < 0).any(axis=1)
        near &= (ends >= 0).any(axis=1)
        lower = (ends >= self._upper + self._shared).any(axis=1)
        return np.flatnonzero(near & ~lower), np.flatnonzero(near & lower)

    def update(self, blocks: list[Array], masses: Array, diagonal: Array) -> None:
        """Assemble and factorise.

        Args:
            blocks: pair blocks (m, 6) of each group.
            masses: added to the diagonal, shape (n,).
            diagonal: blocks added to the diagonal, shape (6, n).

        Raises:
            UnstableError: if the matrix is not positive definite.
        """
        if not self._made:
            self._make()
        if self._shared:
            lower = _side(self._factors_aside).submit(self._eliminate, 1, blocks, masses, diagonal)
            good = self._eliminate(0, blocks, masses, diagonal)
            good = lower.result() and good
            band.join(*self._rows, self._upper, self._lower, self._middle)
            good = good and band.factor(self._middle, self._shared)
        else:
            good = self._eliminate(0, blocks, masses, diagonal)
        if not good:
            raise UnstableError("the matrix of an implicit step is not positive definite: the motion is not finite")

    def _eliminate(self, part: int, blocks: list[Array], masses: Array, diagonal: Array) -> bool:
        rows = self._rows[part]
        rows.fill(0.0)
        for pairs, values, chosen in zip(self._pairs, blocks, self._chosen, strict=True):
            band.assemble(rows, self._maps[part], pairs, values, chosen[part])
        band.assemble_diagonal(rows, self._owned[part], masses, diagonal)
        return band.factor(rows, (self._upper, self._lower)[part])

    def solve(self, right: Array) -> None:
        """Replace ``right`` (3, n) by the solution; zero for fixed particles."""
        moving = self._places >= 0
        y = np.zeros((self.count, 3))
        y[self._places[moving]] = right[:, moving].T
        cut = self._upper + self._shared
        upper = y[:cut].copy()
        if self._shared:
            lower = y[self._upper :][::-1].copy()
            lower[self._lower :] = 0.0
            side = _side(self._solves_aside)
            below = side.submit(band.forward, self._rows[1], self._lower, lower)
            band.forward(self._rows[0], self._upper, upper)
            below.result()
            middle = upper[self._upper :] + lower[self._lower :][::-1]
            band.forward(self._middle, self._shared, middle)
            band.backward(self._middle, self._shared, middle)
            upper[self._upper :], lower[self._lower :] = middle, middle[::-1]
            below = side.submit(band.backward, self._rows[1], self._lower, lower)
            band.backward(self._rows[0], self._upper, upper)
            below.result()
            y[self._upper :] = lower[::-1]
        else:
            band.forward(self._rows[0], self._upper, upper)
            band.backward(self._rows[0], self._upper, upper)
        y[:cut] = upper
        right[:] = 0.0
        right[:, moving] = y[self._places[moving]].T
