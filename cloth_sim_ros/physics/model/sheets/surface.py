# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topology of a triangulated surface, and triangles and diagonals of a grid.

A *hinge* is an interior edge with its two triangles. It is written as four particles `(edge0, edge1, wing0, wing1)`. In
this picture the normal points to the viewer.

            edge1
           /  |  \\
      wing0   |   wing1
           \\  |  /
            edge0

Its triangles are `(edge0, edge1, wing0)` and `(edge1, edge0, wing1)`. Both run counter-clockwise here. The opposite
vertices `wing0, wing1` are the ends of the lecture's bending spring (S7). Together with the edge they are a tetrahedron
(S8, S9).
"""

from __future__ import annotations

from typing import Literal

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.model.sheets.merging import component_labels

Layout = Literal["left", "right", "alternating", "both"]
LAYOUTS: tuple[Layout, ...] = ("left", "right", "alternating", "both")

IndexArray = NDArray[np.int64]
#: For tables that stay in memory as long as the cloth exists: half the size.
ShortIndexArray = NDArray[np.int32]


class SurfaceError(ValueError):
    """Error for triangles that are no oriented manifold surface; the message names the position."""


@attrs.frozen(eq=False, kw_only=True)
class Surface:
    """Oriented manifold surface with or without boundary, of one or more pieces.

    Build it with `Surface.from_triangles`, which checks; the constructor does not.
    """

    particle_count: int
    """Number of particles; every index is below it. Particles in no triangle are allowed (a loose thread)."""
    triangles: IndexArray
    """Particles of each triangle, counter-clockwise seen from the normal's side, (m, 3)."""
    edges: ShortIndexArray
    """Every edge once, lower index first, sorted, (e, 2)."""
    edge_triangles: ShortIndexArray
    """Triangles on either side of each edge, -1 for no triangle, (e, 2)."""
    boundary_edges: IndexArray
    """Edges of one triangle, directed as that triangle runs, (b, 2)."""

    @classmethod
    def from_triangles(cls, triangles: ArrayLike, *, particle_count: int | None = None) -> Surface:
        """Return the surface of triangles (m, 3); raise SurfaceError if it is no oriented manifold.

        Args:
            triangles: particles of each triangle, (m, 3).
            particle_count: number of particles; the default is the largest index + 1.

        Raises:
            SurfaceError: naming the position, for an index out of range, a triangle with a repeated particle, an edge
                of more than two triangles, two neighbours wound oppositely, or a particle in which two fans meet.
        """
        faces = _checked_triangles(triangles, particle_count)
        count = int(particle_count if particle_count is not None else faces.max(initial=-1) + 1)
        # half-edge k belongs to triangle k // 3 and faces its corner (k + 2) % 3
        tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        key = np.minimum(tail, head) * max(count, 1) + np.maximum(tail, head)
        order = np.argsort(key, kind="stable")
        _, first, inverse, uses = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
        if np.any(uses > 2):
            bad = int(np.argmax(uses > 2))
            a, b = sorted((int(tail[first[bad]]), int(head[first[bad]])))
            owners = [int(i) for i in np.flatnonzero(inverse == bad) // 3]
            raise SurfaceError(
                f"edge ({a}, {b}) belongs to {uses[bad]} triangles, {owners[:6]}; "
                "a surface has at most 2: split it there"
            )
        first_uses = np.cumsum(uses) - uses
        half_edge0 = order[first_uses]
        half_edge1 = np.where(uses == 2, order[np.minimum(first_uses + 1, max(order.size - 1, 0))], -1)
        is_inner = half_edge1 >= 0
        is_clash = is_inner & (tail[half_edge0] == tail[half_edge1])
        if np.any(is_clash):
            bad = int(np.argmax(is_clash))
            raise SurfaceError(
                f"triangles {half_edge0[bad] // 3} and {half_edge1[bad] // 3} run the same way along their shared edge "
                f"({tail[half_edge0[bad]]}, {head[half_edge0[bad]]}): turn one of them round"
            )
        surface = cls(
            particle_count=count,
            triangles=faces,
            edges=np.sort(np.stack((tail[half_edge0], head[half_edge0]), axis=1), axis=1).astype(np.int32),
            edge_triangles=np.stack((half_edge0 // 3, np.where(is_inner, half_edge1 // 3, -1)), axis=1).astype(
                np.int32
            ),
            boundary_edges=np.stack((tail[half_edge0[~is_inner]], head[half_edge0[~is_inner]]), axis=1),
        )
        surface._check_fans()
        return surface

    @property
    def hinge_edges(self) -> IndexArray:
        """Indices into `edges` of the interior edges, one for each hinge, (h,); computed at each access."""
        return np.flatnonzero(self.edge_triangles[:, 1] >= 0)

    @property
    def hinges(self) -> IndexArray:
        """Particles `(edge0, edge1, wing0, wing1)` of each interior edge, ordered as `edges`, (h, 4); a new array."""
        inner = self.hinge_edges
        low, high = self.edges[inner].T[:, :, None]
        first_triangles, second_triangles = (self.triangles[triangles] for triangles in self.edge_triangles[inner].T)
        wings = [np.sum(np.where((t != low) & (t != high), t, 0), axis=1) for t in (first_triangles, second_triangles)]
        # In the direction of the first triangle: it runs from low to high if high follows low.
        runs_along = np.any((first_triangles == low) & (np.roll(first_triangles, -1, axis=1) == high), axis=1)
        first, second = np.where(runs_along, low[:, 0], high[:, 0]), np.where(runs_along, high[:, 0], low[:, 0])
        return np.stack((first, second, *wings), axis=1)

    @property
    def is_closed(self) -> bool:
        """True if the surface has no boundary."""
        return self.boundary_edges.size == 0

    def boundary_loops(self) -> list[IndexArray]:
        """Return the particles of each closed boundary curve, in the triangles' direction, the lowest index first."""
        next_particle = {int(a): int(b) for a, b in self.boundary_edges}
        loops: list[IndexArray] = []
        for start in sorted(next_particle):
            if start not in next_particle:
                continue
            loop, particle = [], start
            while particle in next_particle:
                loop.append(particle)
                particle = next_particle.pop(particle)
            loops.append(np.array(loop, dtype=np.int64))
        return loops

    def pieces(self) -> IndexArray:
        """Return the index of the connected piece of each triangle, in order of appearance, (m,)."""
        return component_labels(self.edge_triangles[self.hinge_edges], len(self.triangles))

    def _check_fans(self) -> None:
        """Raise SurfaceError if two fans of triangles touch at a particle without sharing an edge."""
        is_split = self._split_particles()
        if np.any(is_split):
            raise SurfaceError(
                f"at particle {int(np.argmax(is_split))} two parts of the surface touch in a single point: "
                "give each part a particle of its own"
            )

    def _split_particles(self) -> NDArray[np.bool_]:
        """Return a mask of particles whose corners are not all connected through hinges, (particle_count,)."""
        size = self.triangles.size
        corner_of = np.arange(size).reshape(-1, 3)
        left, right = self.edge_triangles[self.hinge_edges].T
        edges = self.hinges[:, :2]
        ends_a, ends_b = [], []
        for end in (0, 1):
            particle = edges[:, end][:, None]
            ends_a.append(corner_of[left][self.triangles[left] == particle])
            ends_b.append(corner_of[right][self.triangles[right] == particle])
        fans = component_labels(np.stack((np.concatenate(ends_a), np.concatenate(ends_b)), axis=1), size)
        pairs = np.unique(np.stack((self.triangles.ravel(), fans), axis=1), axis=0)
        return np.bincount(pairs[:, 0], minlength=self.particle_count) > 1


def opposite_pairs(hinges: ArrayLike, existing: ArrayLike | None = None) -> IndexArray:
    """Return the pairs of opposite vertices that S7 connects, existing springs left out, in the hinges' order, (p, 2).

    Across a cell of layout `both` the opposite vertices are the other diagonal. Pairs of existing springs are left out;
    therefore no spring is counted twice.

    Args:
        hinges: (edge0, edge1, wing0, wing1), (h, 4).
        existing: pairs of existing springs, (m, 2).
    """
    quads = np.asarray(hinges, dtype=np.int64).reshape(-1, 4)
    return np.ascontiguousarray(quads[needs_opposite_spring(quads, existing)][:, 2:])


def needs_opposite_spring(hinges: ArrayLike, existing: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Return a mask (h,) of hinges that need a bending spring: no existing pair (m, 2) joins their wings."""
    wings = np.sort(np.asarray(hinges, dtype=np.int64).reshape(-1, 4)[:, 2:], axis=1)
    if existing is None:
        return np.ones(len(wings), dtype=np.bool_)
    existing_pairs = np.sort(np.asarray(existing, dtype=np.int64).reshape(-1, 2), axis=1)
    span = int(max(wings.max(initial=0), existing_pairs.max(initial=0))) + 1
    return ~np.isin(wings[:, 0] * span + wings[:, 1], existing_pairs[:, 0] * span + existing_pairs[:, 1])


def grid_triangles(rows: int, columns: int, layout: Layout) -> IndexArray:
    """Return the triangles of a grid of particles, two a cell, cut as its layout says, (2 (rows-1) (columns-1), 3).

    Particle indices are `row * columns + column`. The layout selects the diagonal that cuts cell (r, c), r and c
    counted from 0.

    - `left`: (r, c) to (r + 1, c + 1).
    - `right`: (r, c + 1) to (r + 1, c).
    - `alternating`: left if r + c is even, right if it is odd (a checkerboard).
    - `both`: springs on both diagonals. The surface is cut as `alternating`, because one cut along one family of
      diagonals twists when it is bent (docs/bending.md).

    The normal is (direction of rising column) x (direction of rising row). Triangles 2 q and 2 q + 1 are those of cell
    q = r (columns - 1) + c.
    """
    p00, p01, p10, p11, left = _cells(rows, columns, layout)
    cut_left = np.stack((p00, p01, p11, p00, p11, p10), axis=1)
    cut_right = np.stack((p00, p01, p10, p01, p11, p10), axis=1)
    return np.where(left[:, None], cut_left, cut_right).reshape(-1, 3)


def grid_cells(rows: int, columns: int) -> IndexArray:
    """Return the four particles of every cell of a grid, in order around it, (cells, 4)."""
    p00, p01, p10, p11, _ = _cells(rows, columns, "left")
    return np.stack((p00, p01, p11, p10), axis=1)


def grid_diagonals(rows: int, columns: int, layout: Layout) -> IndexArray:
    """Return the particle pairs of a grid's diagonal shear springs, (d, 2): one a cell, or two for layout `both`.

    They are in the order of cells, and of two the left one comes first.
    """
    p00, p01, p10, p11, left = _cells(rows, columns, layout)
    if layout == "both":
        return np.stack((p00, p11, p01, p10), axis=1).reshape(-1, 2)
    return np.where(left[:, None], np.stack((p00, p11), axis=1), np.stack((p01, p10), axis=1))


def grid_hinges(rows: int, columns: int) -> IndexArray:
    """Return the hinges that carry a grid's bending stiffness in every shear layout: of both checkerboards, (m, 4).

    One checkerboard has two kinds of particle, with four and with eight edges. In bending they move against each other,
    and the sheet has a Poisson's ratio of -1/3. A grid cut along one family of diagonals twists. The two checkerboards
    together, each at half strength, do neither.
    """
    return np.concatenate([Surface.from_triangles(cut).hinges for cut in checkerboards(rows, columns)])


def checkerboards(rows: int, columns: int) -> tuple[IndexArray, IndexArray]:
    """Return the triangles of a grid cut by alternating diagonals, and of the cut by the opposite diagonals."""
    left, right = grid_triangles(rows, columns, "left"), grid_triangles(rows, columns, "right")
    cells = np.arange(len(left)) // 2
    odd = (cells // (columns - 1) + cells % (columns - 1)) % 2 == 1
    return grid_triangles(rows, columns, "alternating"), np.where(odd[:, None], left, right)


def _cells(rows: int, columns: int, layout: Layout) -> tuple[IndexArray, ...]:
    """Return corners (r, c), (r, c+1), (r+1, c), (r+1, c+1) of cells and a mask of those cut left, (cells,) each."""
    if rows < 2 or columns < 2:
        raise ValueError(f"a grid surface needs at least 2 x 2 particles, not {rows} x {columns}")
    if layout not in LAYOUTS:
        raise ValueError(f"layout {layout!r} is none of {', '.join(LAYOUTS)}")
    row, column = (index.ravel() for index in np.mgrid[: rows - 1, : columns - 1])
    p00 = row * columns + column
    checkerboard = layout in ("alternating", "both")
    left = (row + column) % 2 == 0 if checkerboard else np.full(p00.shape, layout == "left")
    return p00, p00 + 1, p00 + columns, p00 + columns + 1, left


def _checked_triangles(triangles: ArrayLike, particle_count: int | None) -> IndexArray:
    """Return the particles of triangles as an (m, 3) int64 array; raise SurfaceError for bad indices."""
    index_array = np.asarray(triangles)
    if index_array.size == 0:
        index_array = np.zeros((0, 3), dtype=np.int64)
    if index_array.ndim != 2 or index_array.shape[1] != 3 or not np.issubdtype(index_array.dtype, np.integer):
        raise SurfaceError(
            f"triangles are an (m, 3) array of whole numbers, not {index_array.shape} of {index_array.dtype}"
        )
    faces = np.ascontiguousarray(index_array, dtype=np.int64)
    limit = np.iinfo(np.int32).max if particle_count is None else particle_count
    is_outside = np.any((faces < 0) | (faces >= limit), axis=1)
    if np.any(is_outside):
        bad = int(np.argmax(is_outside))
        raise SurfaceError(f"triangle {bad} is {faces[bad].tolist()}: its particles must be from 0 to {limit - 1}")
    is_repeated = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    if np.any(is_repeated):
        bad = int(np.argmax(is_repeated))
        raise SurfaceError(f"triangle {bad} is {faces[bad].tolist()}: its three particles must be different")
    return faces
