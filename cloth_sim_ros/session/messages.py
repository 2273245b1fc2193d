# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CDR encoders (XCDR1, little-endian) for the messages of each frame.

Hand-written, because a generic encoder takes longer than the frame of a small cloth. Times are ROS times [ns].

Alignment counts from the byte after the four-byte encapsulation header, as in `cdr`, which reads them.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.session.cloud_points import CloudPoints

CLOUD = "sensor_msgs/msg/PointCloud2"
MESH = "shape_msgs/msg/Mesh"
STRING = "std_msgs/msg/String"
WRENCH = "geometry_msgs/msg/WrenchStamped"
POINT = "geometry_msgs/msg/PointStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
POSE = "geometry_msgs/msg/PoseStamped"
BOOL = "std_msgs/msg/Bool"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_LITTLE = b"\x00\x01\x00\x00"
_SECOND = 1_000_000_000
#: Packers of a time, and of 3, 6 and 7 doubles.
_TIME = struct.Struct("<iI").pack
_DOUBLES = {count: struct.Struct(f"<{count}d").pack for count in (3, 6, 7)}


class CloudEncoder:
    """Encoder of sensor_msgs/PointCloud2 messages that differ in stamp and points only.

    Args:
        frame_id: coordinate frame.
        height: rows of a grid, or 1.
        width: columns of a grid, or the number of particles.
        fields: further fields and precision, see `CloudPoints`.
    """

    def __init__(self, *, frame_id: str, height: int, width: int, **fields: bool) -> None:
        self._points = points = CloudPoints(height * width, **fields)
        body = bytearray(8) + _encode_text(frame_id)
        body = _pad(body, 4) + struct.pack("<III", height, width, len(points.fields))
        for name, offset, datatype in points.fields:
            body = _pad(body, 4) + _encode_text(name)
            body = _pad(body, 4) + struct.pack("<IB", offset, datatype)
            body = _pad(body, 4) + struct.pack("<I", 1)
        size = points.point_step
        body = _pad(body + b"\x00", 4) + struct.pack("<III", size, size * width, points.size)
        self._constant_part = bytes(body[8:])
        # After the points: is_dense, padded to four bytes.
        self._trailer = b"\x01\x00\x00\x00"

    @property
    def points_offset(self) -> int:
        """Offset of the points in the message [bytes]."""
        return len(_LITTLE) + 8 + len(self._constant_part)

    def with_normals_of(self, data: bytes, source: bytes) -> bytes:
        """Return cloud bytes `data` with the normals of cloud `source`, both of this layout; `data` if one is short."""
        points, start = self._points, self.points_offset
        if min(len(data), len(source)) < start + points.size:
            return data
        result = np.frombuffer(bytearray(data), np.uint8)
        rows, source_rows = (
            array[start : start + points.size].reshape(-1, points.point_step)
            for array in (result, np.frombuffer(source, np.uint8))
        )
        rows[:, points.normal_bytes] = source_rows[:, points.normal_bytes]
        return result.tobytes()

    def encode(
        self,
        x: NDArray[np.float64],
        stamp: int,
        v: NDArray[np.float64] | None = None,
        normals: NDArray[np.float64] | None = None,
        deviation: NDArray[np.float64] | None = None,
    ) -> bytes:
        """Return CDR bytes of positions x [m] and, if the cloud has them, velocities v [m/s] and normals, all (3, n).

        `deviation`: deviation of each particle [m], shape (n,), if the cloud has that field.
        """
        if deviation is not None:
            self._points.write_deviation(deviation)
        data = self._points.write(x, v, normals)
        return b"".join((_LITTLE, _encode_stamp(stamp), self._constant_part, data, self._trailer))


def mesh_bytes(triangles: ArrayLike, vertices: ArrayLike) -> bytes:
    """Encode a shape_msgs/Mesh as CDR bytes: particle indices of the triangles (m, 3), rest positions [m] (n, 3)."""
    triangle_indices = np.ascontiguousarray(triangles, dtype="<u4")
    positions = np.ascontiguousarray(vertices, dtype="<f8")
    header = struct.pack("<I", len(triangle_indices)) + triangle_indices.tobytes() + struct.pack("<I", len(positions))
    return _LITTLE + bytes(_pad(bytearray(header), 8)) + positions.tobytes()


def pose_bytes(position: Iterable[float], orientation: Iterable[float], *, frame_id: str, stamp: int) -> bytes:
    """Encode a geometry_msgs/PoseStamped as CDR bytes: position [m], quaternion x, y, z, w; stamp [ns]."""
    return _encode_stamped(frame_id, stamp, (*position, *orientation))


def point_bytes(position: Iterable[float], *, frame_id: str, stamp: int) -> bytes:
    """Encode a geometry_msgs/PointStamped as CDR bytes: position [m], stamp [ns]."""
    return _encode_stamped(frame_id, stamp, tuple(position))


def wrench_bytes(wrench: Iterable[float], *, frame_id: str, stamp: int) -> bytes:
    """Encode a geometry_msgs/WrenchStamped as CDR bytes: 6 numbers, force [N], then torque [N m]; stamp [ns]."""
    return _encode_stamped(frame_id, stamp, tuple(map(float, wrench)))


def transforms_bytes(frames: Iterable[tuple[str, Iterable[float]]], *, frame_id: str, stamp: int) -> bytes:
    """Encode a tf2_msgs/TFMessage: pairs of name and pose in `frame_id`, position [m] and quaternion x, y, z, w."""
    frame_list = list(frames)
    body = bytearray(struct.pack("<I", len(frame_list)))
    for name, pose in frame_list:
        body = _pad(body, 4) + _encode_stamp(stamp) + _encode_text(frame_id)
        body = _pad(_pad(body, 4) + _encode_text(name), 8) + _DOUBLES[7](*pose)
    return _LITTLE + bytes(body)


def bool_bytes(value: bool) -> bytes:
    """Encode a std_msgs/Bool as CDR bytes."""
    return _LITTLE + bytes([value])


def _encode_stamped(frame_id: str, stamp: int, numbers: tuple[float, ...]) -> bytes:
    pack_numbers = _DOUBLES[len(numbers)]
    return b"".join((_LITTLE, _encode_stamp(stamp), _encode_frame_id(frame_id), pack_numbers(*numbers)))


@functools.lru_cache(maxsize=16)
def _encode_frame_id(frame_id: str) -> bytes:
    """Encode a header's frame_id, padded to the alignment of doubles."""
    return bytes(_pad(bytearray(8) + _encode_text(frame_id), 8)[8:])


def _encode_stamp(nanoseconds: int) -> bytes:
    return _TIME(*divmod(nanoseconds, _SECOND))


def _encode_text(text: str) -> bytes:
    raw = text.encode()
    return struct.pack("<I", len(raw) + 1) + raw + b"\x00"


def _pad(body: bytearray, size: int) -> bytearray:
    return body + bytes(-len(body) % size)
