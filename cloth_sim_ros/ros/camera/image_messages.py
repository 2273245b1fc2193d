# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serialized messages of a depth camera. Only stamp and data change, so the rest is serialized once."""

from __future__ import annotations

import struct
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from cloth_sim_ros.ros.io.messages import CDR, SECOND, pad_to_multiple

#: Bytes of the number of data, and of is_dense behind it.
_COUNT, _IS_DENSE = 4, 1


class ImageMessage:
    """Serializer of sensor_msgs/Image messages of one channel: depths or labels."""

    def __init__(self, *, frame_id: str, width: int, height: int, encoding: str) -> None:
        step = width * (4 if encoding == "32FC1" else 2)
        message = Image(width=width, height=height, encoding=encoding, step=step)
        message.is_bigendian = int(sys.byteorder == "big")
        message.header.frame_id = frame_id
        self._start = _after_stamp(message)[:-_COUNT]

    def serialize(self, pixels: NDArray[Any], stamp: int) -> bytes:
        """Return the CDR bytes of the Image for contiguous pixels (height, width) at a ROS time [ns]."""
        return _joined(stamp, self._start, pixels, bytes(-pixels.nbytes % 4))


class PointsMessage:
    """Serializer of sensor_msgs/PointCloud2 messages with a point for each pixel, NaN for a pixel without depth."""

    def __init__(self, *, frame_id: str, width: int, height: int) -> None:
        message = PointCloud2(width=width, height=height, point_step=12, row_step=12 * width, is_dense=False)
        message.is_bigendian = sys.byteorder == "big"
        message.fields = [
            PointField(name=name, offset=4 * index, datatype=PointField.FLOAT32, count=1)
            for index, name in enumerate("xyz")
        ]
        message.header.frame_id = frame_id
        self._start = _after_stamp(message)[: -_COUNT - _IS_DENSE]

    def serialize(self, points: NDArray[np.float32], stamp: int) -> bytes:
        """Return the CDR bytes of the PointCloud2 for points (height, width, 3) [m] at a ROS time [ns]."""
        return _joined(stamp, self._start, points, pad_to_multiple(b"\0", 4))


class CameraInfoMessage:
    """Serializer of sensor_msgs/CameraInfo messages of a camera without distortion.

    Args:
        frame_id: optical frame.
        width: columns.
        height: rows.
        intrinsics: fx, fy, cx, cy [pixels].
    """

    def __init__(
        self, *, frame_id: str, width: int, height: int, intrinsics: tuple[float, float, float, float]
    ) -> None:
        fx, fy, cx, cy = intrinsics
        message = CameraInfo(width=width, height=height, distortion_model="plumb_bob", d=[0.0] * 5)
        message.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        message.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        message.header.frame_id = frame_id
        self._end = _after_stamp(message)

    def serialize(self, stamp: int) -> bytes:
        """Return the CDR bytes of the CameraInfo with a ROS time [ns] as stamp."""
        return _head(stamp) + self._end


def millimetres(depths: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert depths [m], at most 65.535, to uint16 in millimetres; NaN, which is no depth, becomes 0."""
    return np.nan_to_num(np.rint(depths * np.float32(1000.0)), copy=False, nan=0.0).astype(np.uint16)


def _after_stamp(message: Any) -> bytes:
    """Serialize a message, and return the bytes that follow the stamp of its header."""
    return bytes(serialize_message(message))[len(CDR) + 8 :]


def _head(stamp: int) -> bytes:
    return CDR + struct.pack("<iI", *divmod(stamp, SECOND))


def _joined(stamp: int, start: bytes, data: NDArray[Any], end: bytes) -> bytes:
    return b"".join((_head(stamp), start, struct.pack("<I", data.nbytes), data.data, end))
