# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS client for tests: publishers, subscriptions and service calls with time limits."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

#: Longest wait [s], as for a process: a busy machine may be twenty times as slow.
LIMIT = 60.0
#: The node's last log text before its first frame.
STARTED = "wall time, grippers"


class Client:
    """A node with its own context; a context manager."""

    def __init__(self, name: str = "test_client") -> None:
        self.context = rclpy.Context()
        self.context.init()
        self.node = Node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.clouds: list[PointCloud2] = []
        self._publishers: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.shutdown()

    def spin_until(self, condition: Callable[[], Any], *, description: str, limit: float = LIMIT) -> Any:
        """Spin until the condition holds and return its value."""
        end = time.monotonic() + limit
        while not (value := condition()):
            if time.monotonic() > end:
                pytest.fail(f"waited {limit:g} s in vain for {description}")
            self.executor.spin_once(timeout_sec=0.02)
        return value

    def watch(self, node: str = "/cloth_sim", depth: int = 1000) -> None:
        """Subscribe to clouds, and wait for the first one."""
        self.node.create_subscription(PointCloud2, f"{node}/points", self.clouds.append, QoSProfile(depth=depth))
        self.spin_until(lambda: self.clouds, description="the first cloud")

    def wait_for_clouds(self, count: int) -> PointCloud2:
        """Spin until a number of further clouds have come, and return the newest."""
        goal = len(self.clouds) + count
        self.spin_until(lambda: len(self.clouds) >= goal, description=f"{count} clouds")
        return self.clouds[-1]

    def publisher(self, kind: Any, topic: str) -> Any:
        """Return a publisher that has matched its subscriber."""
        if topic not in self._publishers:
            publisher = self.node.create_publisher(kind, topic, QoSProfile(depth=1000))
            self._publishers[topic] = publisher
            self.spin_until(publisher.get_subscription_count, description=f"a subscriber of {topic}")
        return self._publishers[topic]

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        """Call a service and return its answer."""
        client = self.node.create_client(kind, name)
        self.spin_until(client.service_is_ready, description=f"the service {name}")
        future = client.call_async(kind.Request() if request is None else request)
        self.spin_until(future.done, description=f"an answer of {name}")
        self.node.destroy_client(client)
        return future.result()


def positions(cloud: PointCloud2) -> np.ndarray:
    """Return the points of a cloud [m], shape (n, 3)."""
    return np.frombuffer(bytes(cloud.data), dtype="<f4").reshape(-1, 3)


def stamp_of(cloud: PointCloud2) -> int:
    """Return the header stamp [ns]."""
    return int(cloud.header.stamp.sec) * 1_000_000_000 + int(cloud.header.stamp.nanosec)


def pose(x: float, y: float, z: float, *, frame_id: str = "", stamp: int = 0, w: float = 1.0) -> PoseStamped:
    """Return a target at x, y, z [m]."""
    message = PoseStamped()
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    message.pose.position.x, message.pose.position.y, message.pose.position.z = x, y, z
    message.pose.orientation.w = w
    return message


def start_cloth(
    start_process: Callable[..., Any],
    *parameters: str,
    wait: str = STARTED,
    arguments: Sequence[str] = (),
    **options: Any,
) -> Any:
    """Start the node as a process with parameters `name:=value` and ROS arguments, and wait for its first frame."""
    command: list[str | Path] = ["-m", "cloth_sim_ros.ros.main", "--ros-args", *arguments]
    for parameter in parameters:
        command += ["-p", parameter]
    process = start_process(command, **options)
    if wait:
        process.wait_for_output(wait)
    return process
