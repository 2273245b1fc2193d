# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriber of clouds in its own process: `python -m benchmarks.ros.listener TOPIC [FILE]`.

With a file it records the stamp of each cloud and its arrival by the monotonic clock, as two int64 [ns].
"""

from __future__ import annotations

import contextlib
import gc
import os
import struct
import sys
import time
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

#: Stamp [ns] and arrival [ns].
LINE = struct.Struct("<qq")
#: Seconds and nanoseconds of the stamp in a serialized cloud, after the encapsulation header.
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4


def listen(topic: str, file: Path) -> None:
    """Record stamp and arrival of each cloud until a signal arrives."""
    rclpy.init(args=[])
    node = Node(f"listener_{os.getpid()}")
    with file.open("ab", buffering=0) as stream:

        def record(data: bytes) -> None:
            now = time.monotonic_ns()
            second, nano = _STAMP.unpack_from(data, _STAMP_AT)
            stream.write(LINE.pack(second * 1_000_000_000 + nano, now))

        node.create_subscription(PointCloud2, topic, record, QoSProfile(depth=10), raw=True)
        gc.collect()
        gc.freeze()
        with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(node)


if __name__ == "__main__":
    listen(sys.argv[1], Path(sys.argv[2] if len(sys.argv) > 2 else os.devnull))
