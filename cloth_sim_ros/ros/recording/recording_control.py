# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording part of the node: start and end of its recordings."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import attrs
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_parameter_events
from rclpy.serialization import deserialize_message

from cloth_sim_ros.ros.recording.errors import RecordingNotInstalledError, RecordingUnavailableError
from cloth_sim_ros.ros.recording.recording import SessionRecording, log_end

if TYPE_CHECKING:
    from cloth_sim_ros.session.recorder_options import RecorderStatus


_ROSOUT_QOS = QoSProfile(depth=1000)


class RosoutRecorder:
    """Recorder of this node's messages on /rosout and /parameter_events while a recording runs.

    Args:
        node: the node.
        sink: records the messages.
        lock: held while a message is recorded.
    """

    def __init__(self, node: Node, sink: SessionRecording, lock: AbstractContextManager[Any]) -> None:
        self._lock, self._node, self._sink = lock, node, sink
        self._subscriptions: list[Any] = []

    def update(self) -> None:
        """Subscribe if a recording runs, else unsubscribe: many nodes publish there. Call it periodically."""
        if self._sink.running and not self._subscriptions:
            logger, name = self._node.get_logger().name, self._node.get_fully_qualified_name()
            self._subscribe(Log, "/rosout", _ROSOUT_QOS, lambda message: message.name == logger)
            self._subscribe(
                ParameterEvent, "/parameter_events", qos_profile_parameter_events, lambda message: message.node == name
            )
        elif not self._sink.running and self._subscriptions:
            for subscription in self._subscriptions:
                self._node.destroy_subscription(subscription)
            self._subscriptions = []

    def _subscribe(self, kind: Any, topic: str, qos: QoSProfile, matches: Callable[[Any], bool]) -> None:
        def take(data: bytes) -> None:
            try:
                is_match = matches(deserialize_message(data, kind))
            except (RuntimeError, UnicodeDecodeError):
                # Malformed bytes of another node.
                return
            if is_match:
                stamp = self._node.get_clock().now().nanoseconds
                with self._lock:
                    self._sink.add(topic, kind, data, stamp=stamp, qos=qos, droppable=False)

        self._subscriptions.append(self._node.create_subscription(kind, topic, take, qos, raw=True))


@attrs.define(eq=False)
class RecordingControl:
    """Start and end of recordings: with the node, by ~/record, and around failures of the node.

    Args:
        node: the node.
        session: the recording.
        rosout: records /rosout and /parameter_events.
        record_latched: records the latched messages at a ROS time [ns].
        refusal: returns why no recording may start; empty if one may.
    """

    _node: Node
    session: SessionRecording
    _rosout: RosoutRecorder
    _record_latched: Callable[[int], None]
    _refusal: Callable[[], str]
    _resumes: bool = attrs.field(default=False, init=False)
    #: True if the file holds everything recorded; None before `end`.
    saved: bool | None = attrs.field(default=None, init=False)

    def begin_with_node(self, now: int) -> None:
        """Start a recording at a ROS time [ns] and wait for its file; without the libraries, only log an error.

        Raises:
            RecordingUnavailableError: if the recording can't start although its libraries are installed.
        """
        try:
            self.session.begin(now)
        except RecordingNotInstalledError as error:
            # The node runs without the libraries too.
            self._node.get_logger().error(f"nothing is recorded: {error}")
            return
        self._rosout.update()
        path = self.session.wait_until_open()
        self._node.get_logger().info(f"recording into {path}")

    def switch(self, begin: bool, answer: Callable[[bool, str], None]) -> None:
        """Start or end a recording; call `answer` with success and path or reason when its file is open or closed."""
        self._node.get_logger().debug(f"~/record: {'begins' if begin else 'ends'} a recording")
        try:
            if begin:
                if refusal := self._refusal():
                    raise RecordingUnavailableError(refusal)
                now = self._node.get_clock().now().nanoseconds
                self.session.begin(now)
                self._record_latched(now)
            else:
                self._resumes = False
                self.session.begin_close(reason="~/record")
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

        self.session.notify(finish)

    def fail(self, reason: str, _stamp: int) -> None:
        """End the recording, if one runs, with the reason of a failure; `update` starts another after the reset."""
        self.session.discard()
        if self.session.running:
            self._resumes = True
            self.session.begin_close(reason=f"node failed: {reason}")
            self.session.notify(lambda status: log_end(self._node.get_logger(), status))

    def update(self) -> str:
        """Call the recording's listeners, and resume it after a failure; return its error once. Call it periodically.

        After a failure ended a recording, a new one starts when the node has recovered.
        """
        self._rosout.update()
        trouble = self.session.poll()
        if self._resumes and not self._refusal() and not self.session.busy:
            self._resumes = False
            self.switch(True, self._log_resumption)
        return trouble

    def _log_resumption(self, success: bool, message: str) -> None:
        # A further failure ended it and is logged itself; the next reset starts another recording.
        if not success and not self._resumes:
            self._node.get_logger().error(f"nothing is recorded after the failure: {message}")

    def end(self, *, timeout: float) -> None:
        """End the recording because the node ends, blocking for a time [s] at most; log the result, and set `saved`."""
        status = self.session.end(reason="node stopped", timeout=timeout)
        if status is not None:
            log_end(self._node.get_logger(), status)
        self.saved = status is None or status.state == "closed"
