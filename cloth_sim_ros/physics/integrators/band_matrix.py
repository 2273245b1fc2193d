# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Symmetric positive definite band matrix, factorised from both ends by two threads.

The upper and the lower block rows are eliminated independently, the lower ones in reverse order. A matrix with as many
block rows as the band is wide remains. The size alone determines the parts; one and two threads give the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import band
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.thread_limit import available_threads

_Index = NDArray[np.int64]

#: Minimum multiplications of a factorisation, and minimum matrix entries of a solution, for a second thread.
_PARALLEL_FACTOR_OPERATIONS, _PARALLEL_SOLVE_SIZE = 8_000_000, 2_000_000


@cache
def _second_thread() -> ThreadPoolExecutor:
    """Return the executor of the process's second thread, created at its first use."""
    return ThreadPoolExecutor(1, thread_name_prefix="band")


def _start(is_worth_a_thread: bool, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Call a function, in the second thread if that pays; return a function that waits for the result and returns it.

    A call that is shorter than waking a thread is over when this function returns.
    """
    if is_worth_a_thread and available_threads() > 1:
        return _second_thread().submit(function, *arguments).result
    result = function(*arguments)
    return lambda: result


class BandMatrix:
    """Symmetric positive definite band matrix of 3x3 blocks between particles; `update` assembles, then `solve`.

    Args:
        block_rows: block row of each particle, -1 for fixed ones, shape (n,).
        width: block half bandwidth.
        pairs: particle pairs of each group of blocks, each of shape (m, 2); pairs outside the band are ignored.
    """

    def __init__(self, block_rows: _Index, width: int, pairs: list[_Index]) -> None:
        self._block_rows, self.width = block_rows, width
        self.count = int(block_rows.max(initial=-1)) + 1
        # Two ends only if each is longer than the shared part.
        self._shared = width if self.count >= 4 * width else 0
        self._upper = (self.count - self._shared) // 2 if self._shared else self.count
        self._lower = self.count - self._shared - self._upper
        n_numbers = 9 * self.count * (width + 1)
        self._factors_in_parallel = n_numbers * (width + 1) >= 2 * _PARALLEL_FACTOR_OPERATIONS
        self._solves_in_parallel = n_numbers >= _PARALLEL_SOLVE_SIZE
        self._pairs = pairs
        self._is_prepared = False

    def _prepare(self) -> None:
        """Allocate the arrays of the factorisation at the first update; before, the size alone gives the cost."""
        last, block_rows = self.count - 1, self._block_rows
        is_upper = block_rows < self._upper + self._shared
        is_lower = block_rows >= self._upper
        self._maps = (np.where(is_upper, block_rows, -1), np.where(is_lower, last - block_rows, -1))
        self._selected = [self._split(ends) for ends in self._pairs]
        # The upper part alone assembles the diagonal of the shared rows.
        self._diagonal_maps = (self._maps[0], np.where(self._maps[1] < self._lower, self._maps[1], -1))
        upper, lower = (band.zeros(n_rows + self._shared, self.width) for n_rows in (self._upper, self._lower))
        self._rows = upper, lower
        self._shared_rows = band.zeros(self._shared, max(self._shared - 1, 0))
        self._is_prepared = True

    def _split(self, pairs: _Index) -> tuple[_Index, _Index]:
        """Return the indices of the pairs in the upper and in the lower part; pairs outside the band are left out."""
        ends = self._block_rows[pairs]
        is_in_band = (np.abs(ends[:, 0] - ends[:, 1]) <= self.width) | (ends < 0).any(axis=1)
        is_in_band &= (ends >= 0).any(axis=1)
        is_lower = (ends >= self._upper + self._shared).any(axis=1)
        return np.flatnonzero(is_in_band & ~is_lower), np.flatnonzero(is_in_band & is_lower)

    def update(self, blocks: list[Array], masses: Array, diagonal: Array) -> None:
        """Assemble and factorise the matrix; raise UnstableError if it is not positive definite.

        Args:
            blocks: pair blocks (m, 6) of each group.
            masses: added to the diagonal, shape (n,).
            diagonal: blocks added to the diagonal, shape (6, n).

        Raises:
            UnstableError: if the matrix is not positive definite.
        """
        if not self._is_prepared:
            self._prepare()
        if self._shared:
            wait = _start(self._factors_in_parallel, self._eliminate, 1, blocks, masses, diagonal)
            is_positive = self._eliminate(0, blocks, masses, diagonal)
            is_positive = wait() and is_positive
            band.join(*self._rows, self._upper, self._lower, self._shared_rows)
            is_positive = is_positive and band.factor(self._shared_rows, self._shared)
        else:
            is_positive = self._eliminate(0, blocks, masses, diagonal)
        if not is_positive:
            raise UnstableError("the matrix of an implicit step is not positive definite: the motion is not finite")

    def _eliminate(self, part: int, blocks: list[Array], masses: Array, diagonal: Array) -> bool:
        rows = self._rows[part]
        rows.fill(0.0)
        for pairs, values, selected in zip(self._pairs, blocks, self._selected, strict=True):
            band.assemble(rows, self._maps[part], pairs, values, selected[part])
        band.assemble_diagonal(rows, self._diagonal_maps[part], masses, diagonal)
        return band.factor(rows, (self._upper, self._lower)[part])

    def solve(self, right: Array) -> None:
        """Replace the right-hand side (3, n) by the solution, after `update`; zero for fixed particles."""
        is_free = self._block_rows >= 0
        y = np.zeros((self.count, 3))
        y[self._block_rows[is_free]] = right[:, is_free].T
        upper_end = self._upper + self._shared
        upper = y[:upper_end].copy()
        if self._shared:
            lower = y[self._upper :][::-1].copy()
            lower[self._lower :] = 0.0
            wait = _start(self._solves_in_parallel, band.forward, self._rows[1], self._lower, lower)
            band.forward(self._rows[0], self._upper, upper)
            wait()
            middle = upper[self._upper :] + lower[self._lower :][::-1]
            band.forward(self._shared_rows, self._shared, middle)
            band.backward(self._shared_rows, self._shared, middle)
            upper[self._upper :], lower[self._lower :] = middle, middle[::-1]
            wait = _start(self._solves_in_parallel, band.backward, self._rows[1], self._lower, lower)
            band.backward(self._rows[0], self._upper, upper)
            wait()
            y[self._upper :] = lower[::-1]
        else:
            band.forward(self._rows[0], self._upper, upper)
            band.backward(self._rows[0], self._upper, upper)
        y[:upper_end] = upper
        right[:] = 0.0
        right[:, is_free] = y[self._block_rows[is_free]].T
