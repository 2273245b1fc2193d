# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages from arrays. Large ones are laid out in bytes directly: one Python object a point would take longer than the
frame that it shows.
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

from cloth_sim_ros.physics.forces.force import Array

#: [ns]
SECOND = 1_000_000_000
#: CDR, little endian, as every ROS 2 middleware sends.
CDR = b"\x00\x01\x00\x00"


class CloudMessage:
    """A sensor_msgs/PointCloud2 whose header stamp and points alone change: the rest is serialized once.

    Args:
        frame_id: coordinate frame.
        height: rows of a grid, or 1.
        width: columns of a grid, or the number of particles.
        velocity: whether each point has its velocity too: fields vx, vy, vz [m/s].
        double: true for fields in double precision.
    """

    def __init__(self, *, frame_id: str, height: int, width: int, velocity: bool = False, double: bool = False) -> None:
        names = ("x", "y", "z", "vx", "vy", "vz") if velocity else ("x", "y", "z")
        length, datatype = (8, PointField.FLOAT64) if double else (4, PointField.FLOAT32)
        size = length * len(names)
        message = PointCloud2(
            height=height,
            width=width,
            fields=[
                PointField(name=name, offset=length * index, datatype=datatype, count=1)
                for index, name in enumerate(names)
            ],
            is_bigendian=False,
            point_step=size,
            row_step=size * width,
            is_dense=True,
        )
        message.header.frame_id = frame_id
        self._points = np.empty((height * width, len(names)), dtype=f"<f{length}")
        # Behind the row step come the number of bytes, the bytes, and is_dense; before it all stays but the stamp.
        start = bytes(serialize_message(message))[len(CDR) + 8 : -5]
        self._middle = start + struct.pack("<I", self._points.nbytes)
        # To a multiple of four, as it travels: what is recorded is what subscribers receive, to the last byte.
        self._end = aligned(b"\x01", 4)

    def serialized(self, x: Array, stamp: int, v: Array | None = None) -> bytes:
        """Return the CDR bytes for positions x [m] at a ROS time [ns]; velocities v [m/s] where it has them; (3, n)."""
        self._points[:, :3] = x.T
        if v is not None:
            self._points[:, 3:] = v.T
        head = CDR + struct.pack("<iI", *divmod(stamp, SECOND))
        return b"".join((head, self._middle, self._points.data, self._end))


def mesh_bytes(triangles: NDArray[np.int64], vertices: Array) -> bytes:
    """Return the CDR bytes of a shape_msgs/Mesh.

    Args:
        triangles: particles of each triangle, shape (m, 3).
        vertices: rest positions [m], shape (n, 3).
    """
    head = struct.pack("<I", len(triangles)) + np.ascontiguousarray(triangles, dtype="<u4").tobytes()
    head += struct.pack("<I", len(vertices))
    return CDR + aligned(head, 8) + np.ascontiguousarray(vertices, dtype="<f8").tobytes()


class SurfaceMarker:
    """A visualization_msgs/Marker TRIANGLE_LIST of the surface, for RViz.

    Args:
        frame_id: coordinate frame.
        name: marker namespace, the node's name, so that several cloths show in one display.
        triangles: particles of each triangle, shape (m, 3).
    """

    def __init__(self, *, frame_id: str, name: str, triangles: NDArray[np.int64]) -> None:
        self._message = Marker(ns=name, id=0, type=Marker.TRIANGLE_LIST, action=Marker.ADD, frame_locked=True)
        self._message.header.frame_id = frame_id
        self._message.pose.orientation.w = 1.0
        for side in ("x", "y", "z"):
            setattr(self._message.scale, side, 1.0)
        self._message.color = ColorRGBA(r=0.85, g=0.3, b=0.25, a=1.0)
        self._corners = np.ascontiguousarray(triangles).ravel()
        # Behind the points comes nothing that is aligned to 8 bytes, so it has the same bytes whatever their number.
        self._tail = self._tail_length()

    def serialized(self, x: Array, stamp: int) -> bytes:
        """Return the CDR bytes for positions x [m], shape (3, n), at a ROS time [ns]."""
        set_stamp(self._message.header.stamp, stamp)
        empty = bytes(serialize_message(self._message))
        head, tail = empty[4 : -self._tail - 4], empty[-self._tail :]
        points = np.ascontiguousarray(x[:, self._corners].T, dtype="<f8").tobytes()
        return CDR + aligned(head + struct.pack("<I", len(self._corners)), 8) + points + tail

    @staticmethod
    def _tail_length() -> int:
        """Length of what follows the number of points: found by giving the field before it a mark."""
        plain = bytes(serialize_message(Marker()))
        locked = bytes(serialize_message(Marker(frame_locked=True)))
        place = next(index for index, (a, b) in enumerate(zip(plain, locked, strict=True)) if a != b)
        count = 4 + -(-(place + 1 - 4) // 4) * 4
        return len(plain) - count - 4


def wrench_message(wrench: ArrayLike, *, frame_id: str, stamp: int) -> bytes:
    """Return the CDR bytes of a geometry_msgs/WrenchStamped: force [N], then torque [N m], 6 numbers."""
    values = [float(value) for value in np.asarray(wrench)]
    message = WrenchStamped()
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, stamp)
    message.wrench.force = Vector3(x=values[0], y=values[1], z=values[2])
    message.wrench.torque = Vector3(x=values[3], y=values[4], z=values[5])
    return bytes(serialize_message(message))


def set_stamp(stamp: object, nanoseconds: int) -> None:
    """Write a ROS time [ns] into a builtin_interfaces/Time."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, SECOND)  # type: ignore[attr-defined]


def read_stamp(stamp: object) -> int:
    """Return a builtin_interfaces/Time as ROS time [ns]."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)  # type: ignore[attr-defined]


def aligned(data: bytes, size: int) -> bytes:
    """Fill up with zeros to a multiple of a size."""
    return data + bytes(-len(data) % size)
