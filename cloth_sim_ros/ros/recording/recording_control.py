# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start and end of recordings: by node, ~/record and failure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rclpy.node import Node

from cloth_sim_ros.ros.recording.recording import (
    RecordingNotInstalledError,
    RecordingUnavailableError,
    SessionRecording,
    log_end,
)
from cloth_sim_ros.ros.recording.rosout_recorder import RosoutRecorder

if TYPE_CHECKING:
    from cloth_sim_ros.session.recorder_options import RecorderStatus


class RecordingControl:
    """Starts and ends the recordings of one node.

    Args:
        node: the node.
        recording: the recording.
        log_recorder: records /rosout and /parameter_events.
        latched: functions that record latched messages at a ROS time [ns].
        refusal: returns why no recording may start; empty if one may.
    """

    def __init__(
        self,
        node: Node,
        recording: SessionRecording,
        log_recorder: RosoutRecorder,
        *,
        latched: Sequence[Callable[[int], None]],
        refusal: Callable[[], str],
    ) -> None:
        self._node, self._recording, self._log_recorder = node, recording, log_recorder
        self._latched, self._refusal = latched, refusal
        self._resumes = False

    def begin_with_node(self, now: int) -> None:
        """Start a recording with the node at a ROS time [ns], and wait for its file.

        Raises:
            RecordingUnavailableError: if the recording can't start although its libraries are installed.
        """
        try:
            self._recording.begin(now)
        except RecordingNotInstalledError as error:
            # The node runs without the libraries too.
            self._node.get_logger().error(f"nothing is recorded: {error}")
            return
        self._log_recorder.update()
        path = self._recording.wait_until_open()
        self._node.get_logger().info(f"recording into {path}")

    def switch(self, begin: bool, answer: Callable[[bool, str], None]) -> None:
        """Start or end a recording, and answer with success and a message."""
        self._node.get_logger().debug(f"~/record: {'begins' if begin else 'ends'} a recording")
        try:
            if begin:
                if refusal := self._refusal():
                    raise RecordingUnavailableError(refusal)
                now = self._node.get_clock().now().nanoseconds
                self._recording.begin(now)
                for record in self._latched:
                    record(now)
            else:
                self._resumes = False
                self._recording.begin_close(reason="~/record")
        except RecordingUnavailableError as error:
            answer(False, str(error))
            return

        def finish(status: RecorderStatus) -> None:
            if status.state == "recording":
                self._node.get_logger().info(f"recording into {status.path}")
            elif status.state == "closed":
                log_end(self._node.get_logger(), status)
            # The node's maintenance logs the error of a failed recording.
            success = status.state == ("recording" if begin else "closed")
            ended = f"{status.path} was closed before it was open"
            answer(success, status.error or (str(status.path) if success else ended))

        self._recording.notify(finish)

    def fail(self, reason: str, _stamp: int) -> None:
        """End the recording, if one runs, with the reason of a failure; `resume` starts another after the reset."""
        self._recording.discard()
        if self._recording.running:
            self._resumes = True
            self._recording.begin_close(reason=f"node failed: {reason}")
            self._recording.notify(lambda status: log_end(self._node.get_logger(), status))

    def resume(self) -> None:
        """Start a new recording after a failure ended one and the node has recovered. Call it periodically."""
        if self._resumes and not self._refusal() and not self._recording.busy:
            self._resumes = False
            self.switch(True, self._log_resumption)

    def _log_resumption(self, success: bool, message: str) -> None:
        # A further failure ended it and is logged itself; the next reset starts another recording.
        if not success and not self._resumes:
            self._node.get_logger().error(f"nothing is recorded after the failure: {message}")

    def end(self, *, timeout: float) -> bool:
        """End the recording with the node, within a time [s]; return true if its file is complete."""
        status = self._recording.end(reason="node stopped", timeout=timeout)
        if status is not None:
            log_end(self._node.get_logger(), status)
        return status is None or status.state == "closed"
