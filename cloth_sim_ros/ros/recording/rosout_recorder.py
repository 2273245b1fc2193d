# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorder of the node's own messages on /rosout and /parameter_events."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_parameter_events
from rclpy.serialization import deserialize_message

from cloth_sim_ros.ros.io.output import RecordSink

_ROSOUT_QOS = QoSProfile(depth=1000)


class RosoutRecorder:
    """Records this node's messages on the topics that all nodes share, while a recording runs.

    Args:
        node: the node.
        sink: records the messages.
        lock: held while a message is recorded.
    """

    def __init__(self, node: Node, sink: RecordSink, lock: AbstractContextManager[Any]) -> None:
        self._lock, self._node, self._sink = lock, node, sink
        self._subscriptions: list[Any] = []

    def update(self) -> None:
        """Subscribe while a recording runs, and unsubscribe afterwards: many nodes publish on these topics."""
        if self._sink.running and not self._subscriptions:
            logger, name = self._node.get_logger().name, self._node.get_fully_qualified_name()
            self._subscribe(Log, "/rosout", _ROSOUT_QOS, lambda message: message.name == logger)
            self._subscribe(
                ParameterEvent, "/parameter_events", qos_profile_parameter_events, lambda message: message.node == name
            )
        elif not self._sink.running and self._subscriptions:
            for subscription in self._subscriptions:
                self._node.destroy_subscription(subscription)
            self._subscriptions = []

    def _subscribe(self, kind: Any, topic: str, qos: QoSProfile, matches: Callable[[Any], bool]) -> None:
        def take(data: bytes) -> None:
            try:
                is_match = matches(deserialize_message(data, kind))
            except (RuntimeError, UnicodeDecodeError):
                # Malformed bytes of another node.
                return
            if is_match:
                stamp = self._node.get_clock().now().nanoseconds
                with self._lock:
                    self._sink.add(topic, kind, data, stamp=stamp, qos=qos, droppable=False)

        self._subscriptions.append(self._node.create_subscription(kind, topic, take, qos, raw=True))
