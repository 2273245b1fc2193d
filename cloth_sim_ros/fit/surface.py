# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signed distances of bare points from a sheet's surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array

#: Number of nearest particles whose incident triangles are searched.
N_NEAREST = 4


def signed_distances(points: Array, x: Array, triangles: NDArray[np.integer]) -> Array:
    """Return each point's signed distance from a triangulated surface along its normal [m], shape (points,).

    The distance is measured from the nearest surface point, along the interpolated normal of the particles. Tangential
    motion of a flat surface therefore gives no residual.

    Args:
        points: measured points [m], shape (points, 3).
        x: particle positions [m], shape (particles, 3).
        triangles: particle indices with consistent orientation, shape (triangles, 3).
    """
    from scipy.spatial import cKDTree

    if not len(points):
        return np.empty(0)
    corners = np.asarray(triangles, dtype=np.int64)
    _, nearest = cKDTree(x).query(points, k=min(N_NEAREST, len(x)))
    neighbours = np.asarray(nearest).reshape(len(points), -1)
    candidates = _incident_triangles(corners, len(x))[neighbours].reshape(len(points), -1)
    best, min_square = np.zeros((len(points), 3)), np.full(len(points), np.inf)
    triangle_index = np.zeros(len(points), dtype=np.int64)
    for column in candidates.T:
        weights = _nearest_weights(points, *(x[corners[column, k]] for k in range(3)))
        foot = np.einsum("pk,pkj->pj", weights, x[corners[column]])
        squares = np.where(column < 0, np.inf, np.square(points - foot).sum(axis=1))
        closer = squares < min_square
        best[closer], min_square[closer], triangle_index[closer] = weights[closer], squares[closer], column[closer]
    foot = np.einsum("pk,pkj->pj", best, x[corners[triangle_index]])
    normal = np.einsum("pk,pkj->pj", best, _normals(x, corners)[corners[triangle_index]])
    length = np.sqrt(np.square(normal).sum(axis=1))
    normal /= np.where(length > 0.0, length, 1.0)[:, None]
    return np.asarray(np.einsum("pj,pj->p", points - foot, normal))


def _incident_triangles(corners: NDArray[np.int64], n_particles: int) -> NDArray[np.int64]:
    """Return the indices of the triangles incident to each particle, padded with -1, shape (particles, max)."""
    particle_of = corners.ravel()
    order = np.argsort(particle_of, kind="stable")
    counts = np.bincount(particle_of, minlength=n_particles)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    table = np.full((n_particles, int(counts.max(initial=1))), -1, dtype=np.int64)
    slot = np.arange(len(particle_of)) - np.repeat(starts, counts)
    table[particle_of[order], slot] = order // 3
    return table


def _normals(x: Array, corners: NDArray[np.int64]) -> Array:
    """Return unit normals of a triangulated surface at its particles, shape (particles, 3)."""
    a, b, c = (x[corners[:, k]] for k in range(3))
    area_normals = np.cross(b - a, c - a)
    sums = np.zeros_like(x)
    for k in range(3):
        np.add.at(sums, corners[:, k], area_normals)
    length = np.sqrt(np.square(sums).sum(axis=1))
    return np.asarray(sums / np.where(length > 0.0, length, 1.0)[:, None])


def _nearest_weights(p: Array, a: Array, b: Array, c: Array) -> Array:
    """Return barycentric weights of the nearest point of triangle a, b, c to each point p, shape (points, 3).

    Method: the regions of Ericson, Real-Time Collision Detection, 5.1.5. A degenerate triangle gives its first corner.
    """
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2 = (np.einsum("pj,pj->p", edge, ap) for edge in (ab, ac))
    d3, d4 = (np.einsum("pj,pj->p", edge, bp) for edge in (ab, ac))
    d5, d6 = (np.einsum("pj,pj->p", edge, cp) for edge in (ab, ac))
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2

    def ratio(numerator: Array, denominator: Array) -> Array:
        return np.asarray(numerator / np.where(denominator == 0.0, 1.0, denominator))

    zeros, ones = np.zeros_like(d1), np.ones_like(d1)
    v_ab, w_ac, w_bc = ratio(d1, d1 - d3), ratio(d2, d2 - d6), ratio(d4 - d3, (d4 - d3) + (d5 - d6))
    total = va + vb + vc
    inside = np.stack([zeros, ratio(vb, total), ratio(vc, total)], axis=1)
    inside[:, 0] = 1.0 - inside[:, 1] - inside[:, 2]
    regions = [
        ((d1 <= 0.0) & (d2 <= 0.0), (ones, zeros, zeros)),
        ((d3 >= 0.0) & (d4 <= d3), (zeros, ones, zeros)),
        ((vc <= 0.0) & (d1 >= 0.0) & (d3 <= 0.0), (1.0 - v_ab, v_ab, zeros)),
        ((d6 >= 0.0) & (d5 <= d6), (zeros, zeros, ones)),
        ((vb <= 0.0) & (d2 >= 0.0) & (d6 <= 0.0), (1.0 - w_ac, zeros, w_ac)),
        ((va <= 0.0) & (d4 >= d3) & (d5 >= d6), (zeros, 1.0 - w_bc, w_bc)),
    ]
    conditions = [condition[:, None] for condition, _ in regions]
    chosen = np.select(conditions, [np.stack(w, axis=1) for _, w in regions], inside)
    return np.asarray(np.where((total == 0.0)[:, None] & (chosen == inside), np.array([1.0, 0.0, 0.0]), chosen))
