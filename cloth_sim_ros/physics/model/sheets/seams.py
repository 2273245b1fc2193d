# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Seams of a mesh that look closed and are open.

Two vertices of the border belong to one seam if they are closer than a hundredth of the shortest border edge at either.
A vertex and a border edge of another triangle belong to one seam if they are closer than a hundredth of the edge's
length.
"""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import dot_products, integer_sum
from cloth_sim_ros.physics.model.forces.force import Array

#: Fraction of the local edge length below which two positions of the border look joined.
SEAM_FRACTION = 0.01
#: Neighbours of a border vertex that are examined.
_NEIGHBOURS = 8
#: Largest number of border edges, and of pairs of an edge and a vertex, for the search of vertices on edges. A border
#: has a few thousand edges; disconnected triangles have three each.
_MAX_EDGES, _MAX_PAIRS = 10_000, 1 << 22
#: Margin of a tree query's distance: the results are measured again, so rounding hides none.
_QUERY_MARGIN = 1.0 + 1e-9


@attrs.frozen(kw_only=True)
class OpenSeam:
    """Summary of border vertices of a mesh that nearly touch another part of the border and are not joined to it."""

    count: int
    """Number of border vertices that lie near another part of the border."""
    vertex: int
    """Vertex of the closest such position."""
    distance: float
    """Distance of that vertex from the other part of the border [m]."""

    def describe(self, points: Array) -> str:
        """Return a log sentence on the open seam; points: vertices of the mesh [m], (n, 3)."""
        position = ", ".join(f"{value:.6g}" for value in points[self.vertex])
        single = self.count == 1
        return (
            f"{self.count} border {'vertex lies' if single else 'vertices lie'} within a hundredth of an edge of "
            f"another part of the border and {'is' if single else 'are'} not joined to it; the closest, vertex "
            f"{self.vertex} at [{position}], is {self.distance:.3g} m away. If that is a seam, it is open: merge by "
            "distance in the program that made the mesh"
        )


def border_edges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the border edges of triangles (m, 3), those of a single triangle, in its direction, (b, 2)."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    keys = edges.min(axis=1) * (int(triangles.max()) + 1) + edges.max(axis=1)
    _, first, uses = np.unique(keys, return_index=True, return_counts=True)
    return np.asarray(edges[np.sort(first[uses == 1])])


def open_seam(points: Array, triangles: NDArray[np.int64], border: NDArray[np.int64]) -> OpenSeam | None:
    """Return a summary of a mesh's border vertices that nearly touch but are not joined; None if there are none.

    Args:
        points: vertices [m], (n, 3).
        triangles: vertices of each triangle, (m, 3).
        border: the two vertices of each edge with one triangle, (b, 2).
    """
    if len(border) < 2:
        return None
    from scipy.spatial import cKDTree

    sides = points[border[:, 1]] - points[border[:, 0]]
    lengths = np.sqrt(dot_products(sides, sides))
    vertices, vertex_rows = np.unique(border, return_inverse=True)
    ends = vertex_rows.reshape(border.shape)
    shortest = np.full(len(vertices), np.inf)
    np.minimum.at(shortest, ends.ravel(), np.repeat(lengths, 2))
    corners = points[vertices]
    tree = cKDTree(corners)
    max_distance = _QUERY_MARGIN * SEAM_FRACTION * lengths.max()
    _, nearest = tree.query(corners, k=_NEIGHBOURS, distance_upper_bound=max_distance)
    # The tree returns the number of vertices if there is no further neighbour.
    offsets = corners[:, None] - np.append(corners, np.full((1, 3), np.inf), axis=0)[nearest]
    offset_lengths = np.sqrt(dot_products(offsets, offsets))
    max_gaps = np.append(shortest, 0.0)
    is_itself = nearest == np.arange(len(vertices))[:, None]
    is_near = (offset_lengths <= SEAM_FRACTION * np.minimum(shortest[:, None], max_gaps[nearest])) & ~is_itself
    rows, columns = np.nonzero(is_near)
    is_near[rows, columns] = ~_are_joined(triangles, vertices[rows], vertices[nearest[rows, columns]])
    distances = np.where(is_near, offset_lengths, np.inf).min(axis=1)
    at_edges = _edge_distances(points, triangles, border, vertices, tree, lengths)
    distances = np.minimum(distances, at_edges)
    count = int(np.count_nonzero(np.isfinite(distances)))
    if not count:
        return None
    closest = int(np.argmin(distances))
    return OpenSeam(count=count, vertex=int(vertices[closest]), distance=float(distances[closest]))


def _edge_distances(
    points: Array,
    triangles: NDArray[np.int64],
    border: NDArray[np.int64],
    vertices: NDArray[np.int64],
    tree: object,
    lengths: Array,
) -> Array:
    """Return each border vertex's distance [m] from near border edges of other triangles; infinite without any."""
    distances = np.full(len(vertices), np.inf)
    edges, vertex_rows = near_edges(points, border, tree, lengths)
    begin, along = points[border[edges, 0]], points[border[edges, 1]] - points[border[edges, 0]]
    offset = points[vertices[vertex_rows]] - begin
    fraction = dot_products(offset, along) / dot_products(along, along)
    foot = offset - fraction[:, None] * along
    edge_gaps = np.sqrt(dot_products(foot, foot))
    inside = (fraction > SEAM_FRACTION) & (fraction < 1.0 - SEAM_FRACTION)
    inside &= edge_gaps <= SEAM_FRACTION * lengths[edges]
    # The third corner of a thin triangle lies near its own edge.
    opposite = _opposite_corners(triangles, border)
    inside &= opposite[edges] != vertices[vertex_rows]
    np.minimum.at(distances, vertex_rows[inside], edge_gaps[inside])
    return distances


def near_edges(
    points: Array, border: NDArray[np.int64], tree: object, lengths: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return border edges and border vertices in the spheres that these span, (p,) each; empty if there are too many.

    Args:
        points: vertices [m], (n, 3).
        border: the two vertices of each edge, (b, 2).
        tree: a cKDTree of the border's vertices.
        lengths: lengths of the edges [m], (b,).

    Returns:
        Edges and vertices (rows of the tree), each (p,); empty if there are too many.
    """
    empty = np.zeros(0, dtype=np.int64)
    if len(border) > _MAX_EDGES:
        return empty, empty
    middles = 0.5 * (points[border[:, 0]] + points[border[:, 1]])
    radii = 0.5 * lengths
    counts = tree.query_ball_point(middles, _QUERY_MARGIN * radii, return_length=True)  # type: ignore[attr-defined]
    if integer_sum(counts.tolist()) > _MAX_PAIRS:
        return empty, empty
    neighbors = tree.query_ball_point(middles, _QUERY_MARGIN * radii, return_sorted=True)  # type: ignore[attr-defined]
    vertex_rows = np.array([vertex for row in neighbors for vertex in row], dtype=np.int64)
    edges = np.repeat(np.arange(len(border)), counts)
    offsets = tree.data[vertex_rows] - middles[edges]  # type: ignore[attr-defined]
    is_within = dot_products(offsets, offsets) <= radii[edges] * radii[edges]
    return edges[is_within], vertex_rows[is_within]


def _are_joined(triangles: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of pairs (first, second) of vertices that an edge of a triangle joins, (p,)."""
    count = int(triangles.max()) + 1
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    return np.isin(np.minimum(first, second) * count + np.maximum(first, second), edges[:, 0] * count + edges[:, 1])


def _opposite_corners(triangles: NDArray[np.int64], border: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the third vertex of the triangle at each directed border edge, (b,)."""
    count = int(triangles.max()) + 1
    tails, heads, thirds = (np.concatenate([triangles[:, (k + at) % 3] for k in range(3)]) for at in range(3))
    keys = tails * count + heads
    order = np.argsort(keys, kind="stable")
    return np.asarray(thirds[order[np.searchsorted(keys[order], border[:, 0] * count + border[:, 1])]])
