# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topology of surfaces against Euler's formula, brute force, and shapes known by hand."""

import itertools

import numpy as np
import pytest

from cloth_sim_ros.physics.model.sheets.surface import (
    LAYOUTS,
    Surface,
    SurfaceError,
    grid_diagonals,
    grid_hinges,
    grid_triangles,
    opposite_pairs,
)

TETRAHEDRON = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])


def test_hinge_of_two_triangles_is_the_documented_picture() -> None:
    surface = Surface.from_triangles([[0, 1, 2], [1, 0, 3]])
    assert surface.hinges.tolist() == [[0, 1, 2, 3]]
    assert surface.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3]]
    assert surface.edge_triangles[0].tolist() == [0, 1]
    assert [loop.tolist() for loop in surface.boundary_loops()] == [[0, 3, 1, 2]]
    assert not surface.is_closed


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (2, 5), (4, 3), (7, 6)])
def test_grid_is_a_disc_with_every_hinge_from_its_triangles(rows: int, columns: int, layout: str) -> None:
    triangles = grid_triangles(rows, columns, layout)
    surface = Surface.from_triangles(triangles, particle_count=rows * columns)
    # Euler: vertices - edges + faces = 1 for a disc
    assert rows * columns - len(surface.edges) + len(triangles) == 1
    assert len(surface.boundary_edges) == 2 * (rows - 1) + 2 * (columns - 1)
    assert len(surface.boundary_loops()) == 1
    # brute force: two triangles share exactly two particles
    expected = set()
    for first, second in itertools.combinations(map(set, triangles.tolist()), 2):
        if len(first & second) == 2:
            expected.add((frozenset(first & second), frozenset(first ^ second)))
    hinges = {(frozenset(h[:2]), frozenset(h[2:])) for h in surface.hinges.tolist()}
    assert hinges == expected and len(surface.hinges) == len(expected)
    # each hinge's two triangles, as directed by it, are triangles of the surface
    rings = {tuple(np.roll(t, k)) for t in triangles for k in range(3)}
    for edge0, edge1, wing0, wing1 in surface.hinges:
        assert (edge0, edge1, wing0) in rings and (edge1, edge0, wing1) in rings


@pytest.mark.parametrize("layout", LAYOUTS)
def test_grid_triangles_are_counter_clockwise_along_diagonals(layout: str) -> None:
    rows, columns = 4, 5
    row, column = np.divmod(np.arange(rows * columns), columns)
    triangles = grid_triangles(rows, columns, layout)
    a, b, c = (np.stack((column[k], row[k]), axis=-1) for k in triangles.T)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert np.all(area == 1)
    edges = {tuple(e) for e in Surface.from_triangles(triangles).edges.tolist()}
    diagonals = [tuple(sorted(d)) for d in grid_diagonals(rows, columns, layout).tolist()]
    if layout == "both":
        cut = {tuple(sorted(d)) for d in grid_diagonals(rows, columns, "alternating").tolist()}
        assert set(diagonals) & edges == cut
    else:
        assert set(diagonals) <= edges
    left = [(row[a] + 1, column[a] + 1) == (row[b], column[b]) for a, b in diagonals]
    cells = [(r, c) for r in range(rows - 1) for c in range(columns - 1)]
    expected = {
        "left": [True] * len(cells),
        "right": [False] * len(cells),
        "alternating": [(r + c) % 2 == 0 for r, c in cells],
        "both": [True, False] * len(cells),
    }[layout]
    assert left == expected


def test_the_other_diagonal_is_not_counted_twice() -> None:
    surface = Surface.from_triangles(grid_triangles(3, 3, "both"))
    pairs = opposite_pairs(surface.hinges)
    assert len(pairs) == len(surface.hinges) == 8
    new_pairs = opposite_pairs(surface.hinges, grid_diagonals(3, 3, "both"))
    diagonals = {tuple(sorted(d)) for d in grid_diagonals(3, 3, "both").tolist()}
    assert len(new_pairs) == 4
    assert not {tuple(sorted(p)) for p in new_pairs.tolist()} & diagonals


def test_closed_surface() -> None:
    surface = Surface.from_triangles(TETRAHEDRON)
    assert surface.is_closed and len(surface.hinges) == 6 and surface.boundary_loops() == []


def test_pieces_are_counted() -> None:
    surface = Surface.from_triangles([[0, 1, 2], [3, 4, 5], [2, 1, 6]])
    assert surface.pieces().tolist() == [0, 1, 0]


def test_no_triangles_is_an_empty_surface() -> None:
    surface = Surface.from_triangles([], particle_count=3)
    assert surface.particle_count == 3 and surface.edges.shape == (0, 2) and surface.hinges.shape == (0, 4)


@pytest.mark.parametrize(
    ("triangles", "message"),
    [
        ([[0, 1, 2], [1, 0, 3], [0, 1, 4]], r"edge \(0, 1\) belongs to 3 triangles, \[0, 1, 2\]"),
        ([[0, 1, 2], [0, 1, 3]], r"triangles 0 and 1 run the same way .*\(0, 1\)"),
        ([[0, 1, 2], [0, 3, 4]], "at particle 0 two parts"),
        ([[0, 1, 1]], "triangle 0 is .* must be different"),
        ([[0, 1, 9]], "triangle 0 is .* from 0 to 4"),
        ([[0.0, 1.0, 2.0]], "whole numbers"),
    ],
)
def test_bad_surfaces_are_refused_with_the_place(triangles: list, message: str) -> None:
    with pytest.raises(SurfaceError, match=message):
        Surface.from_triangles(triangles, particle_count=5)


def test_two_closed_fans_in_one_particle_are_refused() -> None:
    second_fan = TETRAHEDRON.copy()
    second_fan[second_fan > 0] += 3
    with pytest.raises(SurfaceError, match="at particle 0 two parts"):
        Surface.from_triangles(np.concatenate((TETRAHEDRON, second_fan)))


@pytest.mark.parametrize(("rows", "columns"), [(2, 3), (4, 5), (5, 4)])
def test_grid_hinges_are_those_of_both_checkerboards(rows: int, columns: int) -> None:
    hinges = grid_hinges(rows, columns)
    checkerboard = Surface.from_triangles(grid_triangles(rows, columns, "alternating")).hinges
    assert hinges[: len(checkerboard)].tolist() == checkerboard.tolist()
    assert len(hinges) == 2 * len(checkerboard)
    # together they are the same after a shift by one cell, as one checkerboard is not: every cell has both diagonals
    quads = {(frozenset(h[:2]), frozenset(h[2:])) for h in hinges.tolist()}
    assert len(quads) == len(hinges)
    for a, b in grid_diagonals(rows, columns, "both").tolist():
        assert sum(edge == {a, b} for edge, _ in quads) == 1
