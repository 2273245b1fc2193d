# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Player of sessions like `ros2 bag play`, without rosbag2.

Another reader reads the file. Publishers offer the recorded profiles, and messages are published as recorded bytes by
log time. With `clock` the time of the bag is published on /clock at 40 Hz, as by the option `--clock`.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Connection, QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock

_CLOCK_PERIOD = 1.0 / 40.0
#: Longest spin of the node unless the machine is busy [s].
_MAX_SPIN = 0.02


def message_class(name: str) -> Any:
    """Return the class of a message type, e.g. ``std_msgs/msg/Bool``."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def qos_of(connection: Connection) -> QoSProfile:
    """Return the profile for a recorded topic; all its recorded profiles must be equal."""
    (recorded,) = {*connection.ext.offered_qos_profiles}  # type: ignore[union-attr]
    reliable = recorded.reliability is QosReliability.RELIABLE
    latched = recorded.durability is QosDurability.TRANSIENT_LOCAL
    assert reliable or recorded.reliability is QosReliability.BEST_EFFORT
    assert latched or recorded.durability is QosDurability.VOLATILE
    return QoSProfile(
        depth=10,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def play(
    path: Path, client: Any, *, topics: Iterable[str], clock: bool = False, spin: Callable[[float], None] | None = None
) -> int:
    """Play topics of a session; return the number of published messages.

    Args:
        path: the session's file.
        client: the client whose node publishes; it spins in between.
        topics: topics to play.
        clock: true to publish the bag's time.
        spin: waits for a time [s]; by default the client's executor spins.
    """
    node, topic_names = client.node, set(topics)
    spin = spin or (lambda seconds: client.executor.spin_once(timeout_sec=seconds))
    with Reader(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topic_names]
        assert {connection.topic for connection in connections} == topic_names
        publishers = {
            connection.topic: node.create_publisher(
                message_class(connection.msgtype), connection.topic, qos_of(connection)
            )
            for connection in connections
        }
        # Like `--delay`: wait until publishers and subscriptions are matched.
        for topic, publisher in publishers.items():
            client.spin_until(
                publisher.get_subscription_count, description=f"a subscriber of {topic} that takes its profile"
            )
        ticker = node.create_publisher(Clock, "/clock", 10) if clock else None
        if ticker is not None:
            client.spin_until(ticker.get_subscription_count, description="a subscriber of /clock")
        begin, start, ticked, sent = reader.start_time, time.monotonic(), -1.0, 0

        def tick(elapsed: float) -> None:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(begin + int(elapsed * 1e9), 1_000_000_000)
            ticker.publish(message)

        messages = reader.messages(connections=connections)
        upcoming = next(messages, None)
        while upcoming is not None:
            connection, stamp, data = upcoming
            elapsed = time.monotonic() - start
            if ticker is not None and elapsed - ticked >= _CLOCK_PERIOD:
                tick(elapsed)
                ticked = elapsed
            if (stamp - begin) * 1e-9 <= elapsed:
                publishers[connection.topic].publish(bytes(data))
                sent += 1
                upcoming = next(messages, None)
            else:
                spin_start = time.monotonic()
                spin(0.001)
                # The node shares this thread. Exclude its delays on a busy machine from the player's time; otherwise
                # all late messages would be sent at once.
                start += max(0.0, time.monotonic() - spin_start - _MAX_SPIN)
        if ticker is not None:
            # So that the last messages have their frame too.
            tick(time.monotonic() - start + 0.1)
            spin(0.05)
        for publisher in [*publishers.values(), *([ticker] if ticker else [])]:
            node.destroy_publisher(publisher)
    return sent
