# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of recorded clouds of an ensemble with members that run again.

The members start where a frame record has the entry `ensemble`. A node sends the cloud of a frame after later frames,
and leaves frames out. The members therefore run on when a cloud comes, to the frame with its stamp.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import Cloud, decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.messages import CloudEncoder
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.ensemble import Ensemble, EnsembleFrame
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.completeness import CompletenessCheck
from cloth_sim_ros.verify.outputs import same_content
from cloth_sim_ros.verify.verdict import Findings

#: Entry of a frame record with which the members start, and its value.
ENTRY, START = "ensemble", "start"
_KIND = "ensemble cloud"
#: Largest number of frames that wait for a cloud of theirs: more than a node may lag.
_MAX_WAITING = 100_000
#: Largest number of messages that a gap of numbers stands for.
_MAX_GAP = 1 << 20


class _Step(NamedTuple):
    stamp: int
    events: tuple[Event, ...]
    start: tuple[Scene, State] | None


class EnsembleCheck:
    """Comparison of the recorded clouds of a node's ensemble with members that run again.

    Args:
        node: resolved name of the node.
        completeness: completeness check of the session.
        findings: collects the differences.
    """

    def __init__(self, node: str, completeness: CompletenessCheck, findings: Findings) -> None:
        self.topic = f"{node}/ensemble"
        self._completeness, self._findings = completeness, findings
        self._ensemble: Ensemble | None = None
        self._steps: deque[_Step] = deque()
        self._before: tuple[Scene, State] | None = None
        self._is_known = False

    def begin(self, *, continues: bool) -> None:
        """Begin a file. Unless its first frame `continues` the previous file, close the members and clear the queue."""
        if not continues:
            self.close()
            self._steps.clear()
            self._is_known = False

    def before_frame(self, simulation: Simulation, record: FrameRecord) -> None:
        """Before each frame: store scene and state if, by its record, the ensemble starts there; else forget them."""
        is_start = record.extras.get(ENTRY) == START
        self._before = (simulation.scene, simulation.state.shallow_copy()) if is_start else None
        self._is_known = self._is_known or is_start

    def observe_frame(self, frame: Frame, stamp: int) -> None:
        """Queue a frame of the re-run, due at a ROS time `stamp` [ns], for the members."""
        if len(self._steps) >= _MAX_WAITING:
            self.begin(continues=False)
        if self._is_known and (frame.moved or frame.events):
            self._steps.append(_Step(stamp, frame.events, self._before))

    def compare(self, message: Message) -> None:
        """Advance the members to the frame with a cloud's stamp; report a difference from their mean and deviation."""
        self._count_gap(message)
        self._completeness.add(message, is_from_node=True)
        if not self._is_known:
            self._findings.count_not_compared(self.topic, "its start is not in the recording, or too long ago")
            return
        self._findings.count_compared(_KIND)
        try:
            frame = self._advance(message.publish_time)
        except ValueError as error:
            self._steps.clear()
            self._findings.add_difference(_KIND, f"the ensemble cannot be run: {error}")
            return
        if frame is None:
            self._findings.add_difference(_KIND, f"a message of {self.topic} that belongs to no frame")
            return
        expected = self._encoder.encode(frame.mean.T, message.publish_time, deviation=frame.deviation)
        try:
            if not same_content(message.data, expected, "sensor_msgs/msg/PointCloud2"):
                self._report(decode_cloud(message.data), frame)
        except SessionError as error:
            self._findings.add_difference(_KIND, f"its ensemble cannot be read: {error}")

    def end(self) -> None:
        """End the session: report frames without a cloud, and close the members."""
        self._list_left_out(len(self._steps))
        self.close()

    def close(self) -> None:
        """Close the ensemble's members."""
        if self._ensemble is not None:
            self._ensemble.close()
            self._ensemble = None

    def _advance(self, stamp: int) -> EnsembleFrame | None:
        """Advance the members to the waiting frame with a stamp [ns]; return their mean and deviation, or None."""
        last = next((k for k, step in enumerate(self._steps) if step.stamp == stamp), -1)
        frame: EnsembleFrame | None = None
        self._list_left_out(last)
        steps = [self._steps.popleft() for _ in range(last + 1)]
        # Frames before a start have no effect on it, and a member may have failed there.
        first = max((k for k, step in enumerate(steps) if step.start is not None), default=0)
        for step in steps[first:]:
            if step.start is not None:
                self._start(*step.start)
            if self._ensemble is None:
                raise ValueError("no frame starts it")
            frame = self._ensemble.advance(step.events)
        return frame

    def _list_left_out(self, count: int) -> None:
        if count > 0:
            self._findings.count_not_compared(
                self.topic, "frames without a message, as a slow ensemble leaves them out", count
            )

    def _start(self, scene: Scene, state: State) -> None:
        self.close()
        options = scene.ensemble
        self._ensemble = Ensemble(scene, scene.distribution(), state=state, members=options.members, seed=options.seed)
        height, width = scene.shape
        self._encoder = CloudEncoder(frame_id=scene.frame_id, height=height, width=width, deviation=True)

    def _count_gap(self, message: Message) -> None:
        """Count the clouds missing before this one, by the sequence numbers, in the completeness check."""
        last = self._completeness.last_message(self.topic)
        gap = message.sequence - last.sequence - 1 if last is not None else 0
        for _ in range(gap if 0 < gap < _MAX_GAP else 0):
            self._completeness.add_missing(self.topic)

    def _report(self, recorded: Cloud, frame: EnsembleFrame) -> None:
        reason = "its ensemble, by its stamp, frame_id or layout"
        if recorded.deviation is not None and len(recorded.xyz) == len(frame.mean):
            for name, values, expected in (
                ("deviation", recorded.deviation, frame.deviation),
                ("mean", recorded.xyz, frame.mean),
            ):
                differences = np.abs(values - expected.astype(values.dtype))
                if differences.max() != 0.0:
                    reason = f"its ensemble, by {differences.max():.3g} m of the {name}"
                    break
        self._findings.add_difference(_KIND, reason, rounding=" m of " in reason)
