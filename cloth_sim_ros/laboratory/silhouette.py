# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shadow of a draped specimen: area of its vertical projection, contour and nodes."""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array

#: Number of directions of a contour.
N_DIRECTIONS = 720
#: Depth of a node's valleys on both sides over the mean radius, below which it does not count.
MIN_NODE_DEPTH = 0.01


@attrs.frozen(eq=False, kw_only=True)
class Silhouette:
    """Shadow of a draped specimen, its vertical projection: area, contour and number of nodes."""

    #: Area of the shadow, the plate's included [m^2].
    area: float
    #: Radius of the contour in `N_DIRECTIONS` directions, from the x axis on counterclockwise [m].
    radii: Array
    #: Number of folds.
    nodes: int


def silhouette(positions: Array, triangles: NDArray[np.int64], plate_radius: float) -> Silhouette:
    """Measure the shadow (projection along z) of a specimen on a plate about the origin; return it.

    Args:
        positions: particles [m], shape (n, 3).
        triangles: particles of each triangle, shape (m, 3).
        plate_radius: radius of the plate, all of which is in the shadow [m].
    """
    radii = _contour(positions[:, :2], triangles, plate_radius)
    # Sectors between directions; the shadow contains each ray from the centre to its farthest point.
    area = 0.5 * math.sin(2.0 * math.pi / len(radii)) * float((radii * np.roll(radii, 1)).sum())
    return Silhouette(area=area, radii=radii, nodes=_count_nodes(radii))


def _contour(points: Array, triangles: NDArray[np.int64], plate_radius: float) -> Array:
    """Return the distance of the shadow's border from the centre in each direction [m], shape (N_DIRECTIONS,)."""
    corners = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.sort(corners, axis=1), axis=0)
    angles = np.arctan2(points[:, 1], points[:, 0]) % (2.0 * math.pi) * (N_DIRECTIONS / (2.0 * math.pi))
    first, last = angles[edges].T
    # An edge is seen under less than half a turn.
    across = np.abs(last - first) > 0.5 * N_DIRECTIONS
    first, last = (
        np.where(across & (first < last), first + N_DIRECTIONS, first),
        np.where(across & (last < first), last + N_DIRECTIONS, last),
    )
    low, high = np.ceil(np.minimum(first, last)).astype(np.int64), np.floor(np.maximum(first, last)).astype(np.int64)
    counts = np.maximum(high - low + 1, 0)
    edge = np.repeat(np.arange(len(edges)), counts)
    direction = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(low, counts)
    a, b = points[edges[edge, 0]], points[edges[edge, 1]]
    turn = direction * (2.0 * math.pi / N_DIRECTIONS)
    cosine, sine = np.cos(turn), np.sin(turn)
    # Intersection of the ray r (c, s) with a + k (b - a): cross products with the ray's direction give k.
    from_a, from_b = a[:, 0] * sine - a[:, 1] * cosine, b[:, 0] * sine - b[:, 1] * cosine
    gap = from_a - from_b
    k = np.divide(from_a, gap, out=np.zeros_like(gap), where=gap != 0.0)
    point = a + np.clip(k, 0.0, 1.0)[:, None] * (b - a)
    radii = np.full(N_DIRECTIONS, plate_radius)
    np.maximum.at(radii, direction % N_DIRECTIONS, point[:, 0] * cosine + point[:, 1] * sine)
    return radii


def _count_nodes(radii: Array) -> int:
    """Return the number of nodes (folds) of a contour: maxima between valleys of `MIN_NODE_DEPTH`."""
    limit = MIN_NODE_DEPTH * float(radii.mean())
    rolled = np.roll(radii, -int(np.argmin(radii))).tolist()
    nodes, is_rising, extreme = 0, True, rolled[0]
    for radius in [*rolled, rolled[0]]:
        if is_rising:
            extreme = max(extreme, radius)
            if radius < extreme - limit:
                nodes, is_rising, extreme = nodes + 1, False, radius
        else:
            extreme = min(extreme, radius)
            if radius > extreme + limit:
                is_rising, extreme = True, radius
    return nodes
