# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test client of a node: gripper targets, clouds, diagnostics."""

from __future__ import annotations

import abc
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

#: Position of the lower corner of the default cloth [m].
CORNER = np.array([0.5, 0.0, 0.5])
#: Longest wait for the start of the node, an answer, or a cloud [s].
PATIENCE = 120.0


class GripperProbe(abc.ABC):
    """Publishes targets when they are due, and processes arriving messages.

    Args:
        name: name of its node.
        alive: raises RuntimeError if the measured node has ended.
    """

    def __init__(self, name: str, alive: Callable[[], None]) -> None:
        self._check_alive = alive
        self._node = Node(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._targets = self._node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", QoSProfile(depth=10))
        self._node.create_subscription(PointCloud2, "/cloth_sim/points", self.on_cloud, QoSProfile(depth=10))
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._receive_diagnostics, QoSProfile(depth=10))
        self._close = self._node.create_client(SetBool, "/cloth_sim/gripper/close")
        self._next = time.monotonic()

    @abc.abstractmethod
    def target_position(self, now: float) -> np.ndarray:
        """Return the position of the target [m], (3,), at a time [s]."""

    @abc.abstractmethod
    def pause(self) -> float:
        """Return the time until the next target [s]."""

    def before_publish(self, position: tuple[float, ...]) -> None:  # noqa: B027 - a subclass need not override it
        """Called before a target is published."""

    @abc.abstractmethod
    def on_cloud(self, cloud: PointCloud2) -> None:
        """Called with each cloud."""

    @abc.abstractmethod
    def on_diagnostics(self, values: dict[str, str]) -> None:
        """Called with each diagnostics message of the cloth."""

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self._node.destroy_node()

    def spin_until(self, condition: Callable[[], Any], *, limit: float = PATIENCE) -> None:
        """Process messages and publish targets until a condition holds.

        Raises:
            RuntimeError: if it does not hold within `limit` [s], or the measured node has ended.
        """
        end = time.monotonic() + limit
        while not condition():
            now = time.monotonic()
            self._check_alive()
            if now > end:
                raise RuntimeError(f"the condition did not hold within {limit:g} s")
            if now >= self._next:
                self._next = now + self.pause()
                self._publish(now)
            self._executor.spin_once(timeout_sec=max(0.0, min(self._next - now, 0.01)))

    def _publish(self, now: float) -> None:
        message = PoseStamped()
        p = message.pose.position
        p.x, p.y, p.z = (float(value) for value in self.target_position(now))
        message.pose.orientation.w = 1.0
        self.before_publish((p.x, p.y, p.z))
        self._targets.publish(message)

    def _receive_diagnostics(self, report: DiagnosticArray) -> None:
        for status in report.status:
            if status.name.endswith(": cloth"):
                self.on_diagnostics({entry.key: entry.value for entry in status.values})
