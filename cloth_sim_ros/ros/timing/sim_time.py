# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated time of a node: `use_sim_time` and checks of /clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from cloth_sim_ros.ros.io.messages import SECOND, read_stamp
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Name of ROS's parameter.
SIM_TIME = "use_sim_time"
#: Latest time that a stamp can hold: its seconds have 31 bits [ns].
_MAX_STAMP = 2**31 * SECOND - 1
#: Longest silence of /clock before the first warning [s].
_SILENCE_LIMIT = 5.0
#: Period of repeated warnings [s].
_WARNING_PERIOD = 60.0


def check_sim_time(value: Any) -> None:
    """Raise ParameterError if a value of `use_sim_time` is no bool; rclpy would log an error and use wall time.

    Raises:
        ParameterError: names the allowed values.
    """
    if not isinstance(value, bool):
        raise ParameterError(f"{SIM_TIME} is {value!r}; it must be true or false, without quotes: {SIM_TIME}:=true")


class SimTimeNode(Node):
    """rclpy's node, except that it ignores messages on /clock whose time is invalid.

    rclpy's subscription of /clock raises for times before 0, and accepts times that no stamp can hold.
    """

    #: True once a time has come on /clock; 0 is valid, and also rclpy's time before the first message.
    has_clock_time = False

    def create_subscription(self, msg_type: Any, topic: str, callback: Any, *arguments: Any, **options: Any) -> Any:
        """Create a subscription; that of /clock, which rclpy itself creates by this method, drops invalid times.

        Raises:
            ParameterError: if another endpoint of the process has the topic with another type.
        """
        log = ThrottledLog(self.get_logger(), seconds=_WARNING_PERIOD)

        def take_valid(message: Clock) -> Any:
            if 0 <= (now := read_stamp(message.clock)) <= _MAX_STAMP:
                self.has_clock_time = True
                return callback(message)
            kind = "before 0" if now < 0 else "too late"
            log.warn(
                kind,
                f"a message on /clock is left out: its time is {now / SECOND:.3f} s (sec {message.clock.sec}, nanosec "
                f"{message.clock.nanosec}), and must be at least 0 and below {2**31} s; check the publisher of /clock",
            )
            return None

        is_clock = msg_type is Clock and not options.get("raw")
        take = take_valid if is_clock else callback
        try:
            return super().create_subscription(msg_type, topic, take, *arguments, **options)
        except RuntimeError as error:
            raise ParameterError(f"no subscription {same_topic_text(self, topic, msg_type, error)}") from error


def same_topic_text(node: Node, topic: str, kind: type, error: RuntimeError) -> str:
    """Return the end of a sentence on an endpoint that the middleware refuses, mostly for a topic of two types."""
    # Without source locations.
    reason = str(error).partition(", at ")[0]
    return (
        f"of {kind.__name__} on {node.resolve_topic_name(topic)} ({reason}): another topic of this node may be "
        "remapped to the same name with another type; remap one of them"
    )


class ClockSilence:
    """Warning of a silent /clock after 5 s, and once a minute from then on.

    Args:
        log: a node's logger.
        seconds: monotonic clock [s].
    """

    def __init__(self, log: Any, *, seconds: Callable[[], float] = time.monotonic) -> None:
        self._log, self._seconds = log, seconds
        self._began = seconds()
        self._next_warning = self._began + _SILENCE_LIMIT

    @property
    def seconds(self) -> float:
        """Time since this object was created [s]."""
        return self._seconds() - self._began

    def check(self) -> None:
        """Log the warning if it is due. Call it periodically while no message has come on /clock."""
        now = self._seconds()
        if now <= self._next_warning:
            return
        self._next_warning = now + _WARNING_PERIOD
        self._log.warning(
            f"{SIM_TIME} is set, and for {now - self._began:.0f} s nothing has come on /clock: the cloth waits; start "
            f"what publishes it, or start the cloth with {SIM_TIME}:=false"
        )
