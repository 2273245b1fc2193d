# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closed triangle meshes as obstacles: validity checks and signed distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import dot_products, ordered_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.merging import component_labels
from cloth_sim_ros.physics.model.sheets.meshes import FLATNESS
from cloth_sim_ros.physics.model.sheets.seams import open_seam

#: Largest number of point-triangle pairs that are calculated at once.
_MAX_PRODUCTS = 1 << 18


def check_closed(vertices: Array, triangles: NDArray[np.int64], max_coordinate: float) -> None:
    """Raise ValueError if a mesh is open, degenerate or inside out.

    Args:
        vertices: positions [m], shape (m, 3).
        triangles: vertex indices, shape (t, 3).
        max_coordinate: largest coordinate [m].

    Raises:
        ValueError: naming the vertices or triangles, counted from 0.
    """
    _check_arrays(vertices, triangles, max_coordinate)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    sides = np.stack([b - a, c - b, a - c])
    longest = np.sqrt(dot_products(sides, sides).max(axis=0))
    normals = np.cross(sides[0], -sides[2])
    area2 = np.sqrt(dot_products(normals, normals))
    flat = np.flatnonzero(~(area2 > FLATNESS * longest * longest))
    if flat.size:
        raise ValueError(
            f"triangle {flat[0]}, of vertices {triangles[flat[0]].tolist()} at {_format_point(a[flat[0]])} m, has no "
            f"area: its height is at most {FLATNESS:g} of its longest side. To leave it out opens the mesh: merge its "
            "vertices, or give the mesh as a file, where such triangles are joined to their neighbours"
        )
    # Every edge of a closed mesh occurs once in each direction.
    half_edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    count = len(vertices)
    edge_keys, edge_counts = np.unique(half_edges[:, 0] * count + half_edges[:, 1], return_counts=True)
    if edge_counts.max() > 1:
        first, second = divmod(int(edge_keys[np.argmax(edge_counts > 1)]), count)
        raise ValueError(
            f"the edge from vertex {first} to {second} runs the same way in {edge_counts.max()} triangles: wind the "
            "mesh one way, each edge in two triangles"
        )
    open_edges = edge_keys[~np.isin(edge_keys, half_edges[:, 1] * count + half_edges[:, 0])]
    if open_edges.size:
        first, second = divmod(int(open_edges[0]), count)
        raise ValueError(
            f"the mesh is open: the edge from vertex {first} to {second}, at {_format_point(vertices[first])} m, is in "
            f"one triangle alone, as are {open_edges.size - 1} others; "
            + _describe_gap(vertices, triangles, np.stack(np.divmod(open_edges, count), axis=1))
            + "close it, or give a solid shape instead"
        )
    for piece, members in enumerate(_connected_pieces(triangles, count)):
        origin = vertices[triangles[members[0], 0]]
        corner0, corner1, corner2 = (corner[members] - origin for corner in (a, b, c))
        volume = ordered_sum(dot_products(corner0, np.cross(corner1, corner2)).tolist()) / 6.0
        if not volume > 0.0:
            raise ValueError(
                f"piece {piece} of the mesh, with triangle {members[0]}, has the volume {volume:.3g} m^3: it is inside "
                "out. Reverse its triangles, so that each runs counterclockwise seen from outside; leave cavities out"
            )


def _format_point(vertex: Array) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in vertex) + "]"


def _describe_gap(vertices: Array, triangles: NDArray[np.int64], border: NDArray[np.int64]) -> str:
    """Describe the narrowest gap of an open mesh for an error text; empty if its border is far apart everywhere."""
    seam = open_seam(vertices, triangles, border)
    if seam is None:
        return ""
    return (
        f"parts of its border nearly meet, the closest {seam.distance:.3g} m apart, at "
        f"{_format_point(vertices[seam.vertex])} m: merge by distance in the program that made it; or "
    )


def _check_arrays(vertices: Array, triangles: NDArray[np.int64], max_coordinate: float) -> None:
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) < 4:
        raise ValueError(f"vertices have shape {vertices.shape}; they must be (m, 3), at least 4")
    if triangles.ndim != 2 or triangles.shape[1:] != (3,) or triangles.dtype.kind not in "iu":
        raise ValueError(
            f"triangles have shape {triangles.shape} and type {triangles.dtype}; they must be whole numbers (t, 3)"
        )
    bad = np.flatnonzero(~(np.abs(vertices) <= max_coordinate).all(axis=1))
    if bad.size:
        raise ValueError(
            f"vertex {bad[0]} is {vertices[bad[0]].tolist()} m; its coordinates must be finite, none beyond "
            f"{max_coordinate:g} m; if its file is not in metres, set the obstacle's scale"
        )
    wrong = np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))
    if wrong.size:
        raise ValueError(
            f"triangle {wrong[0]} is {triangles[wrong[0]].tolist()}; vertices are 0 to {len(vertices) - 1}"
        )


def _connected_pieces(triangles: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Return the indices of the triangles of each connected piece of a mesh."""
    label = component_labels(np.concatenate([triangles[:, :2], triangles[:, 1:]]), count)
    piece = label[triangles[:, 0]]
    return [np.flatnonzero(piece == piece_label) for piece_label in np.unique(piece)]


def mesh_distance(points: Array, vertices: Array, triangles: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return signed distances [m] of points from a closed mesh, negative inside, and outward unit normals.

    Args:
        points: positions [m], shape (m, 3).
        vertices: mesh vertices [m], shape (n, 3).
        triangles: vertex indices, shape (t, 3).

    Returns:
        Gaps [m], shape (m,), negative inside, and unit normals, shape (m, 3).
    """
    gaps, normals = np.empty(len(points)), np.empty((len(points), 3))
    corners = vertices[triangles]
    step = max(1, _MAX_PRODUCTS // len(triangles))
    for begin in range(0, len(points), step):
        part = slice(begin, begin + step)
        gaps[part], normals[part] = _signed_distance(points[part], corners)
    return gaps, normals


def _signed_distance(p: Array, corners: Array) -> tuple[Array, Array]:
    offsets = p[:, None, :] - nearest_points(p, corners)
    square = (offsets * offsets).sum(axis=2)
    best = np.argmin(square, axis=1)
    rows = np.arange(len(p))
    distance, vector = np.sqrt(square[rows, best]), offsets[rows, best]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.sqrt((face * face).sum(axis=1))[:, None]
    sign = np.where(_winding_number(p, corners) > 0.5, -1.0, 1.0)
    # On the surface the outward direction is the triangle's normal.
    scale = np.abs(corners).max()
    is_off_surface = distance > 1e-12 * scale
    divisor = np.where(is_off_surface, distance, 1.0)
    normal = np.where(is_off_surface[:, None], vector * (sign / divisor)[:, None], face[best])
    return sign * distance, normal


def nearest_points(p: Array, corners: Array) -> Array:
    """Return the point of each triangle (t, 3, 3) that is nearest to each point (m, 3), shape (m, t, 3).

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
        edge = end - begin
        fraction = np.clip(((p[:, None, :] - begin) * edge).sum(axis=2) / (edge * edge).sum(axis=1), 0.0, 1.0)
        foot = begin + fraction[:, :, None] * edge
        offset = p[:, None, :] - foot
        squared_distance = (offset * offset).sum(axis=2)
        is_nearer = squared_distance < square
        best = np.where(is_nearer[:, :, None], foot, best)
        square = np.where(is_nearer, squared_distance, square)
    return best


def _winding_number(p: Array, corners: Array) -> Array:
    """Return the winding number of a closed mesh about each point, (m,): 1 inside, 0 outside.

    It is the sum of the triangles' solid angles over that of a sphere (A. van Oosterom and J. Strackee, "The solid
    angle of a plane triangle", IEEE Transactions on Biomedical Engineering 30, 1983).
    """
    a, b, c = (corners[None, :, k] - p[:, None, :] for k in range(3))
    la, lb, lc = (np.sqrt((arm * arm).sum(axis=2)) for arm in (a, b, c))
    numerator = (a * np.cross(b, c)).sum(axis=2)
    denominator = la * lb * lc + (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    total: Array = np.arctan2(numerator, denominator).sum(axis=1) / (2.0 * np.pi)
    return total
