# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Normal and strain of each particle of a cloud.

The strain of a particle is the largest relative elongation (l - l0) / l0 of its edges, or 0 if no edge is stretched.
Edges are those of the surface's triangles. A grid also has the other diagonal of each cell, to favour no direction. The
lengths l0 come from the recorded rest shape.

The viewer lights a point by its normal, for both sides alike. If the normals at the start face away from the viewer's
main light, all normals are flipped, so that the sheet shows its bright side.

A grid uses whole-array operations on shifted views, several times faster than gathering: a long session has 10^8
particle positions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Direction of the viewer's main light. A second one, half as strong, comes from about the opposite side.
_LIGHT = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
#: Bound that keeps a vanishing normal finite, far below the area of a cloth's triangle [m^2].
_MIN_NORMAL = np.float32(1e-30)


class SurfaceGeometry(ABC):
    """Base class for normals and strains of the clouds of one surface, a mesh or a grid."""

    @abstractmethod
    def compute(self, xyz: Floats, normals: Floats, strain: Floats) -> None:
        """Write unit normals (n, 3) and largest strains (n,) of particles at xyz (n, 3) [m] into given arrays."""


def make_surface_geometry(
    triangles: NDArray[np.uint32],
    rest_positions: NDArray[np.float64],
    start: NDArray[np.float64],
    rows: int,
    columns: int,
) -> SurfaceGeometry:
    """Return the geometry of clouds: of a grid of rows x columns particles, or of a mesh if one is 1.

    Args:
        triangles: particles of each triangle, shape (m, 3).
        rest_positions: rest shape [m], shape (n, 3), in any frame.
        start: positions that determine the bright side [m], shape (n, 3).
        rows: height of the clouds.
        columns: width of the clouds.
    """
    if rows > 1 and columns > 1:
        return GridGeometry(rest_positions, start, rows, columns)
    return MeshGeometry(triangles, rest_positions, start)


class MeshGeometry(SurfaceGeometry):
    """Geometry of a triangle mesh: normals are area-weighted means over triangles."""

    def __init__(
        self, triangles: NDArray[np.uint32], rest_positions: NDArray[np.float64], start: NDArray[np.float64]
    ) -> None:
        faces = np.asarray(triangles, dtype=np.intp)
        self._faces = faces
        self._corner_order, self._corner_starts, self._used = _group_equal(faces.T.ravel())
        sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        self._edges = np.unique(np.sort(sides, axis=1), axis=0)
        ends = self._edges
        lengths = np.linalg.norm(rest_positions[ends[:, 1]] - rest_positions[ends[:, 0]], axis=1)
        self._inverse_rest2 = (1.0 / np.maximum(lengths, 1e-12) ** 2).astype(np.float32)
        self._end_order, self._end_starts, _ = _group_equal(ends.T.ravel())
        self._corner_order %= max(len(faces), 1)
        self._end_order %= max(len(ends), 1)
        self._sign = np.float32(_light_sign(self._areas(np.ascontiguousarray(start.T, dtype=np.float32))))

    @np.errstate(over="ignore", invalid="ignore")
    def compute(self, xyz: Floats, normals: Floats, strain: Floats) -> None:
        """Write unit normals (n, 3) and largest strains (n,) of particles at xyz (n, 3) [m] into given arrays."""
        x = np.ascontiguousarray(xyz.T)
        total = np.zeros_like(x)
        strain.fill(1.0)
        if len(self._faces):
            area = self._areas(x)
            along = np.take(x, self._edges[:, 1], axis=1) - np.take(x, self._edges[:, 0], axis=1)
            stretch2 = np.einsum("ke,ke->e", along, along) * self._inverse_rest2
            for k in range(3):
                total[k, self._used] = np.add.reduceat(area[k, self._corner_order], self._corner_starts)
            largest = np.maximum.reduceat(stretch2[self._end_order], self._end_starts)
            strain[self._used] = np.sqrt(np.maximum(largest, 1.0))
        normals[:] = (total * (self._sign / np.sqrt(np.einsum("kn,kn->n", total, total) + _MIN_NORMAL))).T
        strain -= 1.0

    def _areas(self, x: Floats) -> Floats:
        """Return twice the area vector of each triangle [m^2], shape (3, m)."""
        a, b, c = (np.take(x, self._faces[:, k], axis=1) for k in range(3))
        b -= a
        c -= a
        return np.stack([b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]])


class GridGeometry(SurfaceGeometry):
    """Geometry of a grid of rows x columns particles: normals from differences along rows and columns."""

    def __init__(
        self, rest_positions: NDArray[np.float64], start: NDArray[np.float64], rows: int, columns: int
    ) -> None:
        self._shape = (rows, columns)
        grid = np.ascontiguousarray(rest_positions.T.reshape(3, rows, columns))
        lengths2 = [((heads - tails) ** 2).sum(axis=0) for tails, heads in _edge_families(grid)]
        self._inverse_rest2 = [(1.0 / np.maximum(length2, 1e-24)).astype(np.float32) for length2 in lengths2]
        start_grid = start.T.reshape(3, rows, columns)
        along, down = np.gradient(start_grid, axis=2), np.gradient(start_grid, axis=1)
        self._sign = np.float32(_light_sign(np.cross(along, down, axis=0).reshape(3, -1)))

    @np.errstate(over="ignore", invalid="ignore")
    def compute(self, xyz: Floats, normals: Floats, strain: Floats) -> None:
        """Write unit normals (n, 3) and largest strains (n,) of particles at xyz (n, 3) [m] into given arrays."""
        rows, columns = self._shape
        x = np.ascontiguousarray(xyz.T).reshape(3, rows, columns)
        self._normals(x, normals.reshape(rows, columns, 3))
        self._strain(x, strain.reshape(rows, columns))

    def _normals(self, x: Floats, out: Floats) -> None:
        along, down = np.empty_like(x), np.empty_like(x)
        np.subtract(x[:, :, 2:], x[:, :, :-2], out=along[:, :, 1:-1])
        np.subtract(x[:, :, 1], x[:, :, 0], out=along[:, :, 0])
        np.subtract(x[:, :, -1], x[:, :, -2], out=along[:, :, -1])
        np.subtract(x[:, 2:], x[:, :-2], out=down[:, 1:-1])
        np.subtract(x[:, 1], x[:, 0], out=down[:, 0])
        np.subtract(x[:, -1], x[:, -2], out=down[:, -1])
        normal = np.empty_like(x)
        product = np.empty_like(x[0])
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            np.multiply(along[i], down[j], out=normal[k])
            np.multiply(along[j], down[i], out=product)
            normal[k] -= product
        length2 = np.einsum("krc,krc->rc", normal, normal)
        length2 += _MIN_NORMAL
        np.sqrt(length2, out=length2)
        np.divide(self._sign, length2, out=length2)
        np.multiply(normal.transpose(1, 2, 0), length2[..., None], out=out)

    def _strain(self, x: Floats, out: Floats) -> None:
        out.fill(1.0)
        families = zip(_edge_families(x), self._inverse_rest2, _edge_families(out), strict=True)
        for (tails, heads), inverse, (tail_out, head_out) in families:
            along = heads - tails
            stretch2 = np.einsum("krc,krc->rc", along, along)
            stretch2 *= inverse
            np.maximum(tail_out, stretch2, out=tail_out)
            np.maximum(head_out, stretch2, out=head_out)
        np.sqrt(out, out=out)
        out -= 1.0


def _edge_families(grid: NDArray[Any]) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """Return views of both ends of a grid's edges: along rows, columns and both diagonals, (..., rows, columns)."""
    return [
        (grid[..., :, :-1], grid[..., :, 1:]),
        (grid[..., :-1, :], grid[..., 1:, :]),
        (grid[..., :-1, :-1], grid[..., 1:, 1:]),
        (grid[..., :-1, 1:], grid[..., 1:, :-1]),
    ]


def _light_sign(areas: NDArray[np.floating]) -> float:
    """Return the sign that turns area vectors (3, m) to the light: -1.0 if their sum faces away, else 1.0."""
    towards = float(_LIGHT @ areas.sum(axis=1))
    total = float(np.linalg.norm(areas, axis=0).sum())
    return -1.0 if towards < -1e-3 * total else 1.0


def _group_equal(values: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the order that groups equal values, the start of each group in it, and the distinct values."""
    order = np.argsort(values, kind="stable")
    used, starts = np.unique(values[order], return_index=True)
    return order, starts, used
