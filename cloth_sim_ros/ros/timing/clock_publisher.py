# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publisher of /clock, for a graph whose slowest simulator is the cloth."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock

from cloth_sim_ros.ros.io.messages import SECOND, set_stamp
from cloth_sim_ros.ros.reporting.log import ThrottledLog

_TOPIC = "/clock"
#: As rclcpp's ClockQoS.
_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class ClockPublisher:
    """Publisher of simulated time on /clock, which is also the ROS time of the node itself.

    Args:
        node: the cloth's node, which must not follow /clock.
        log: receives warnings of other publishers.
        seconds: simulated time at the start [s].
    """

    def __init__(self, node: Node, log: ThrottledLog, seconds: float) -> None:
        self._node, self._log = node, log
        self._publisher = node.create_publisher(Clock, _TOPIC, _QOS)
        self._message = Clock()
        self._time_source = TimeSource()
        self._time_source.attach_clock(node.get_clock())
        #: ROS time [ns].
        self.now = self._set_time(seconds)
        self._time_source.ros_time_is_active = True

    def send(self, seconds: float) -> int:
        """Publish the simulated time at the end of a frame [s], and return it as ROS time [ns].

        Messages of the frame are published after it, so that a follower's clock has reached their stamps.
        """
        self.now = self._set_time(seconds)
        self._publisher.publish(self._message)
        return self.now

    def check(self) -> None:
        """Warn if another node publishes /clock too. Call it periodically."""
        this = self._node.get_fully_qualified_name()
        publishers = [
            f"{entry.node_namespace.rstrip('/')}/{entry.node_name}"
            for entry in self._node.get_publishers_info_by_topic(_TOPIC)
        ]
        if this in publishers:
            # Another node may have the same name.
            publishers.remove(this)
        names = sorted(f"another node {name}" if name == this else name for name in set(publishers))
        if names:
            self._log.warn(
                "clock",
                f"{', '.join(names)} publishes {_TOPIC} too: time jumps back and forth for all nodes that follow it; "
                "set publish_clock:=false, or stop the other publisher",
            )

    def _set_time(self, seconds: float) -> int:
        nanoseconds = round(seconds * SECOND)
        set_stamp(self._message.clock, nanoseconds)
        self._time_source.clock_callback(self._message)
        return nanoseconds
