# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publisher and subscriber of ~/clock, the simulated time of a cloth."""

from __future__ import annotations

import time
from typing import Any

from lifecycle_msgs.msg import State
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from cloth_sim_ros.ros.io.messages import SECOND, read_stamp, set_stamp
from cloth_sim_ros.ros.io.output import LATCHED_QOS, STREAM_QOS, Output, RecordSink

#: Name of the topic below the node's name.
TOPIC = "clock"
#: A cloth is slow if its frames take more than this ratio of wall to simulated time. Its next frame starts at once, in
#: a race with the target. Therefore the target waits for this fraction of a frame and is applied by the frame after.
_SLOW_FACTOR, _DELAY_FRACTION = 1.2, 0.25


class ClothClock:
    """Publisher of each frame's simulated time on ~/clock.

    The topic is not recorded, because the frame records hold the time.

    Args:
        node: the cloth's node.
        sink: records other outputs.
    """

    def __init__(self, node: Node, sink: RecordSink) -> None:
        self._output = Output(node, Clock, f"~/{TOPIC}", sink)

    def send(self, seconds: float) -> None:
        """Publish the simulated time at the end of a frame [s], if ~/clock has subscribers."""
        if self._output.has_subscribers:
            message = Clock()
            set_stamp(message.clock, round(seconds * SECOND))
            self._output.publish(message)


class ClothTime:
    """Subscriber of another node's ~/clock: the simulated time of its cloth, by which clients time targets.

    Args:
        node: the caller's node.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
    """

    def __init__(self, node: Node, target: str) -> None:
        self._topic = f"{target}/{TOPIC}"
        self._newest: int | None = None
        #: Simulated time of one frame [ns]; 0 if it is not known yet.
        self.period = 0
        #: The latest time that `now` returned [ns].
        self._last_returned = 0
        #: Steady time at which the newest message arrived, and the wall time between the last two [s].
        self._arrival = self._interval = 0.0
        self._label = ""
        node.create_subscription(Clock, self._topic, self._on_clock, STREAM_QOS)
        node.create_subscription(State, f"{target}/state", self._on_state, LATCHED_QOS)

    def now(self) -> int | None:
        """Return the end of the frame that the cloth computes next, in simulated time [ns]; None before the first.

        One target a frame, for the frame's end, moves a gripper evenly, however long frames take. The time goes back
        only if the node was restarted.
        """
        if self._newest is None:
            return None
        self._last_returned = max(self._last_returned, self._newest + self.period)
        return self._last_returned

    @property
    def send_time(self) -> float:
        """Steady time at which to send the next target [s]: when the newest frame came, later if the cloth is slow."""
        is_slow = self.period and self._interval > _SLOW_FACTOR * self.period / SECOND
        return self._arrival + (_DELAY_FRACTION * self._interval if is_slow else 0.0)

    def describe(self) -> str:
        """Return why the cloth's time does not advance, as the end of a sentence."""
        if self._newest is None:
            return f"has published nothing on {self._topic}, its simulated time,"
        return f"stands at {self._newest / SECOND:.3f} s of simulated time (~/state: {self._label or 'not known'})"

    def _on_clock(self, message: Any) -> None:
        previous, self._newest = self._newest, read_stamp(message.clock)
        if previous == self._newest:
            return
        arrival = time.monotonic()
        self._arrival, self._interval = arrival, arrival - self._arrival if previous is not None else 0.0
        if previous is not None and previous < self._newest:
            # The smallest step: a message may be missing.
            step = self._newest - previous
            self.period = min(self.period or step, step)
        elif previous is not None:
            self.period, self._last_returned = 0, 0

    def _on_state(self, message: Any) -> None:
        self._label = str(message.label)
