# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The engine's band matrices, its order of particles and its sums."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cloth_sim_ros.engine import band


def filled(count: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A random positive definite matrix, and its dense equal."""
    random = np.random.default_rng(100 * count + width)
    rows, dense = band.zeros(count, width), np.zeros((3 * count, 3 * count))
    for i in range(count):
        for j in range(i, min(count, i + width + 1)):
            block = random.normal(size=(3, 3))
            if i == j:
                block += block.T + 20.0 * (width + 1) * np.eye(3)
            rows[i, :, 3 * (j - i) : 3 * (j - i + 1)] = block
            dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = block
            dense[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = block.T
    return rows, dense


def dense_of(rows: np.ndarray, width: int) -> np.ndarray:
    """The symmetric matrix whose upper half is in a band."""
    count = len(rows)
    dense = np.zeros((3 * count, 3 * count))
    for i in range(count):
        for j in range(i, min(count, i + width + 1)):
            block = rows[i, :, 3 * (j - i) : 3 * (j - i + 1)]
            dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = block
            dense[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = block.T
    return dense


SIZES = [(1, 0), (2, 0), (2, 1), (5, 2), (7, 6), (9, 3), (20, 5), (40, 12), (61, 30)]


@pytest.mark.parametrize(("count", "width"), SIZES)
def test_a_factorised_band_solves_as_the_dense_matrix_does(count: int, width: int) -> None:
    rows, dense = filled(count, width)
    right = np.random.default_rng(1).normal(size=(count, 3))
    assert band.factor(rows, count)
    y = right.copy()
    band.forward(rows, count, y)
    band.backward(rows, count, y)
    assert y.ravel() == pytest.approx(np.linalg.solve(dense, right.ravel()), rel=1e-11, abs=1e-13)


@pytest.mark.parametrize(("count", "width"), SIZES)
@pytest.mark.parametrize("share", [0.0, 0.4, 0.7])
def test_rows_that_are_not_eliminated_hold_the_schur_complement(count: int, width: int, share: float) -> None:
    rows, dense = filled(count, width)
    inner = int(share * count)
    cut = 3 * inner
    expected = dense[cut:, cut:] - dense[cut:, :cut] @ np.linalg.solve(dense[:cut, :cut], dense[:cut, cut:])
    assert band.factor(rows, inner)
    assert dense_of(rows[inner:], width) == pytest.approx(expected, abs=1e-10)


def test_couplings_are_assembled_in_either_order() -> None:
    random = np.random.default_rng(6)
    places, pairs = np.array([2, 0, -1, 1]), np.array([[0, 1], [1, 3], [2, 0]])
    blocks = random.normal(size=(3, 9))
    rows, dense = band.zeros(3, 2), np.zeros((9, 9))
    band.assemble(rows, places, pairs, blocks, np.arange(3))
    for (a, b), block in zip(places[pairs], blocks.reshape(3, 3, 3), strict=True):
        for i in (a, b):
            if i >= 0:
                dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += 0.5 * (block + block.T)
        if min(a, b) >= 0:
            dense[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] -= block
            dense[3 * b : 3 * b + 3, 3 * a : 3 * a + 3] -= block.T
    assert dense_of(rows, 2) == pytest.approx(dense, abs=1e-15)


def test_zeros_beside_the_band_have_no_sign() -> None:
    # Vectors of another width reach further beyond the band: what they leave there must be the same.
    for count, width in SIZES:
        for inner in range(count + 1):
            rows, _ = filled(count, width)
            assert band.factor(rows, inner)
            beyond = [rows[count - 1 - k, :, 3 * (k + 1) :] for k in range(min(count, width + 1))]
            outside = np.concatenate([rows[:, :, 3 * (width + 1) :].ravel(), *(part.ravel() for part in beyond)])
            assert not outside.any()
            assert not np.signbit(outside).any()


def test_halves_from_both_ends_are_joined() -> None:
    rows, dense = filled(8, 3)
    # The same matrix in reverse order of particles and of axes, then with the axes put back.
    back = dense.reshape(8, 3, 8, 3)[::-1, :, ::-1].reshape(24, 24)
    turned = band.zeros(8, 3)
    for i in range(8):
        for j in range(i, min(8, i + 4)):
            turned[i, :, 3 * (j - i) : 3 * (j - i + 1)] = back[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
    middle = band.zeros(3, 2)
    band.join(rows, turned, 5, 5, middle)
    expected = dense[15:, 15:] + dense[:9, :9]
    assert np.array_equal(dense_of(middle, 2), expected)


def test_entries_that_decay_do_not_become_denormal() -> None:
    # Unit masses, each coupled weakly with the next one and the one 60 further on: fill-in shrinks along each row.
    rows = band.zeros(70, 60)
    for c in range(3):
        rows[:, c, c] = 1.0
        rows[:-1, c, 3 + c] = rows[:10, c, 180 + c] = 1e-4
    assert band.factor(rows, 70)
    sizes = np.abs(rows[rows != 0.0])
    assert len(sizes) > 210 + 30
    assert sizes.min() >= 1e-120


def sheet(rows: int, columns: int) -> np.ndarray:
    """Pairs of a grid with diagonals."""
    index = np.arange(rows * columns).reshape(rows, columns)
    ends = ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:]))
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ends])


def triangulated(count: int, seed: int) -> np.ndarray:
    """Pairs of a Delaunay mesh of random points."""
    spatial = pytest.importorskip("scipy.spatial")
    faces = spatial.Delaunay(np.random.default_rng(seed).random((count, 2))).simplices
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.ascontiguousarray(pairs, dtype=np.int64)


def width_of(order: np.ndarray, pairs: np.ndarray) -> int:
    """The largest distance of two particles of a pair in an order."""
    rank = np.argsort(order)
    return int(np.abs(rank[pairs[:, 0]] - rank[pairs[:, 1]]).max())


def meshes() -> list[np.ndarray]:
    """Grids, grids in disorder, and triangulated ones."""
    random = np.random.default_rng(4)
    grids = [sheet(12, 12), sheet(30, 30), sheet(7, 50)]
    return [
        *grids,
        *(random.permutation(int(pairs.max()) + 1)[pairs] for pairs in grids),
        *(triangulated(count, count + seed) for count in (60, 300, 1500) for seed in range(3)),
    ]


@pytest.mark.parametrize("which", range(15))
def test_bandwidth_matches_scipy(which: int) -> None:
    sparse = pytest.importorskip("scipy.sparse")
    csgraph = pytest.importorskip("scipy.sparse.csgraph")
    pairs = meshes()[which]
    count = int(pairs.max()) + 1
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    graph = sparse.csr_matrix((np.ones(len(ends), dtype=np.int8), ends.T), shape=(count, count))
    scipy_width = width_of(csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True), pairs)
    order = band.cuthill_mckee(count, pairs)
    assert sorted(order.tolist()) == list(range(count))
    assert width_of(order, pairs) <= 1.1 * scipy_width


def test_starts_at_far_ends_make_a_mesh_narrower() -> None:
    # From the particle of least degree alone it is 128.
    pairs = triangulated(1500, 1502)
    assert width_of(band.cuthill_mckee(1500, pairs), pairs) < 115


def test_the_order_depends_on_the_set_of_pairs_alone() -> None:
    pairs = triangulated(200, 7)
    random = np.random.default_rng(0)
    shuffled = np.concatenate([pairs, pairs[::3, ::-1], np.stack([np.arange(9), np.arange(9)], axis=1)])
    random.shuffle(shuffled)
    assert np.array_equal(band.cuthill_mckee(203, pairs), band.cuthill_mckee(203, shuffled))


def test_particles_without_a_pair_have_a_place_too() -> None:
    order = band.cuthill_mckee(6, np.array([[4, 1], [1, 2]]))
    # From the last to the first: least degree first, the lowest number first, then what is coupled with it.
    assert order.tolist() == [4, 1, 2, 5, 3, 0]
    assert band.cuthill_mckee(0, np.empty((0, 2), dtype=np.int64)).size == 0


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 1003])
def test_a_sum_has_one_order(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    part = [0.0] * 8
    for i, value in enumerate(values.tolist()):
        part[i % 8] += value
    a, b, c, d, e, f, g, h = part
    assert band.fixed_sum(values) == ((a + e) + (c + g)) + ((b + f) + (d + h))
    assert band.fixed_sum(values) == pytest.approx(math.fsum(values), abs=1e-12)


def test_arguments_that_do_not_fit_are_refused_by_name() -> None:
    rows = band.zeros(4, 1)
    places, pairs = np.arange(4), np.array([[0, 1], [1, 2]])
    blocks, chosen = np.zeros((2, 6)), np.array([0, 1])
    y, masses, single = np.zeros((4, 3)), np.ones(4), np.zeros((6, 4))
    wrong = [
        ("count is -1", lambda: band.zeros(-1, 2)),
        ("width is -3", lambda: band.zeros(2, -3)),
        ("rows is a list", lambda: band.factor([1.0], 0)),
        (r"rows is an array of float64, shape \(4,\)", lambda: band.factor(np.zeros(4), 0)),
        ("rows has rows of 5 numbers", lambda: band.factor(np.zeros((4, 3, 5)), 0)),
        ("rows is not contiguous", lambda: band.factor(rows[::2], 0)),
        ("inner is 5", lambda: band.factor(rows, 5)),
        ("inner is -1", lambda: band.forward(rows, -1, y)),
        (r"y is an array of float64, shape \(3, 3\)", lambda: band.backward(rows, 4, y[:3])),
        ("y is an array of float32", lambda: band.backward(rows, 4, y.astype(np.float32))),
        ("places is an array of int32", lambda: band.assemble(rows, places.astype(np.int32), pairs, blocks, chosen)),
        ("pairs is a int", lambda: band.assemble(rows, places, 3, blocks, chosen)),
        ("blocks is an array", lambda: band.assemble(rows, places, pairs, blocks[:1], chosen)),
        ("chosen has 2: there are 2 pairs", lambda: band.assemble(rows, places, pairs, blocks, chosen + 1)),
        ("pairs have particle 4: places has 4", lambda: band.assemble(rows, places, pairs + 2, blocks, chosen)),
        ("places has block row 6: the matrix has 4", lambda: band.assemble(rows, places + 3, pairs, blocks, chosen)),
        ("equal, or further apart", lambda: band.assemble(rows, places * 2 % 4, pairs, blocks, chosen)),
        ("masses is an array", lambda: band.assemble_diagonal(rows, places, masses[:2], single)),
        ("blocks is an array", lambda: band.assemble_diagonal(rows, places, masses, single.T.copy())),
        ("places has block row 7", lambda: band.assemble_diagonal(rows, places + 4, masses, single)),
        ("lower has 2 blocks", lambda: band.join(rows, band.zeros(4, 2), 3, 3, band.zeros(1, 0))),
        ("middle has 3 block rows", lambda: band.join(rows, rows, 1, 1, band.zeros(3, 2))),
        ("inner_lower is 2 of 4", lambda: band.join(rows, rows, 3, 2, band.zeros(1, 0))),
        ("count is -2", lambda: band.cuthill_mckee(-2, pairs)),
        ("pairs have particle 2: there are 2", lambda: band.cuthill_mckee(2, pairs)),
        ("pairs is an array", lambda: band.cuthill_mckee(2, places)),
        ("values is an array of int64", lambda: band.fixed_sum(places)),
    ]
    for message, call in wrong:
        with pytest.raises(ValueError, match=message):
            call()
