# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images of triangles and solid shapes from a pinhole camera (camera/z_buffer.hpp)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import SHAPES, Array, Indices, check, float64_address, library

#: Pixels behind an image, at least a vector of the engine.
_PADDING = 16
#: Largest label.
MAX_LABEL = 2**16 - 1


class DepthImage:
    """Depth buffer of a pinhole camera: inverse depth [1/m] and label of each pixel, 0 where it sees no surface.

    The camera's frame has x right, y down and z forward; depth is z. Centres of pixels have integer coordinates.

    Args:
        width: columns.
        height: rows.
        intrinsics: fx, fy, cx, cy [pixels].

    Raises:
        ValueError: for a size below 1.
    """

    def __init__(self, width: int, height: int, intrinsics: ArrayLike) -> None:
        if width < 1 or height < 1:
            raise ValueError(f"the image has {width} x {height} pixels; it must have at least 1 x 1")
        self._size, self._intrinsics = (width, height), np.array(intrinsics, dtype=np.float64)
        self._camera = float64_address("intrinsics", self._intrinsics, (4,))
        self._inverse = np.zeros(width * height + _PADDING, np.float32)
        self._labels = np.zeros(width * height + _PADDING, np.uint16)
        self._images = (self._inverse.ctypes.data, self._labels.ctypes.data)

    @property
    def inverse_depths(self) -> NDArray[np.float32]:
        """Inverse depths [1/m], 0 without a surface, shape (height, width): a view that drawings change."""
        width, height = self._size
        return self._inverse[: width * height].reshape(height, width)

    @property
    def labels(self) -> NDArray[np.uint16]:
        """Label of each pixel's surface, 0 for none, shape (height, width): a view that drawings change."""
        width, height = self._size
        return self._labels[: width * height].reshape(height, width)

    def clear(self) -> None:
        """Set all inverse depths and labels to 0: no surface."""
        self._inverse.fill(0.0)
        self._labels.fill(0)

    def draw_triangles(self, placement: Array, x: Array, triangles: Indices, label: int, *, solid: bool) -> None:
        """Draw triangles with a label into the image; each pixel keeps the nearest surface drawn so far.

        Args:
            placement: rotation matrix by rows and translation [m] from the vertices' frame to the camera's, 12 numbers.
            x: vertices [m], shape (3, n).
            triangles: vertices of each triangle, shape (m, 3).
            label: number of the surface, 1 to `MAX_LABEL`.
            solid: true for a solid's surface, seen from outside only, where corners run counterclockwise.

        Raises:
            ValueError: for an array of another shape or type.
            EngineError: for a triangle of a missing vertex.
        """
        if not len(triangles):
            return
        if triangles.dtype != np.int64 or triangles.ndim != 2 or triangles.shape[1] != 3:
            raise ValueError(f"triangles is {triangles.dtype} of shape {triangles.shape}; it must be int64, (m, 3)")
        corners = np.ascontiguousarray(triangles)
        vertices, moved = float64_address("x", x, (3, x.shape[-1])), float64_address("placement", placement, (12,))
        check(
            library().cloth_draw_triangles(
                *self._size,
                self._camera,
                moved,
                x.shape[-1],
                vertices,
                len(corners),
                corners.ctypes.data,
                int(solid),
                label,
                *self._images,
            )
        )

    def draw_solid(self, placement: Array, shape: str, size: ArrayLike, radius: float, label: int) -> None:
        """Draw a solid shape, no mesh, into the image, unless it contains the camera; the nearest surface stays.

        Args:
            placement: as in `draw_triangles`.
            shape: a name in `SHAPES`, not mesh.
            size: its sizes [m], 3 numbers.
            radius: radius of a ball about its frame that contains it [m]; may be infinite.
            label: number of the surface, 1 to `MAX_LABEL`.

        Raises:
            ValueError: for an array of another shape or type.
        """
        sizes = np.array(size, dtype=np.float64)
        check(
            library().cloth_draw_solid(
                *self._size,
                self._camera,
                float64_address("placement", placement, (12,)),
                SHAPES[shape],
                float64_address("size", sizes, (3,)),
                radius,
                label,
                *self._images,
            )
        )
