# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serialized messages from arrays.

Large messages are written as bytes directly: one Python object per point would take longer than a frame.
"""

from __future__ import annotations

import struct

import numpy as np
from geometry_msgs.msg import Vector3, WrenchStamped
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.session.cloud_points import CloudPoints

#: One second [ns].
SECOND = 1_000_000_000
#: Header of CDR in little endian, which every ROS 2 middleware sends.
CDR = b"\x00\x01\x00\x00"


class CloudMessage:
    """Serializer of sensor_msgs/PointCloud2 messages; all but stamp and points is serialized once.

    Args:
        frame_id: coordinate frame.
        height: rows of a grid, or 1.
        width: columns of a grid, or the number of particles.
        fields: further fields and precision, see `CloudPoints`.
    """

    def __init__(self, *, frame_id: str, height: int, width: int, **fields: bool) -> None:
        self._points = points = CloudPoints(height * width, **fields)
        size = points.point_step
        message = PointCloud2(height=height, width=width, point_step=size, row_step=size * width, is_dense=True)
        message.fields = [
            PointField(name=name, offset=offset, datatype=datatype, count=1) for name, offset, datatype in points.fields
        ]
        message.header.frame_id = frame_id
        # The row step is followed by the number of bytes, the bytes, and is_dense. Before it only the stamp changes.
        start = bytes(serialize_message(message))[len(CDR) + 8 : -5]
        self._middle = start + struct.pack("<I", points.size)
        # Padded to a multiple of four as on the wire: recorded and received bytes are identical.
        self._end = pad_to_multiple(b"\x01", 4)

    def serialize(self, x: Array, stamp: int, v: Array | None = None, normals: Array | None = None) -> bytes:
        """Return the CDR bytes of the cloud for positions x [m] and, if it has their fields, v [m/s] and normals.

        Args:
            x: positions, shape (3, n).
            stamp: ROS time [ns].
            v: velocities, likewise; required if the cloud has velocity fields.
            normals: unit normals, likewise; required if the cloud has normal fields.
        """
        data = self._points.write(x, v, normals)
        head = CDR + struct.pack("<iI", *divmod(stamp, SECOND))
        return b"".join((head, self._middle, data, self._end))


def mesh_bytes(triangles: NDArray[np.int64], vertices: Array) -> bytes:
    """Return the CDR bytes of a shape_msgs/Mesh of the cloth's triangles and rest positions [m].

    Args:
        triangles: particles of each triangle, shape (m, 3).
        vertices: rest positions [m], shape (n, 3).
    """
    head = struct.pack("<I", len(triangles)) + np.ascontiguousarray(triangles, dtype="<u4").tobytes()
    head += struct.pack("<I", len(vertices))
    return CDR + pad_to_multiple(head, 8) + np.ascontiguousarray(vertices, dtype="<f8").tobytes()


class SurfaceMarker:
    """Serializer of the cloth's surface as a visualization_msgs/Marker TRIANGLE_LIST, for RViz.

    Args:
        frame_id: coordinate frame.
        name: marker namespace, the node's name, so that several cloths show in one display.
        triangles: particles of each triangle, shape (m, 3).
    """

    def __init__(self, *, frame_id: str, name: str, triangles: NDArray[np.int64]) -> None:
        self._message = Marker(ns=name, id=0, type=Marker.TRIANGLE_LIST, action=Marker.ADD, frame_locked=True)
        self._message.header.frame_id = frame_id
        self._message.pose.orientation.w = 1.0
        self._message.scale = Vector3(x=1.0, y=1.0, z=1.0)
        self._message.color = ColorRGBA(r=0.85, g=0.3, b=0.25, a=1.0)
        self._corners = np.ascontiguousarray(triangles).ravel()
        # No field after the points is aligned to 8 bytes, so the tail does not depend on the number of points.
        self._tail = self._tail_length()

    def serialize(self, x: Array, stamp: int) -> bytes:
        """Return the CDR bytes of the Marker for positions x [m], shape (3, n), at a ROS time [ns]."""
        set_stamp(self._message.header.stamp, stamp)
        empty = bytes(serialize_message(self._message))
        head, tail = empty[4 : -self._tail - 4], empty[-self._tail :]
        points = np.ascontiguousarray(x[:, self._corners].T, dtype="<f8").tobytes()
        return CDR + pad_to_multiple(head + struct.pack("<I", len(self._corners)), 8) + points + tail

    @staticmethod
    def _tail_length() -> int:
        """Return the number of bytes of a serialized Marker after its points, located by the field before them."""
        plain = bytes(serialize_message(Marker()))
        locked = bytes(serialize_message(Marker(frame_locked=True)))
        offset = next(index for index, (a, b) in enumerate(zip(plain, locked, strict=True)) if a != b)
        count = 4 + -(-(offset + 1 - 4) // 4) * 4
        return len(plain) - count - 4


def wrench_message(wrench: ArrayLike, *, frame_id: str, stamp: int) -> bytes:
    """Return the CDR bytes of a WrenchStamped from force [N] and torque [N m], shape (6,), with a stamp [ns]."""
    fx, fy, fz, tx, ty, tz = np.asarray(wrench, dtype=np.float64).tolist()
    message = WrenchStamped()
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, stamp)
    message.wrench.force = Vector3(x=fx, y=fy, z=fz)
    message.wrench.torque = Vector3(x=tx, y=ty, z=tz)
    return bytes(serialize_message(message))


def set_stamp(stamp: object, nanoseconds: int) -> None:
    """Write a ROS time [ns] into a builtin_interfaces/Time message."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, SECOND)  # type: ignore[attr-defined]


def read_stamp(stamp: object) -> int:
    """Return a builtin_interfaces/Time as ROS time [ns]."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)  # type: ignore[attr-defined]


def pad_to_multiple(data: bytes, size: int) -> bytes:
    """Return bytes padded with zeros at their end to a multiple of a size [bytes], as CDR aligns fields."""
    return data + bytes(-len(data) % size)
