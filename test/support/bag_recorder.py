# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorder of bags like `ros2 bag record -a` with MCAP storage, without rosbag2.

It subscribes to each topic of the graph when it appears, with the offered profile, and writes the received bytes: log
time is the time of reception, sequence numbers are 0, and no attachment is written.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.writer import CompressionType, Writer
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from cloth_sim_ros.session.channel_description import describe
from support.bag_player import message_class


class BagRecorder:
    """Records the topics of a graph into an MCAP file; a context manager.

    Args:
        node: its executor spins during the recording.
        path: the bag's file.
        matches: returns True for a topic to record; by default all.
        keeps: returns False for a message that is lost: topic, index on the topic.
    """

    def __init__(
        self,
        node: Node,
        path: Path,
        *,
        matches: Callable[[str], bool] = lambda _topic: True,
        keeps: Callable[[str, int], bool] = lambda _topic, _index: True,
    ) -> None:
        self._node, self._matches, self._keeps = node, matches, keeps
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="libmcap 1.3.0")
        self._writer.add_metadata("rosbag2", {"serialized_metadata": "rosbag2_bagfile_information:\n  version: 9\n"})
        self._subscriptions: dict[str, Any] = {}
        self._channels: dict[str, int] = {}
        self.counts: dict[str, int] = {}
        self.discover()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _: TracebackType | None
    ) -> None:
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._writer.finish()
        self._stream.close()

    def discover(self) -> None:
        """Subscribe to new topics; rosbag2 polls the graph ten times a second."""
        for topic, (kind, *_) in self._node.get_topic_names_and_types():
            offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
            if topic in self._subscriptions or not offers or not self._matches(topic):
                continue
            reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
            latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
            profile = QoSProfile(
                depth=1000,
                reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
            )
            self.counts[topic] = 0
            self._subscriptions[topic] = self._node.create_subscription(
                message_class(kind), topic, partial(self._write, topic, kind), profile, raw=True
            )

    def _write(self, topic: str, kind: str, data: bytes) -> None:
        index = self.counts[topic]
        self.counts[topic] += 1
        if not self._keeps(topic, index):
            return
        if topic not in self._channels:
            definition = describe(kind).definition.encode()
            schema = self._writer.register_schema(kind, "ros2msg", definition)
            profiles = {"offered_qos_profiles": "", "topic_type_hash": describe(kind).type_hash}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, profiles)
        now = time.time_ns()
        self._writer.add_message(self._channels[topic], now, bytes(data), now, 0)
