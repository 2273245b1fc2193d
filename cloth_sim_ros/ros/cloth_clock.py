# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topic ~/clock: simulated time of a cloth, published and followed."""

from __future__ import annotations

import time
from typing import Any

from lifecycle_msgs.msg import State
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from cloth_sim_ros.ros.messages import SECOND, read_stamp, set_stamp
from cloth_sim_ros.ros.outputs import LATCHED, STREAM, Output, Tape

#: Name of the topic below that of the node.
TOPIC = "clock"
#: A cloth is slow if its frames take more than so many times their simulated time. The target of the next frame then
#: races with that frame, which begins at once; so it waits for a share of a frame and is taken by the one after.
_SLOW, _SHARE = 1.2, 0.25


class ClothClock:
    """Publishes the simulated time of each frame while someone listens.

    It is not recorded: the records of frames hold it.

    Args:
        node: the cloth's node.
        sink: what records other outputs.
    """

    def __init__(self, node: Node, sink: Tape) -> None:
        self._output = Output(node, Clock, f"~/{TOPIC}", sink)

    def send(self, seconds: float) -> None:
        """Publish the time at the end of a frame [s]."""
        if self._output.heard:
            message = Clock()
            set_stamp(message.clock, round(seconds * SECOND))
            self._output.publish(message)


class ClothTime:
    """Simulated time of the cloth of another node, frame by frame.

    Args:
        node: a node of the caller's.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
    """

    def __init__(self, node: Node, target: str) -> None:
        self._topic = f"{target}/{TOPIC}"
        self._newest: int | None = None
        #: Simulated time of one frame [ns]; 0 while it is not known.
        self.period = 0
        #: The latest time that was returned [ns].
        self._latest = 0
        #: Steady time at which the newest frame was heard of, and the wall time between the last two [s].
        self._arrival = self._interval = 0.0
        self._label = ""
        node.create_subscription(Clock, self._topic, self._take, STREAM)
        node.create_subscription(State, f"{target}/state", self._take_state, LATCHED)

    def now(self) -> int | None:
        """Return the time at the end of the frame after the newest [ns]; None before the first.

        One target a frame, for the frame's very end, leads a gripper evenly, however long frames take. The time goes
        back only if the node was restarted.
        """
        if self._newest is None:
            return None
        self._latest = max(self._latest, self._newest + self.period)
        return self._latest

    @property
    def send_time(self) -> float:
        """Steady time at which the next target is to be sent [s]: at once, unless the cloth is slow."""
        is_slow = self.period and self._interval > _SLOW * self.period / SECOND
        return self._arrival + (_SHARE * self._interval if is_slow else 0.0)

    def describe(self) -> str:
        """Return what is known of a cloth whose time stands, as the end of a sentence."""
        if self._newest is None:
            return f"has said nothing on {self._topic}, its simulated time,"
        return f"stands at {self._newest / SECOND:.3f} s of simulated time (~/state: {self._label or 'not known'})"

    def _take(self, message: Any) -> None:
        before, self._newest = self._newest, read_stamp(message.clock)
        if before == self._newest:
            return
        arrival = time.monotonic()
        self._arrival, self._interval = arrival, arrival - self._arrival if before is not None else 0.0
        if before is not None and before < self._newest:
            # The least: a message may be lost.
            step = self._newest - before
            self.period = min(self.period or step, step)
        elif before is not None:
            self.period, self._latest = 0, 0

    def _take_state(self, message: Any) -> None:
        self._label = str(message.label)
