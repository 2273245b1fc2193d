# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Band matrix of the implicit method against a dense matrix."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.physics.integrators import band_matrix
from cloth_sim_ros.physics.integrators.band_matrix import BandMatrix
from cloth_sim_ros.physics.integrators.base import UnstableError


def system(count: int, width: int) -> tuple[BandMatrix, np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """Return a band matrix, its dense equal, the free particles, blocks and masses; every fifth particle is fixed."""
    random = np.random.default_rng(count + width)
    block_rows = np.full(count, -1)
    is_free = np.arange(count) % 5 != 2
    block_rows[is_free] = random.permutation(int(is_free.sum()))
    ends = [
        (a, b)
        for a in range(count)
        for b in range(a)
        if block_rows[a] < 0 or abs(block_rows[a] - block_rows[b]) <= width
    ]
    pairs = np.array(ends, dtype=np.int64)
    away = random.normal(size=(len(pairs), 3))
    blocks = np.stack([away[:, i] * away[:, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=1)
    dense = np.eye(3 * count)
    for (a, b), d in zip(pairs, away, strict=True):
        block = np.outer(d, d)
        for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += sign * block
    return BandMatrix(block_rows, width, [pairs]), dense, is_free, [blocks], np.ones(count)


@pytest.mark.parametrize(("count", "width"), [(6, 2), (9, 6), (40, 3), (41, 4), (120, 7)])
def test_band_solution_equals_dense_solution(count: int, width: int) -> None:
    matrix, dense, is_free, blocks, masses = system(count, width)
    matrix.update(blocks, masses, np.zeros((6, count)))
    right = np.random.default_rng(1).normal(size=(3, count))
    free = np.repeat(is_free, 3)
    expected = np.zeros(3 * count)
    expected[free] = np.linalg.solve(dense[np.ix_(free, free)], right.T.ravel()[free])
    matrix.solve(right)
    assert right.T.ravel() == pytest.approx(expected, abs=1e-11)


def test_band_solution_has_equal_bits_on_one_and_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    solutions = []
    for enough in (0, 10**9):
        monkeypatch.setattr(band_matrix, "_PARALLEL_FACTOR_OPERATIONS", enough)
        monkeypatch.setattr(band_matrix, "_PARALLEL_SOLVE_SIZE", enough)
        matrix, _, _, blocks, masses = system(120, 7)
        matrix.update(blocks, masses, np.zeros((6, 120)))
        right = np.random.default_rng(1).normal(size=(3, 120))
        matrix.solve(right)
        solutions.append(right.tobytes())
    assert solutions[0] == solutions[1]


def test_band_update_is_repeatable() -> None:
    matrix, _, _, blocks, masses = system(41, 4)
    solutions = []
    for _ in range(2):
        matrix.update(blocks, masses, np.zeros((6, 41)))
        right = np.ones((3, 41))
        matrix.solve(right)
        solutions.append(right.tobytes())
    assert solutions[0] == solutions[1]


def test_indefinite_band_matrix_is_refused() -> None:
    matrix, _, _, blocks, masses = system(40, 3)
    with pytest.raises(UnstableError, match="not positive definite"):
        matrix.update(blocks, -100.0 * masses, np.zeros((6, 40)))
