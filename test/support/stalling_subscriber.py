# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A subscriber that a test suspends: `stalling_subscriber.py effort topic...`.

`effort` is r (reliable) or b (best effort). It prints `receives` after ten clouds.
"""

import itertools
import os
import sys

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker

KINDS = {"points": PointCloud2, "mesh": Marker, "wrench": WrenchStamped, "diagnostics": DiagnosticArray}
#: Number of clouds after which both sides are matched.
ENOUGH = 10


def main() -> None:
    effort, *topics = sys.argv[1:]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"stalling_{os.getpid()}")
    reliability = ReliabilityPolicy.RELIABLE if effort == "r" else ReliabilityPolicy.BEST_EFFORT
    clouds = itertools.count(1)

    def receive(_: bytes) -> None:
        if next(clouds) == ENOUGH:
            print("receives", flush=True)

    for topic in topics:
        kind = KINDS[topic.rpartition("/")[2]]
        take = receive if kind is PointCloud2 else lambda _: None
        node.create_subscription(kind, topic, take, QoSProfile(depth=10, reliability=reliability), raw=True)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.5)


if __name__ == "__main__":
    main()
