# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closed triangle meshes as obstacles: validity checks and signed distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.powers import in_order, scalar_products
from cloth_sim_ros.physics.sheets.meshes import FLATNESS
from cloth_sim_ros.physics.sheets.seams import open_seam

#: Largest number of point-triangle pairs that are calculated at once.
_AT_ONCE = 1 << 18


def check_closed(vertices: Array, triangles: NDArray[np.int64], most: float) -> None:
    """Refuse a mesh that is open, degenerate or inside out.

    Args:
        vertices: positions [m], shape (m, 3).
        triangles: vertex indices, shape (t, 3).
        most: largest coordinate [m].

    Raises:
        ValueError: naming the vertices or triangles, counted from 0.
    """
    _check_arrays(vertices, triangles, most)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    sides = np.stack([b - a, c - b, a - c])
    longest = np.sqrt(scalar_products(sides, sides).max(axis=0))
    across = np.cross(sides[0], -sides[2])
    area2 = np.sqrt(scalar_products(across, across))
    flat = np.flatnonzero(~(area2 > FLATNESS * longest * longest))
    if flat.size:
        raise ValueError(
            f"triangle {flat[0]}, of vertices {triangles[flat[0]].tolist()} at {_point(a[flat[0]])} m, has no area: "
            f"its height is at most {FLATNESS:g} of its longest side. To leave it out opens the mesh: merge its "
            "vertices, or give the mesh as a file, where such triangles are joined to their neighbours"
        )
    # Every edge of a closed mesh occurs once in each direction.
    ways = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    count = len(vertices)
    there, times = np.unique(ways[:, 0] * count + ways[:, 1], return_counts=True)
    if times.max() > 1:
        first, second = divmod(int(there[np.argmax(times > 1)]), count)
        raise ValueError(
            f"the edge from vertex {first} to {second} runs the same way in {times.max()} triangles: wind the mesh "
            "one way, each edge in two triangles"
        )
    open_ways = there[~np.isin(there, ways[:, 1] * count + ways[:, 0])]
    if open_ways.size:
        first, second = divmod(int(open_ways[0]), count)
        raise ValueError(
            f"the mesh is open: the edge from vertex {first} to {second}, at {_point(vertices[first])} m, is in one "
            f"triangle alone, as are {open_ways.size - 1} others; "
            + _gap(vertices, triangles, np.stack(np.divmod(open_ways, count), axis=1))
            + "close it, or give a solid shape instead"
        )
    for piece, members in enumerate(_pieces(triangles, count)):
        middle = vertices[triangles[members[0], 0]]
        one, two, three = (corner[members] - middle for corner in (a, b, c))
        volume = in_order(scalar_products(one, np.cross(two, three)).tolist()) / 6.0
        if not volume > 0.0:
            raise ValueError(
                f"piece {piece} of the mesh, with triangle {members[0]}, has the volume {volume:.3g} m^3: it is inside "
                "out. Reverse its triangles, so that each runs counterclockwise seen from outside; leave cavities out"
            )


def _point(vertex: Array) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in vertex) + "]"


def _gap(vertices: Array, triangles: NDArray[np.int64], border: NDArray[np.int64]) -> str:
    """Describe the narrowest gap of an open mesh; empty if its border lies far apart everywhere."""
    seam = open_seam(vertices, triangles, border)
    if seam is None:
        return ""
    return (
        f"parts of its border nearly meet, the closest {seam.distance:.3g} m apart, at "
        f"{_point(vertices[seam.vertex])} m: merge by distance in the program that made it; or "
    )


def _check_arrays(vertices: Array, triangles: NDArray[np.int64], most: float) -> None:
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) < 4:
        raise ValueError(f"vertices have shape {vertices.shape}; they must be (m, 3), at least 4")
    if triangles.ndim != 2 or triangles.shape[1:] != (3,) or triangles.dtype.kind not in "iu":
        raise ValueError(
            f"triangles have shape {triangles.shape} and type {triangles.dtype}; they must be whole numbers (t, 3)"
        )
    bad = np.flatnonzero(~(np.abs(vertices) <= most).all(axis=1))
    if bad.size:
        raise ValueError(
            f"vertex {bad[0]} is {vertices[bad[0]].tolist()} m; its coordinates must be finite, none beyond "
            f"{most:g} m; if its file is not in metres, set the obstacle's scale"
        )
    wrong = np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))
    if wrong.size:
        raise ValueError(
            f"triangle {wrong[0]} is {triangles[wrong[0]].tolist()}; vertices are 0 to {len(vertices) - 1}"
        )


def _pieces(triangles: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Return the triangles of each connected piece."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    joined = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, label = connected_components(joined, directed=False)
    piece = label[triangles[:, 0]]
    return [np.flatnonzero(piece == one) for one in np.unique(piece)]


def mesh_distance(points: Array, vertices: Array, triangles: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return signed gaps and normals of points to a closed mesh.

    Args:
        points: positions [m], shape (m, 3).
        vertices: mesh vertices [m], shape (n, 3).
        triangles: vertex indices, shape (t, 3).

    Returns:
        Gaps [m], shape (m,), negative inside, and unit normals, shape (m, 3).
    """
    gaps, normals = np.empty(len(points)), np.empty((len(points), 3))
    corners = vertices[triangles]
    step = max(1, _AT_ONCE // len(triangles))
    for begin in range(0, len(points), step):
        part = slice(begin, begin + step)
        gaps[part], normals[part] = _distance(points[part], corners)
    return gaps, normals


def _distance(p: Array, corners: Array) -> tuple[Array, Array]:
    away = p[:, None, :] - nearest_points(p, corners)
    square = (away * away).sum(axis=2)
    best = np.argmin(square, axis=1)
    rows = np.arange(len(p))
    distance, vector = np.sqrt(square[rows, best]), away[rows, best]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.sqrt((face * face).sum(axis=1))[:, None]
    sign = np.where(_winding(p, corners) > 0.5, -1.0, 1.0)
    # On the surface the outward direction is the triangle's normal.
    scale = np.abs(corners).max()
    away_from_it = distance > 1e-12 * scale
    divisor = np.where(away_from_it, distance, 1.0)
    normal = np.where(away_from_it[:, None], vector * (sign / divisor)[:, None], face[best])
    return sign * distance, normal


def nearest_points(p: Array, corners: Array) -> Array:
    """Return the nearest points of triangles (t, 3, 3) to points (m, 3), shape (m, t, 3).

    This is the foot on the triangle's plane if it lies inside the triangle, else the nearest foot on a side.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area2 = (normal * normal).sum(axis=1)
    height = ((p[:, None, :] - a) * normal).sum(axis=2) / area2
    best = p[:, None, :] - height[:, :, None] * normal
    inside = np.ones(best.shape[:2], dtype=bool)
    for begin, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - begin, best - begin) * normal).sum(axis=2) >= 0.0
    square = np.where(inside, height * height * area2, np.inf)
    for begin, end in ((a, b), (b, c), (c, a)):
        side = end - begin
        share = np.clip(((p[:, None, :] - begin) * side).sum(axis=2) / (side * side).sum(axis=1), 0.0, 1.0)
        foot = begin + share[:, :, None] * side
        away = p[:, None, :] - foot
        here = (away * away).sum(axis=2)
        nearer = here < square
        best = np.where(nearer[:, :, None], foot, best)
        square = np.where(nearer, here, square)
    return best


def _winding(p: Array, corners: Array) -> Array:
    """Return the winding number of a closed mesh about each point, (m,): 1 inside, 0 outside.

    It is the sum of the triangles' solid angles over that of a sphere (A. van Oosterom and J. Strackee, "The solid
    angle of a plane triangle", IEEE Transactions on Biomedical Engineering 30, 1983).
    """
    a, b, c = (corners[None, :, k] - p[:, None, :] for k in range(3))
    la, lb, lc = (np.sqrt((side * side).sum(axis=2)) for side in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=2)
    below = la * lb * lc + (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    total: Array = np.arctan2(volume, below).sum(axis=1) / (2.0 * np.pi)
    return total
