# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publisher of /diagnostics, once a second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import attrs
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.serialization import serialize_message

from cloth_sim_ros.ros.io.messages import set_stamp
from cloth_sim_ros.ros.io.output import Output, RecordSink

PERIOD = 1.0


@attrs.define
class FrameTally:
    """Counts of frames and late frames of a node and their wall times, in total and since the last report."""

    #: Frames in which time passed.
    frames: int = 0
    #: Ticks whose frame was not published within its period.
    late: int = 0
    #: Longest wall time of a frame since the last report, and the sum over all frames [s].
    longest: float = 0.0
    busy: float = 0.0
    _reported: tuple[int, int, float] = (0, 0, 0.0)
    _since: float = attrs.field(factory=time.monotonic)
    _begun: float = attrs.field(factory=time.monotonic)

    def add(self, *, moved: bool, seconds: float) -> None:
        """Count a frame and its wall time [s]; `moved` is true if simulated time passed in it."""
        self.frames += moved
        self.busy += seconds
        self.longest = max(self.longest, seconds)

    def begin(self) -> None:
        """Restart the time measurement when frames begin; counts stay."""
        self._since = self._begun = time.monotonic()

    def overall_factor(self, period: float) -> float:
        """Return the ratio of simulated to wall time since the start, for frames of a period [s]."""
        return self.frames * period / max(time.monotonic() - self._begun, 1e-9)

    def report(self, period: float) -> dict[str, Any]:
        """Return real_time_factor, late, load and longest [s] since the last report, and begin the next one."""
        now = time.monotonic()
        elapsed = max(now - self._since, 1e-9)
        frames, late, busy = self._reported
        rates = {
            "real_time_factor": (self.frames - frames) * period / elapsed,
            "late": self.late - late,
            "load": (self.busy - busy) / elapsed,
            "longest": self.longest,
        }
        self._reported = (self.frames, self.late, self.busy)
        self._since, self.longest = now, 0.0
        return rates


class DiagnosticsPublisher:
    """Publisher of the node's diagnostics on /diagnostics.

    Args:
        node: the node.
        sink: records them.
        collect: returns level, summary and values; its argument is true if a subscriber or a recording takes them.
    """

    def __init__(
        self, node: Node, sink: RecordSink, collect: Callable[[bool], tuple[bytes, str, dict[str, str]]]
    ) -> None:
        self._collect = collect
        self._clock = node.get_clock()
        # diagnostic_updater uses "none" if there is no hardware; an empty id looks like an omission.
        self._status = DiagnosticStatus(name=f"{node.get_fully_qualified_name().strip('/')}: cloth", hardware_id="none")
        self._output = Output(node, DiagnosticArray, "/diagnostics", sink)

    def send(self) -> None:
        """Collect the present diagnostics, and publish and record them if there is a subscriber or a recording."""
        has_consumers = self._output.has_consumers
        level, summary, values = self._collect(has_consumers)
        if not has_consumers:
            return
        self._status.level = level
        self._status.message = summary
        self._status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        now = self._clock.now().nanoseconds
        message = DiagnosticArray(status=[self._status])
        set_stamp(message.header.stamp, now)
        self._output.send(bytes(serialize_message(message)), now)

    def flush(self) -> None:
        """Wait at most 0.2 s until subscribers have received the last report."""
        self._output.flush()
