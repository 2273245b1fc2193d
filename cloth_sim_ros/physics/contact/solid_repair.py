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

from cloth_sim_ros.physics.arithmetic.deterministic_math import dot_products
from cloth_sim_ros.physics.contact.obstacle_mesh import check_closed
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.merging import clusters, component_labels
from cloth_sim_ros.physics.model.sheets.meshes import FLATNESS, pluralize
from cloth_sim_ros.physics.model.sheets.seams import near_edges

#: Largest distance of a vertex that lies on an edge, as a fraction of the edge's length: flat triangles may overlap.
_ON_EDGE = 4.0 * FLATNESS
#: Coordinates beyond this have no volume in double precision; the checks of an obstacle refuse such a mesh.
_MAX_COORDINATE = 1e100
#: Rounds of the steps: each splits every triangle along one side.
_MAX_ROUNDS = 12


def is_closed(vertices: Array, triangles: NDArray[np.int64]) -> bool:
    """Return true if a mesh is closed, and neither degenerate nor inside out, without repair."""
    try:
        check_closed(vertices, triangles, _MAX_COORDINATE)
    except ValueError:
        return False
    return True


def drop_unused_vertices(vertices: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices [m] of (m, 3) that triangles (t, 3) use, and the renumbered triangles."""
    used = np.unique(triangles)
    new_index = np.zeros(len(vertices), dtype=np.int64)
    new_index[used] = np.arange(len(used))
    return np.ascontiguousarray(vertices[used]), new_index[triangles]


def close_solid(
    vertices: Array, triangles: NDArray[np.int64], limit: float
) -> tuple[Array, NDArray[np.int64], tuple[str, ...]]:
    """Return a mesh with its rounding gaps closed, if possible: vertices, triangles, and a sentence on each change.

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
    n_merged = int(np.count_nonzero(lowest != np.arange(len(vertices))))
    triangles = _remove_duplicates(lowest[triangles])
    notes = []
    if n_merged:
        notes.append(f"{pluralize(n_merged, 'vertex', 'vertices')} closer than {limit:.3g} to another merged with it")
    closed, joined = _join_flat_triangles(vertices, triangles, limit, height=0.0)
    if not is_closed(vertices, closed):
        # Rounding may leave some triangles of a T-junction flat, and others thin.
        closed_thin, joined_thin = _join_flat_triangles(vertices, triangles, limit, height=2.0 * limit)
        if is_closed(vertices, closed_thin):
            closed, joined = closed_thin, joined_thin
    return *drop_unused_vertices(vertices, closed), (*notes, *joined)


def _join_flat_triangles(
    vertices: Array, triangles: NDArray[np.int64], limit: float, *, height: float
) -> tuple[NDArray[np.int64], list[str]]:
    """Join flat triangles, and those of at most a height [m], to neighbours; return triangles and notes on changes."""
    n_flat = n_split = 0
    for _ in range(_MAX_ROUNDS):
        if not len(triangles):
            break
        triangles, n_needles = _collapse_needles(vertices, triangles, height)
        is_thin = _is_flat(vertices, triangles, height)
        triangles = triangles[~is_thin]
        triangles, n_cuts = _split_edges(vertices, triangles, limit)
        n_flat += n_needles + int(np.count_nonzero(is_thin))
        n_split += n_cuts
        if not (n_needles or np.any(is_thin) or n_cuts):
            break
    notes = []
    if n_flat:
        notes.append(f"{pluralize(n_flat, 'triangle', 'triangles')} without area joined to the neighbours")
    if n_split:
        notes.append(f"{pluralize(n_split, 'edge', 'edges')} split at vertices that lie on it")
    return triangles, notes


def _side_lengths(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Return the lengths of triangles' sides, from each corner to the next [m], (t, 3)."""
    corners = vertices[triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    lengths: Array = np.sqrt(dot_products(edges, edges))
    return lengths


def _is_flat(vertices: Array, triangles: NDArray[np.int64], height: float) -> NDArray[np.bool_]:
    """Return a mask of the triangles without area, as in `check_closed`, or of at most a height [m], (t,)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    max_side = _side_lengths(vertices, triangles).max(axis=1)
    min_height = np.maximum(FLATNESS * max_side, height)
    flat: NDArray[np.bool_] = ~(np.sqrt(dot_products(normals, normals)) > min_height * max_side)
    return flat


def _remove_duplicates(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return triangles without those of a repeated corner, without pairs that lie back to back, and without copies."""
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    # Rotated so that the lowest corner comes first.
    first = np.argmin(triangles, axis=1)
    rotated = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
    is_reversed = rotated[:, 1] > rotated[:, 2]
    _, group = np.unique(np.sort(triangles, axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    fronts, backs = (np.bincount(group[mask], minlength=len(triangles)) for mask in (~is_reversed, is_reversed))
    # One triangle stays if no triangle of the opposite orientation exists.
    keep = (fronts[group] == 0) | (backs[group] == 0)
    _, original = np.unique(group, return_index=True)
    keep &= np.isin(np.arange(len(triangles)), original)
    return triangles[keep]


def _collapse_needles(vertices: Array, triangles: NDArray[np.int64], height: float) -> tuple[NDArray[np.int64], int]:
    """Merge the ends of the short side of needle-shaped triangles; return triangles and number of needles."""
    sides = _side_lengths(vertices, triangles)
    is_needle = _is_flat(vertices, triangles, height) & (sides.min(axis=1) <= _ON_EDGE * sides.max(axis=1))
    count = int(np.count_nonzero(is_needle))
    if not count:
        return triangles, 0
    rows = triangles[is_needle]
    begin = np.argmin(sides[is_needle], axis=1)
    row_indices = np.arange(count)
    ends = np.stack((rows[row_indices, begin], rows[row_indices, (begin + 1) % 3]), axis=1)
    labels = component_labels(ends, len(vertices))
    _, first = np.unique(labels, return_index=True)
    return _remove_duplicates(first[labels].astype(np.int64)[triangles]), count


def _split_edges(vertices: Array, triangles: NDArray[np.int64], limit: float) -> tuple[NDArray[np.int64], int]:
    """Split open edges at border vertices on them, one a triangle; return triangles and number of split edges."""
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
    lengths = np.sqrt(dot_products(sides, sides))
    tree = cKDTree(vertices[border])
    edges, vertex_rows = near_edges(vertices, np.stack((tails, heads), axis=1), tree, lengths)
    border_vertices = border[vertex_rows]
    offset = vertices[border_vertices] - vertices[tails[edges]]
    fraction = dot_products(offset, sides[edges]) / (lengths[edges] * lengths[edges])
    foot = offset - fraction[:, None] * sides[edges]
    tolerance = np.maximum(4.0 * limit, _ON_EDGE * lengths[edges])
    lies_on = (dot_products(foot, foot) <= tolerance * tolerance) & (fraction > 0.0) & (fraction < 1.0)
    for corners in (tails, heads, thirds):
        lies_on &= border_vertices != corners[edges]
    # Edge and vertex must be on one border.
    gap = component_labels(np.stack((tails, heads), axis=1), len(vertices))
    lies_on &= gap[border_vertices] == gap[tails[edges]]
    cuts: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for edge, position, vertex in zip(edges[lies_on], fraction[lies_on], border_vertices[lies_on], strict=True):
        cuts[int(edge)].append((float(position), int(vertex)))
    is_left = np.ones(len(triangles), dtype=np.bool_)
    new_triangles: list[tuple[int, int, int]] = []
    n_split = 0
    for edge in sorted(cuts):
        if is_left[owner[edge]]:
            is_left[owner[edge]] = False
            chain = [int(tails[edge]), *(vertex for _, vertex in sorted(cuts[edge])), int(heads[edge])]
            new_triangles.extend((tail, head, int(thirds[edge])) for tail, head in pairwise(chain))
            n_split += 1
    if not n_split:
        return triangles, 0
    return np.concatenate((triangles[is_left], np.array(new_triangles, dtype=np.int64))), n_split
