# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signed distances of bare points from a sheet's surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array

#: Number of nearest particles whose incident triangles are searched.
NEAREST = 4


def distances(points: Array, x: Array, triangles: NDArray[np.integer]) -> Array:
    """Return each point's signed distance from the surface along its normal [m], shape (points,).

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
    _, near = cKDTree(x).query(points, k=min(NEAREST, len(x)))
    about = _about(corners, len(x))[np.asarray(near).reshape(len(points), -1)].reshape(len(points), -1)
    best, least = np.zeros((len(points), 3)), np.full(len(points), np.inf)
    which = np.zeros(len(points), dtype=np.int64)
    for column in about.T:
        weights = _nearest(points, *(x[corners[column, k]] for k in range(3)))
        foot = np.einsum("pk,pkj->pj", weights, x[corners[column]])
        away = np.where(column < 0, np.inf, np.square(points - foot).sum(axis=1))
        closer = away < least
        best[closer], least[closer], which[closer] = weights[closer], away[closer], column[closer]
    foot = np.einsum("pk,pkj->pj", best, x[corners[which]])
    normal = np.einsum("pk,pkj->pj", best, _normals(x, corners)[corners[which]])
    length = np.sqrt(np.square(normal).sum(axis=1))
    normal /= np.where(length > 0.0, length, 1.0)[:, None]
    return np.asarray(np.einsum("pj,pj->p", points - foot, normal))


def _about(corners: NDArray[np.int64], particles: int) -> NDArray[np.int64]:
    """Return the indices of the triangles incident to each particle, padded with -1, shape (particles, max)."""
    owners = corners.ravel()
    order = np.argsort(owners, kind="stable")
    counts = np.bincount(owners, minlength=particles)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    table = np.full((particles, int(counts.max(initial=1))), -1, dtype=np.int64)
    place = np.arange(len(owners)) - np.repeat(starts, counts)
    table[owners[order], place] = order // 3
    return table


def _normals(x: Array, corners: NDArray[np.int64]) -> Array:
    """Return unit normals at the particles, shape (particles, 3)."""
    a, b, c = (x[corners[:, k]] for k in range(3))
    each = np.cross(b - a, c - a)
    sums = np.zeros_like(x)
    for k in range(3):
        np.add.at(sums, corners[:, k], each)
    length = np.sqrt(np.square(sums).sum(axis=1))
    return np.asarray(sums / np.where(length > 0.0, length, 1.0)[:, None])


def _nearest(p: Array, a: Array, b: Array, c: Array) -> Array:
    """Return barycentric weights of the triangle point nearest to each point, shape (points, 3).

    Method: the regions of Ericson, Real-Time Collision Detection, 5.1.5. A degenerate triangle gives its first corner.
    """
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2 = (np.einsum("pj,pj->p", side, ap) for side in (ab, ac))
    d3, d4 = (np.einsum("pj,pj->p", side, bp) for side in (ab, ac))
    d5, d6 = (np.einsum("pj,pj->p", side, cp) for side in (ab, ac))
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2

    def share(part: Array, whole: Array) -> Array:
        return np.asarray(part / np.where(whole == 0.0, 1.0, whole))

    zero, one = np.zeros_like(d1), np.ones_like(d1)
    v_ab, w_ac, w_bc = share(d1, d1 - d3), share(d2, d2 - d6), share(d4 - d3, (d4 - d3) + (d5 - d6))
    total = va + vb + vc
    inside = np.stack([zero, share(vb, total), share(vc, total)], axis=1)
    inside[:, 0] = 1.0 - inside[:, 1] - inside[:, 2]
    regions = [
        ((d1 <= 0.0) & (d2 <= 0.0), (one, zero, zero)),
        ((d3 >= 0.0) & (d4 <= d3), (zero, one, zero)),
        ((vc <= 0.0) & (d1 >= 0.0) & (d3 <= 0.0), (1.0 - v_ab, v_ab, zero)),
        ((d6 >= 0.0) & (d5 <= d6), (zero, zero, one)),
        ((vb <= 0.0) & (d2 >= 0.0) & (d6 <= 0.0), (1.0 - w_ac, zero, w_ac)),
        ((va <= 0.0) & (d4 >= d3) & (d5 >= d6), (zero, 1.0 - w_bc, w_bc)),
    ]
    chosen = np.select([where[:, None] for where, _ in regions], [np.stack(w, axis=1) for _, w in regions], inside)
    return np.asarray(np.where((total == 0.0)[:, None] & (chosen == inside), np.array([1.0, 0.0, 0.0]), chosen))
