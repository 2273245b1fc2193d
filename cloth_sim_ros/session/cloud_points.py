# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points of a sensor_msgs/PointCloud2: fields and bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Data types of sensor_msgs/PointField.
_UINT32, _FLOAT32, _FLOAT64 = 6, 7, 8


class CloudPoints:
    """Buffer of the points of a sensor_msgs/PointCloud2: overwritten with each frame, in the layout of its fields.

    Args:
        count: number of points.
        velocity: True for fields vx, vy, vz [m/s].
        normal: True for fields normal_x, normal_y, normal_z.
        ids: True for a field id, the index of the point.
        double: True for double precision, except of ids.
        deviation: True for a field deviation [m].
    """

    def __init__(
        self,
        count: int,
        *,
        velocity: bool = False,
        normal: bool = False,
        ids: bool = False,
        double: bool = False,
        deviation: bool = False,
    ) -> None:
        length, datatype = (8, _FLOAT64) if double else (4, _FLOAT32)
        vectors = ["x", "y", "z"] + ["vx", "vy", "vz"] * velocity + ["normal_x", "normal_y", "normal_z"] * normal
        #: Name, offset [bytes] and data type of each field.
        self.fields = [(name, length * index, datatype) for index, name in enumerate(vectors)]
        offset = length * len(vectors)
        #: Bytes of the normal in a point; empty without one.
        self.normal_bytes = slice(offset - 3 * length * normal, offset)
        if deviation:
            self.fields.append(("deviation", offset, datatype))
            offset += length
        #: Size of a point [bytes].
        self.point_step = offset + 4 * ids
        self._bytes = np.zeros((count, self.point_step), np.uint8)
        if ids:
            self.fields.append(("id", offset, _UINT32))
            self._view("<u4", offset, 1)[:, 0] = np.arange(count)
        self._vectors = [self._view(f"<f{length}", 3 * length * k, 3) for k in range(len(vectors) // 3)]
        self._deviation = self._view(f"<f{length}", length * len(vectors), 1)[:, 0] if deviation else None

    def _view(self, dtype: str, offset: int, width: int) -> NDArray[np.generic]:
        length = np.dtype(dtype).itemsize
        strides = (self.point_step, length)
        return np.ndarray((len(self._bytes), width), dtype, self._bytes.data, offset=offset, strides=strides)

    @property
    def size(self) -> int:
        """Size of all points [bytes]."""
        return self._bytes.nbytes

    def write(self, *vectors: NDArray[np.float64] | None) -> memoryview:
        """Write positions, then velocities and normals if the cloud has them, each (3, n); return a view of the buffer.

        Those that are None are skipped.
        """
        present = [vector for vector in vectors if vector is not None]
        for view, vector in zip(self._vectors, present, strict=True):
            view[:] = vector.T
        return self._bytes.data

    def write_deviation(self, deviation: NDArray[np.float64]) -> None:
        """Store each point's deviation [m], shape (n,), for the next `write`; only if the cloud has that field."""
        assert self._deviation is not None
        self._deviation[:] = deviation
