# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Repair of triangle meshes that are closed except for rounding and flat triangles.

CAD programs triangulate each face of a solid separately. At a T-junction one face has a vertex in the middle of
another's edge. The edge stays whole on one side, or a triangle without area fills the gap. Four steps close such a
mesh. They move its surface by no more than the flatness of the triangles that they remove:

1. Merge vertices that are copies of one, up to rounding. Merge the ends of a side that is short beside the longest side
   of a flat triangle.
2. Remove two triangles that lie back to back, and copies of a triangle.
3. Remove flat triangles: each leaves a T-junction at its middle corner.
4. Split an open edge at the vertices of the border that lie on it.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.obstacle_mesh import check_closed
from cloth_sim_ros.physics.powers import scalar_products
from cloth_sim_ros.physics.sheets.merging import clusters
from cloth_sim_ros.physics.sheets.meshes import FLATNESS
from cloth_sim_ros.physics.sheets.seams import near_edges

#: Largest distance of a vertex that lies on an edge, as a fraction of the edge's length: flat triangles may overlap.
_ON_EDGE = 4.0 * FLATNESS
#: Coordinates beyond this have no volume in double precision; the checks of an obstacle refuse such a mesh.
_MAX_COORDINATE = 1e100
#: Rounds of the steps: each splits every triangle along one side.
_MAX_ROUNDS = 12


def is_closed(vertices: Array, triangles: NDArray[np.int64]) -> bool:
    """Return true if a mesh of vertices (m, 3) [m] and triangles (t, 3) is closed without repair."""
    try:
        check_closed(vertices, triangles, _MAX_COORDINATE)
    except ValueError:
        return False
    return True


def used_vertices(vertices: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Remove vertices (m, 3) [m] that no triangle (t, 3) uses."""
    used = np.unique(triangles)
    new_index = np.zeros(len(vertices), dtype=np.int64)
    new_index[used] = np.arange(len(used))
    return np.ascontiguousarray(vertices[used]), new_index[triangles]


def closed_solid(
    vertices: Array, triangles: NDArray[np.int64], limit: float
) -> tuple[Array, NDArray[np.int64], tuple[str, ...]]:
    """Close a mesh by the steps of this module; other openings stay.

    Args:
        vertices: positions [m], shape (m, 3).
        triangles: vertex indices, shape (t, 3).
        limit: distance below which two vertices are copies of one [m].

    Returns:
        The remaining vertices and triangles, and a sentence on each step that changed the mesh.
    """
    if not np.all(np.abs(vertices) <= _MAX_COORDINATE):
        return vertices, triangles, ()
    lowest = clusters(vertices, limit)
    merged = int(np.count_nonzero(lowest != np.arange(len(vertices))))
    triangles = _without_twins(lowest[triangles])
    notes = []
    if merged:
        notes.append(f"{_counted(merged, 'vertex', 'vertices')} closer than {limit:.3g} to another merged with it")
    closed, joined = _joined(vertices, triangles, limit, height=0.0)
    if not is_closed(vertices, closed):
        # Rounding may leave some triangles of a T-junction flat, and others thin.
        thinner, further = _joined(vertices, triangles, limit, height=2.0 * limit)
        if is_closed(vertices, thinner):
            closed, joined = thinner, further
    return *used_vertices(vertices, closed), (*notes, *joined)


def _joined(
    vertices: Array, triangles: NDArray[np.int64], limit: float, *, height: float
) -> tuple[NDArray[np.int64], list[str]]:
    """Join flat triangles, and those of at most a height [m], to their neighbours; return a sentence on each change."""
    flat = split = 0
    for _ in range(_MAX_ROUNDS):
        if not len(triangles):
            break
        triangles, needles = _without_needles(vertices, triangles, height)
        thin = _flat(vertices, triangles, height)
        triangles = triangles[~thin]
        triangles, cuts = _split_edges(vertices, triangles, limit)
        flat += needles + int(np.count_nonzero(thin))
        split += cuts
        if not (needles or np.any(thin) or cuts):
            break
    notes = []
    if flat:
        notes.append(f"{_counted(flat, 'triangle', 'triangles')} without area joined to the neighbours")
    if split:
        notes.append(f"{_counted(split, 'edge', 'edges')} split at vertices that lie on it")
    return triangles, notes


def _sides(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Return the lengths of the sides from each corner to the next [m], (t, 3)."""
    corners = vertices[triangles]
    away = np.roll(corners, -1, axis=1) - corners
    lengths: Array = np.sqrt(scalar_products(away, away))
    return lengths


def _flat(vertices: Array, triangles: NDArray[np.int64], height: float) -> NDArray[np.bool_]:
    """Return a mask of the triangles without area, as in `check_closed`, or of at most a height [m], (t,)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    longest = _sides(vertices, triangles).max(axis=1)
    least = np.maximum(FLATNESS * longest, height)
    flat: NDArray[np.bool_] = ~(np.sqrt(scalar_products(across, across)) > least * longest)
    return flat


def _without_twins(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Remove triangles with a repeated corner, pairs that lie back to back, and copies."""
    first_corner, second_corner, third_corner = triangles.T
    triangles = triangles[
        (first_corner != second_corner) & (second_corner != third_corner) & (third_corner != first_corner)
    ]
    # Rotated so that the lowest corner comes first.
    first = np.argmin(triangles, axis=1)
    turned = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
    back = turned[:, 1] > turned[:, 2]
    _, which = np.unique(np.sort(triangles, axis=1), axis=0, return_inverse=True)
    which = which.reshape(-1)
    fronts, backs = (np.bincount(which[mask], minlength=len(triangles)) for mask in (~back, back))
    # One triangle stays if no triangle of the opposite orientation exists.
    keep = (fronts[which] == 0) | (backs[which] == 0)
    _, original = np.unique(which, return_index=True)
    keep &= np.isin(np.arange(len(triangles)), original)
    return triangles[keep]


def _without_needles(vertices: Array, triangles: NDArray[np.int64], height: float) -> tuple[NDArray[np.int64], int]:
    """Merge the ends of the short side of flat triangles that have one; return their number, too."""
    sides = _sides(vertices, triangles)
    needle = _flat(vertices, triangles, height) & (sides.min(axis=1) <= _ON_EDGE * sides.max(axis=1))
    count = int(np.count_nonzero(needle))
    if not count:
        return triangles, 0
    rows = triangles[needle]
    begin = np.argmin(sides[needle], axis=1)
    at = np.arange(count)
    ends = np.stack((rows[at, begin], rows[at, (begin + 1) % 3]), axis=1)
    label = _connected(ends, len(vertices))
    _, first = np.unique(label, return_index=True)
    return _without_twins(first[label].astype(np.int64)[triangles]), count


def _connected(edges: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return a component label of each of `count` vertices, (count,), for edges (e, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _split_edges(vertices: Array, triangles: NDArray[np.int64], limit: float) -> tuple[NDArray[np.int64], int]:
    """Split open edges at border vertices that lie on them, one side of each triangle; return the number of split
    edges.
    """
    if not len(triangles):
        return triangles, 0
    count = len(vertices)
    tails, heads, thirds = (np.concatenate([triangles[:, (k + at) % 3] for k in range(3)]) for at in range(3))
    is_open = ~np.isin(tails * count + heads, heads * count + tails)
    if not np.any(is_open):
        return triangles, 0
    from scipy.spatial import cKDTree

    owner = np.flatnonzero(is_open) % len(triangles)
    tails, heads, thirds = tails[is_open], heads[is_open], thirds[is_open]
    border = np.unique(np.concatenate((tails, heads)))
    sides = vertices[heads] - vertices[tails]
    lengths = np.sqrt(scalar_products(sides, sides))
    tree = cKDTree(vertices[border])
    edges, which = near_edges(vertices, np.stack((tails, heads), axis=1), tree, lengths)
    middle = border[which]
    away = vertices[middle] - vertices[tails[edges]]
    share = scalar_products(away, sides[edges]) / (lengths[edges] * lengths[edges])
    foot = away - share[:, None] * sides[edges]
    tolerance = np.maximum(4.0 * limit, _ON_EDGE * lengths[edges])
    lies_on = (scalar_products(foot, foot) <= tolerance * tolerance) & (share > 0.0) & (share < 1.0)
    lies_on &= (middle != tails[edges]) & (middle != heads[edges]) & (middle != thirds[edges])
    # Edge and vertex must be on one border.
    gap = _connected(np.stack((tails, heads), axis=1), len(vertices))
    lies_on &= gap[middle] == gap[tails[edges]]
    cuts: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for edge, position, vertex in zip(edges[lies_on], share[lies_on], middle[lies_on], strict=True):
        cuts[int(edge)].append((float(position), int(vertex)))
    left = np.ones(len(triangles), dtype=np.bool_)
    further: list[tuple[int, int, int]] = []
    done = 0
    for edge in sorted(cuts):
        if left[owner[edge]]:
            left[owner[edge]] = False
            chain = [int(tails[edge]), *(vertex for _, vertex in sorted(cuts[edge])), int(heads[edge])]
            further.extend((tail, head, int(thirds[edge])) for tail, head in pairwise(chain))
            done += 1
    if not done:
        return triangles, 0
    return np.concatenate((triangles[left], np.array(further, dtype=np.int64))), done


def _counted(count: int, singular: str, plural: str) -> str:
    return f"{count} {singular if count == 1 else plural}"
