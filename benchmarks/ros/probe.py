# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test clients of a node: gripper targets, clouds, diagnostics, requests."""

from __future__ import annotations

import abc
import time
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

from benchmarks.ros.node_process import PATIENCE, NodeProcess

#: Position of the lower corner of the default cloth [m].
CORNER = np.array([0.5, 0.0, 0.5])


class Probe:
    """Client that processes messages while it waits.

    Args:
        name: name of its node.
        measured: the measured node.
        namespace: namespace of its node.
    """

    def __init__(self, name: str, measured: NodeProcess, *, namespace: str = "") -> None:
        self.node = Node(name, namespace=namespace)
        self._measured = measured
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def spin_until(self, condition: Callable[[], Any], *, limit: float = PATIENCE) -> None:
        """Process messages until a condition holds.

        Raises:
            RuntimeError: if it does not hold within `limit` [s], or the measured node has ended.
        """
        end = time.monotonic() + limit
        while not condition():
            self._measured.check_alive()
            if time.monotonic() > end:
                raise RuntimeError(f"the condition did not hold within {limit:g} s")
            self.spin_once()

    def spin_once(self) -> None:
        """Process the messages that have arrived, or wait a moment for one."""
        self._executor.spin_once(timeout_sec=0.01)

    def request(self, client: Any, request: Any) -> Any:
        """Return a service's answer.

        Raises:
            RuntimeError: if the service refuses the request.
        """
        future = client.call_async(request)
        self.spin_until(future.done)
        answer = future.result()
        if not getattr(answer, "success", True):
            raise RuntimeError(f"{client.srv_name}: {answer.message}")
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()


class GripperProbe(Probe, abc.ABC):
    """Probe that publishes targets when they are due, and receives clouds and diagnostics.

    Args:
        name: name of its node.
        measured: the measured node.
    """

    def __init__(self, name: str, measured: NodeProcess) -> None:
        super().__init__(name, measured)
        self._targets = self.node.create_publisher(PoseStamped, "/cloth_sim/gripper/target", QoSProfile(depth=10))
        self.node.create_subscription(PointCloud2, "/cloth_sim/points", self.on_cloud, QoSProfile(depth=10))
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive_diagnostics, QoSProfile(depth=10))
        self._close = self.node.create_client(SetBool, "/cloth_sim/gripper/close")
        self._next = time.monotonic()

    @abc.abstractmethod
    def target_position(self, now: float) -> np.ndarray:
        """Return the position of the target [m], (3,), at a time [s]."""

    @abc.abstractmethod
    def pause(self) -> float:
        """Return the time until the next target [s]."""

    def before_publish(self, position: tuple[float, ...]) -> None:
        """Called before a target is published."""

    @abc.abstractmethod
    def on_cloud(self, cloud: PointCloud2) -> None:
        """Called with each cloud."""

    @abc.abstractmethod
    def on_diagnostics(self, values: dict[str, str]) -> None:
        """Called with each diagnostics message of the cloth."""

    def spin_once(self) -> None:
        now = time.monotonic()
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


def stamp_ns(cloud: PointCloud2) -> int:
    """Return the stamp of a cloud [ns]."""
    stamp = cloud.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
