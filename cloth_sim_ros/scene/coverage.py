# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Area of a plane that a cloth covers."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import to_body_frame
from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.build import Sheet
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Largest number of cells along a side of the projected cloth.
_MAX_CELLS = 4096


class CoverageScene(Protocol):
    """Part of a `Scene` that these functions read."""

    @property
    def coverage(self) -> sections.CoverageParameters: ...

    @property
    def described(self) -> dict[str, sections.ObstacleParameters]: ...

    @property
    def sheet(self) -> Sheet: ...


def check_coverage(scene: CoverageScene) -> None:
    """Refuse an obstacle that has no plane, a rectangle without area, and a cloth without a surface.

    Raises:
        ParameterError: naming the parameter.
    """
    name, size = scene.coverage.obstacle, scene.coverage.size
    if not name:
        return
    if name not in scene.described:
        raise ParameterError(f"coverage.obstacle names '{name}', and {name}.shape is not set; set it")
    if (shape := scene.described[name].shape) not in ("plane", "box"):
        raise ParameterError(f"coverage.obstacle names '{name}', and {name}.shape is {shape}; take a plane or a box")
    if any(size) and not all(size):
        raise ParameterError(f"coverage.size is {list(size)} m; give two positive numbers, or [0.0, 0.0] for all of it")
    if not len(scene.sheet.triangles()):
        raise ParameterError("coverage.obstacle needs a surface, and the cloth has no triangles; leave it empty")


class Coverage:
    """Area of the cloth's projection onto a plane, with overlapping layers counted once.

    The plane is z = 0 of the obstacle's frame, and the projection is along z. Square cells from the frame's origin on
    count if their centre lies in a projected triangle.

    Args:
        scene: with `coverage.obstacle`.
    """

    def __init__(self, scene: CoverageScene) -> None:
        #: Name of the obstacle.
        self.obstacle = scene.coverage.obstacle
        description = scene.described[self.obstacle]
        self._triangles, self._resolution = scene.sheet.triangles(), scene.coverage.resolution
        size = scene.coverage.size
        if description.shape == "box":
            size = tuple(min(a, b) if b else a for a, b in zip(description.size[:2], size, strict=True))
        #: Half of the rectangle's sides [m]; infinite for a whole plane.
        self._half = [0.5 * length if length else math.inf for length in size]

    def area(self, x: Array, pose: Array) -> float:
        """Return the covered area [m^2].

        Args:
            x: positions [m], shape (3, n).
            pose: position [m] and unit quaternion x, y, z, w of the obstacle.
        """
        flat = to_body_frame(pose, x)[:, :2].T
        half = np.array(self._half)
        low, high = np.maximum(flat.min(axis=1), -half), np.minimum(flat.max(axis=1), half)
        if not (low < high).all():
            return 0.0
        pitch = self._resolution
        while max(high - low) > _MAX_CELLS * pitch:
            pitch *= 2.0
        # A cell's index is that of its centre: centre k is at (k + 1/2) pitch.
        first, last = np.ceil(low / pitch - 0.5).astype(int), np.floor(high / pitch - 0.5).astype(int)
        if (last < first).any():
            return 0.0
        changes = np.zeros((last[1] - first[1] + 1, last[0] - first[0] + 2), dtype=np.int32)
        rows, starts, ends = _spans(flat / pitch - 0.5, self._triangles, first, last)
        np.add.at(changes, (rows - first[1], starts - first[0]), 1)
        np.add.at(changes, (rows - first[1], ends - first[0] + 1), -1)
        return int(np.count_nonzero(np.cumsum(changes, axis=1))) * pitch * pitch


def _spans(
    points: Array, triangles: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return row, first and last column of the integer points in each triangle, row by row.

    Args:
        points: corners in the plane, shape (2, n).
        triangles: their indices, shape (m, 3).
        first: smallest column and row that count, shape (2,).
        last: largest ones, shape (2,).
    """
    height = points[1, triangles]
    bottom = np.maximum(np.ceil(height.min(axis=1)).astype(np.int64), first[1])
    top = np.minimum(np.floor(height.max(axis=1)).astype(np.int64), last[1])
    counts = np.maximum(top - bottom + 1, 0)
    # One entry for each triangle and each row that it crosses.
    triangle = np.repeat(np.arange(len(triangles)), counts)
    rows = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts) + bottom[triangle]
    left, right = np.full(len(rows), np.inf), np.full(len(rows), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        # Both triangles of an edge compute the same bits, so that no gap opens between them.
        ends = np.sort(triangles[:, [a, b]], axis=1)[triangle]
        (x0, y0), (x1, y1) = points[:, ends[:, 0]], points[:, ends[:, 1]]
        crosses = (np.minimum(y0, y1) <= rows) & (rows <= np.maximum(y0, y1))
        # A horizontal edge has the crossings of the other two at its ends.
        slope = np.divide(x1 - x0, y1 - y0, out=np.zeros_like(x0), where=crosses & (y1 != y0))
        crossing = x0 + (rows - y0) * slope
        crosses &= y1 != y0
        left = np.where(crosses, np.minimum(left, crossing), left)
        right = np.where(crosses, np.maximum(right, crossing), right)
    start = np.maximum(np.ceil(np.maximum(left, first[0])), first[0])
    end = np.minimum(np.floor(np.minimum(right, last[0])), last[0])
    inside = start <= end
    return rows[inside], start[inside].astype(np.int64), end[inside].astype(np.int64)
