# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Area of a plane that a cloth covers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import to_body_frame
from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.obstacles import build_solid
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.physics_scene import Sheet

#: Largest number of cells along a side of the projected cloth.
_MAX_CELLS = 4096
#: Largest number of rows of cells that the triangles cross, summed over the triangles: a bound of time and memory.
_MAX_ROWS = 1 << 21


class CoverageScene(Protocol):
    """Protocol of a `Scene` for the covered area: its parameters, obstacles and sheet."""

    @property
    def coverage(self) -> sections.CoverageParameters: ...

    @property
    def described(self) -> dict[str, sections.ObstacleParameters]: ...

    @property
    def files(self) -> Mapping[str, bytes]: ...

    @property
    def sheet(self) -> Sheet: ...


def check_coverage(scene: CoverageScene) -> None:
    """Raise ParameterError if a set `coverage.obstacle` is no valid plane or box, or if rectangle or cloth has no area.

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
    # It need not be present, so that nothing else has checked its size.
    build_solid(name, scene.described[name], scene.files)
    if any(size) and not all(size):
        raise ParameterError(f"coverage.size is {list(size)} m; give two positive numbers, or [0.0, 0.0] for all of it")
    if not len(scene.sheet.triangles()):
        raise ParameterError("coverage.obstacle needs a surface, and the cloth has no triangles; leave it empty")


class Coverage:
    """Measurement of the cloth's area projected onto an obstacle's plane, overlapping layers counted once.

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
        """Return the covered area [m^2], from positions x [m], (3, n), and the obstacle's pose (7,), counted in cells.

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
        height = _total_height(flat[1], self._triangles, low[1], high[1], enough=_MAX_ROWS * pitch)
        while max(high - low) > _MAX_CELLS * pitch or height > _MAX_ROWS * pitch:
            pitch *= 2.0
        # A cell's index is that of its centre: centre k is at (k + 1/2) pitch.
        first, last = np.ceil(low / pitch - 0.5).astype(np.int64), np.floor(high / pitch - 0.5).astype(np.int64)
        if (last < first).any():
            return 0.0
        rows, starts, ends = _spans(flat / pitch - 0.5, self._triangles, first, last)
        width, height = (last - first + 1).tolist()
        # One cell more in each row takes the end of a span at its right side.
        row_starts = (rows - first[1]) * (width + 1) - first[0]
        size = height * (width + 1)
        changes = np.bincount(row_starts + starts, minlength=size)
        changes -= np.bincount(row_starts + ends + 1, minlength=size)
        return int(np.count_nonzero(np.cumsum(changes))) * pitch * pitch


def _total_height(y: Array, triangles: NDArray[np.int64], low: float, high: float, *, enough: float) -> float:
    """Return the sum of the triangles' extents along y within [low, high], or an upper bound of it up to `enough`.

    Args:
        y: heights of the corners, shape (n,).
        triangles: their indices, shape (m, 3).
        low: lower height.
        high: upper height.
        enough: largest bound that is returned for the sum.
    """
    clipped = np.minimum(np.maximum(y, low), high)
    a, b, c = (clipped[corners] for corners in triangles.T)
    heights = np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)
    bound = float(heights.max()) * len(heights)
    # The exact sum, because the order of numpy's depends on the processor.
    return bound if bound <= enough else math.fsum(heights.tolist())


def _spans(
    points: Array, triangles: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return arrays row, first and last column of the integer points in triangles, an entry per triangle and row.

    Args:
        points: corners in the plane, shape (2, n).
        triangles: their indices, shape (m, 3).
        first: smallest column and row that count, shape (2,).
        last: largest ones, shape (2,).
    """
    # Corners by height. Both triangles of an edge then compute the same bits, so that no gap opens between them.
    by_height = np.argsort(points[1, triangles], axis=1, kind="stable")
    low, middle, high = np.take_along_axis(triangles, by_height, axis=1).T
    x, y = points
    bottom = np.maximum(np.ceil(y[low]).astype(np.int64), first[1])
    counts = np.maximum(np.minimum(np.floor(y[high]).astype(np.int64), last[1]) - bottom + 1, 0)
    # One entry for each triangle and each row that it crosses.
    rows = np.arange(counts.sum()) + np.repeat(bottom - np.cumsum(counts) + counts, counts)
    edges = [_slopes(x, y, a, b) for a, b in ((low, high), (low, middle), (middle, high))]
    corners = np.stack([x[low], y[low], x[middle], y[middle], *edges])
    x_low, y_low, x_middle, y_middle, whole, lower, upper = np.repeat(corners, counts, axis=1)
    long_edge = x_low + (rows - y_low) * whole
    short_edge = np.where(rows < y_middle, x_low + (rows - y_low) * lower, x_middle + (rows - y_middle) * upper)
    start = np.ceil(np.maximum(np.minimum(long_edge, short_edge), first[0])).astype(np.int64)
    end = np.floor(np.minimum(np.maximum(long_edge, short_edge), last[0])).astype(np.int64)
    inside = start <= end
    return rows[inside], start[inside], end[inside]


def _slopes(x: Array, y: Array, a: NDArray[np.int64], b: NDArray[np.int64]) -> Array:
    """Return dx/dy of the edges from corners a to b, shape (n,); 0 for a horizontal edge, whose row begins at b."""
    rise = y[b] - y[a]
    slopes: Array = np.divide(x[b] - x[a], rise, out=np.zeros(len(a)), where=rise > 0.0)
    return slopes
