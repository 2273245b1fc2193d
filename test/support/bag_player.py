# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What `ros2 bag play` does with a session, without rosbag2: another reader, recorded profiles, recorded pace.

Publishers offer what the file says of each topic; messages go out as the bytes that they are, by log time; with `clock`
the time of the bag is published on /clock, 40 times a second, as its option `--clock` does.
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
#: A turn of the node takes no longer than this, unless the machine is busy [s].
_LONG = 0.02


def message_class(name: str) -> Any:
    """The class of a message type, e.g. ``std_msgs/msg/Bool``."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def qos_of(connection: Connection) -> QoSProfile:
    """The profile that a player offers for a recorded topic: all recorded ones alike, else there would be none."""
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
    """Play topics of a session to whoever listens; how many messages went out.

    Args:
        path: the session's file.
        client: whose node publishes; it spins in between.
        topics: what is played.
        clock: publish the bag's time.
        spin: waits so many seconds; the client's executor where left out.
    """
    node, wanted = client.node, set(topics)
    spin = spin or (lambda seconds: client.executor.spin_once(timeout_sec=seconds))
    with Reader(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in wanted]
        assert {connection.topic for connection in connections} == wanted
        publishers = {
            connection.topic: node.create_publisher(
                message_class(connection.msgtype), connection.topic, qos_of(connection)
            )
            for connection in connections
        }
        # What `--delay` is for: publishers and subscriptions meet.
        for topic, publisher in publishers.items():
            client.spin_until(publisher.get_subscription_count, what=f"a subscriber of {topic} that takes its profile")
        ticker = node.create_publisher(Clock, "/clock", 10) if clock else None
        if ticker is not None:
            client.spin_until(ticker.get_subscription_count, what="a subscriber of /clock")
        begin, begun, ticked, sent = reader.start_time, time.monotonic(), -1.0, 0

        def tick(elapsed: float) -> None:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(begin + int(elapsed * 1e9), 1_000_000_000)
            ticker.publish(message)

        messages = reader.messages(connections=connections)
        coming = next(messages, None)
        while coming is not None:
            connection, stamp, data = coming
            elapsed = time.monotonic() - begun
            if ticker is not None and elapsed - ticked >= _CLOCK_PERIOD:
                tick(elapsed)
                ticked = elapsed
            if (stamp - begin) * 1e-9 <= elapsed:
                publishers[connection.topic].publish(bytes(data))
                sent += 1
                coming = next(messages, None)
            else:
                asked = time.monotonic()
                spin(0.001)
                # The node shares this thread. What a busy machine makes of it is not the player's time: another process
                # would play on, and all that is late would come at once.
                begun += max(0.0, time.monotonic() - asked - _LONG)
        if ticker is not None:
            # So that what came last has its frame, too.
            tick(time.monotonic() - begun + 0.1)
            spin(0.05)
        for publisher in [*publishers.values(), *([ticker] if ticker else [])]:
            node.destroy_publisher(publisher)
    return sent
