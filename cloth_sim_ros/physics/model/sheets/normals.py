# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Normals of a triangulated surface at its particles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array


def vertex_normals(x: Array, triangles: NDArray[np.int64]) -> Array:
    """Return the unit normal at each particle, shape (3, n): mean of its triangles' normals, weighted by area.

    The same bits on every machine: sums have the order of the triangles.

    Args:
        x: positions [m], shape (3, n).
        triangles: particles of each triangle, counter-clockwise seen from the normal's side, shape (m, 3).

    Returns:
        Zero where no triangle with an area is.
    """
    a, b, c = (x[:, corner] for corner in triangles.T)
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    doubled_areas = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
    corners, count = triangles.T.ravel(), x.shape[1]
    sums = np.stack([np.bincount(corners, np.tile(part, 3), minlength=count) for part in doubled_areas])
    length = np.sqrt(sums[0] * sums[0] + sums[1] * sums[1] + sums[2] * sums[2])
    normals: Array = np.divide(sums, length, out=np.zeros(sums.shape), where=length > 0.0)
    return normals
