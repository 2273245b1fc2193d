# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clusters of mesh vertices that are copies of one vertex, up to rounding.

Some programs close a seam by sin(2 pi), or round each triangle separately. They leave copies of a vertex that differ in
their last digits. Two vertices are linked if they are closer than the limit. Linked vertices are one cluster, and its
lowest vertex represents it. A cluster that extends further than twice the limit from its lowest vertex is a fine part
of the mesh. It stays as it is.

The result depends on positions and order alone. Single additions and multiplications in double precision, which every
machine rounds alike, compute the distances.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import dot_products
from cloth_sim_ros.physics.model.forces.force import Array

#: Fraction of a mesh's extent below which two vertices are copies of one.
MERGE_FRACTION = 1e-7
#: The same for coordinates in single precision, whose last digit may be larger: at most this fraction.
SINGLE_PRECISION_FRACTION = 1e-6
#: Largest number of different vertices in a cube of two limits that may be copies of one vertex.
_MAX_CELL_VERTICES = 64
#: Number of links that are collected before they are reduced to clusters.
_MAX_PENDING_LINKS = 1 << 22
#: A direction, (1, these two), along which few vertices of a mesh coincide, and a bound of its length.
_DIRECTION, _DIRECTION_LENGTH = (0.7548776662466927, 0.5698402909980532), 1.4
#: Factors of a hash of a cell's three indices.
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def merge_limit(points: Array, *, single_precision: bool = False) -> float:
    """Return the distance [m] below which two vertices are copies of one: 1e-7 of the mesh's extent, or rounding.

    Args:
        points: vertices [m], (n, 3).
        single_precision: true if the file has single precision: its last digit is the limit if that is larger.

    Returns:
        1e-7 of the diagonal of the bounding box; 0, which merges nothing, if that is not finite.
    """
    if not len(points):
        return 0.0
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = high - low
        extent = float(np.sqrt(x * x + y * y + z * z))
        limit = MERGE_FRACTION * extent
        if single_precision and np.isfinite(extent):
            # Each coordinate is off by one last digit: the distance is at most sqrt(3) of it.
            last_digit = float(np.spacing(np.float32(max(-low.min(), high.max()))))
            limit = max(limit, min(2.0 * last_digit, SINGLE_PRECISION_FRACTION * extent))
    return limit if np.isfinite(limit) else 0.0


def clusters(points: Array, limit: float) -> NDArray[np.int64]:
    """Return for each vertex the lowest index in its cluster of copies, or its own if the cluster is wide, (n,).

    Args:
        points: different finite vertices [m], (n, 3).
        limit: distance below which two are linked [m]; 0 links none.
    """
    lowest = np.arange(len(points))
    if not limit > 0.0 or len(points) < 2:
        return lowest
    candidates = _close_candidates(points, limit)
    if candidates.size:
        lowest[candidates] = candidates[_linked_lowest(points[candidates], limit)]
    wide_clusters = lowest[_squared_distances(points, points[lowest]) > 4.0 * limit * limit]
    if wide_clusters.size:
        is_wide = np.isin(lowest, wide_clusters)
        lowest[is_wide] = np.flatnonzero(is_wide)
    return lowest


def _close_candidates(points: Array, limit: float) -> NDArray[np.int64]:
    """Return the vertices that may have another closer than the limit, by their projections on a line; ascending."""
    x, y, z = (points - points.min(axis=0)).T
    along = x + _DIRECTION[0] * y + _DIRECTION[1] * z
    order = np.argsort(along, kind="stable")
    close = np.diff(along[order]) < _DIRECTION_LENGTH * limit
    return np.sort(order[np.concatenate((close, [False])) | np.concatenate(([False], close))])


def _linked_lowest(points: Array, limit: float) -> NDArray[np.int64]:
    """Return for each vertex the lowest index that it is linked to, directly or through others, (n,)."""
    lowest = np.arange(len(points))
    # Cells of two limits, in eight grids shifted by one limit: two linked vertices share a cell in one of them.
    scaled = (points - points.min(axis=0)) / (2.0 * limit)
    for shift in np.ndindex(2, 2, 2):
        cell = np.floor(scaled + 0.5 * np.array(shift)).astype(np.int64).astype(np.uint64)
        order, first = _shared_cells(np.bitwise_xor.reduce(cell * _MIX, axis=1))
        # Copies of one vertex are linked to the first in the cell; the others are compared pair by pair.
        lowest = _merge_links(lowest, _close_pairs(points, order, order[first], limit))
        unlinked = np.flatnonzero(lowest[order] != lowest[order[first]])
        is_compared = np.isin(first, first[unlinked])
        order, first = order[is_compared], first[is_compared]
        links: list[NDArray[np.int64]] = []
        n_pending = 0
        for offset in range(1, _MAX_CELL_VERTICES):
            is_same_cell = first[offset:] == first[:-offset]
            if not np.any(is_same_cell):
                break
            firsts, seconds = order[:-offset][is_same_cell], order[offset:][is_same_cell]
            is_apart = lowest[firsts] != lowest[seconds]
            links.append(_close_pairs(points, firsts[is_apart], seconds[is_apart], limit))
            n_pending += len(links[-1])
            if n_pending > _MAX_PENDING_LINKS:
                lowest = _merge_links(lowest, *links)
                links, n_pending = [], 0
        if links:
            lowest = _merge_links(lowest, *links)
    return lowest


def _close_pairs(points: Array, first: NDArray[np.int64], second: NDArray[np.int64], limit: float) -> NDArray[np.int64]:
    """Return those of the pairs (first, second) of vertices that are closer than the limit, (p, 2)."""
    is_close = _squared_distances(points[first], points[second]) < limit * limit
    return np.stack((first[is_close], second[is_close]), axis=1)


def _merge_links(lowest: NDArray[np.int64], *links: NDArray[np.int64]) -> NDArray[np.int64]:
    """Add links, (p, 2) each, to clusters, (n,); return for each vertex the lowest index of its cluster, (n,)."""
    count = len(lowest)
    label = component_labels(np.concatenate((np.stack((np.arange(count), lowest), axis=1), *links)), count)
    _, first = np.unique(label, return_index=True)
    return first[label].astype(np.int64)


def component_labels(edges: NDArray[np.int64] | NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """Return labels from 0 of the connected components of `count` nodes, (count,), for edges (e, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _shared_cells(key: NDArray[np.uint64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the vertices that share a cell (equal key), cell by cell, and for each the position of its cell's first.

    Cells with too many vertices are skipped.
    """
    order = np.argsort(key, kind="stable")
    key = key[order]
    begins = np.concatenate(([True], key[1:] != key[:-1]))
    sizes = np.diff(np.append(np.flatnonzero(begins), len(key)))
    is_shared = (sizes > 1) & (sizes <= _MAX_CELL_VERTICES)
    in_shared_cell = np.repeat(is_shared, sizes)
    return order[in_shared_cell], np.repeat(np.flatnonzero(begins[in_shared_cell]), sizes[is_shared])


def _squared_distances(firsts: Array, seconds: Array) -> Array:
    """Return the squared distances between corresponding vertices, (n, 3) each [m^2], (n,)."""
    offset = firsts - seconds
    return dot_products(offset, offset)
