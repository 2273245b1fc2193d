# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics ~/frame and ~/snapshot, from which `cloth_verify` runs a bag again.

A session's recorder takes the snapshot itself. The recorder of a bag only subscribes, at any moment, and may lose
messages. Each frame record therefore has a number, and snapshots are repeated.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String, UInt8MultiArray

from cloth_sim_ros.ros.io.output import LATCHED_QOS, Output, RecordSink
from cloth_sim_ros.ros.recording.errors import RecordingNotInstalledError
from cloth_sim_ros.simulation.simulation import Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.session.writer import SessionSnapshot

#: Deep, because a lost frame record ends the part of the bag that can be run again.
_FRAME_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


class BagTopics:
    """Publisher of ~/frame and ~/snapshot, from which a bag can be run again, while ~/frame has subscribers.

    Args:
        node: the node.
        simulation: the cloth.
        sink: records other outputs; the recorder of sessions adds the frame records itself.
        snapshot: returns the parameters and the state.

    Raises:
        RecordingNotInstalledError: if a library of sessions is missing.
    """

    def __init__(
        self, node: Node, simulation: Simulation, sink: RecordSink, snapshot: Callable[[], SessionSnapshot]
    ) -> None:
        try:
            from cloth_sim_ros.session.snapshot_message import snapshot_bytes
        except ImportError as error:
            raise RecordingNotInstalledError(
                f"record.topics needs {error.name}, which is not installed: pip install mcap; there is no ~/frame and "
                "no ~/snapshot"
            ) from error
        self._simulation, self._take_snapshot, self._encode = simulation, snapshot, snapshot_bytes
        self._log = node.get_logger()
        self.restart()
        # The libraries of the first snapshot must not delay a frame.
        self._snapshot_bytes(0)
        self._frames = Output(node, String, "~/frame", sink, qos=_FRAME_QOS)
        self._snapshots = Output(node, UInt8MultiArray, "~/snapshot", sink, qos=LATCHED_QOS)

    def restart(self) -> None:
        """Restart the numbers of records and begin with a snapshot, because a failed frame may have sent its record."""
        self._session, self._sequence, self._subscription_count = secrets.token_hex(8), 0, 0
        #: Number of the record behind the last snapshot.
        self._last_snapshot = 0

    def before_frame(self, stamp: int) -> None:
        """Publish a snapshot at a ROS time [ns] before a frame if a subscriber is new or the last one is too old."""
        known, self._subscription_count = self._subscription_count, self._frames.subscription_count
        if not self._subscription_count:
            return
        scene = self._simulation.scene
        # The period may change at any time.
        n_records = math.ceil(scene.record.snapshot_period * scene.rate)
        if self._subscription_count > known or 0 < n_records <= self._sequence - self._last_snapshot:
            self._last_snapshot = self._sequence
            try:
                self._snapshots.publish(self._snapshot_bytes(stamp))
            except MemoryError:
                # The cloth goes on; a bag runs again from the next snapshot on.
                self._log.error("~/snapshot: no memory is left for it; end other processes, or take a smaller cloth")

    def next_record_extras(self, stamp: int) -> dict[str, Any]:
        """Count the next frame record; return its session, sequence and stamp [ns] by key, {} without subscribers.

        Without subscribers there are none, and the record is not published.
        """
        extras = {"session": self._session, "sequence": self._sequence, "stamp": stamp}
        self._sequence += 1
        return extras if self._subscription_count else {}

    def publish(self, record: bytes) -> None:
        """Publish the bytes of a frame record on ~/frame."""
        self._frames.publish(record)

    def _snapshot_bytes(self, stamp: int) -> bytes:
        return self._encode(self._take_snapshot(), session=self._session, sequence=self._sequence, stamp=stamp)
