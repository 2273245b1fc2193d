# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wait of a starting node for messages of others."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from cloth_sim_ros.ros.process.stopping import StopRequestedError

#: Period of the messages on what is awaited, and of the poll [s].
_MESSAGE_PERIOD, _POLL_PERIOD = 5.0, 0.1


def await_condition(
    node: Node,
    is_done: Callable[[], bool],
    describe: Callable[[], str],
    signal_name: Callable[[], str],
    *,
    on_jump_back: Callable[[], None],
) -> None:
    """Spin a node, without limit, until a condition holds; log what is awaited after 0.2 s, then every 5 s.

    Args:
        node: the node, which is in no executor yet.
        is_done: returns true if the condition holds.
        describe: returns the text on what is awaited.
        signal_name: returns the name of the signal that has come; empty if none has.
        on_jump_back: called if ROS time goes back: what came before is of another run.

    Raises:
        StopRequestedError: if a signal came meanwhile.
    """
    if is_done():
        return
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    last_time = node.get_clock().now()
    # What is there already mostly comes within the first period.
    next_message = time.monotonic() + 2.0 * _POLL_PERIOD
    try:
        while not is_done():
            if name := signal_name():
                raise StopRequestedError(name)
            if time.monotonic() >= next_message:
                node.get_logger().info(describe())
                next_message = time.monotonic() + _MESSAGE_PERIOD
            executor.spin_once(timeout_sec=_POLL_PERIOD)
            if (now := node.get_clock().now()) < last_time:
                on_jump_back()
            last_time = now
    finally:
        executor.remove_node(node)
        executor.shutdown()
