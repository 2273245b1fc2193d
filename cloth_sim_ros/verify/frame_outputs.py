# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the messages of each frame and of the beginning of a file.

A frame has clouds, wrenches, states, markers and transforms. A message belongs to the preceding frame record with its
publish time. A message without a frame is a difference. A frame without a due message is one, too, unless the end
record counts dropped messages.
"""

from __future__ import annotations

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify import outputs
from cloth_sim_ros.verify.completeness import CompletenessCheck
from cloth_sim_ros.verify.markers import MarkerCheck
from cloth_sim_ros.verify.states import GripperStateCheck, StateCheck
from cloth_sim_ros.verify.verdict import Findings, FramePosition

_TF = "/tf"


class FrameOutputCheck:
    """Comparison of one file's clouds, wrenches, states, markers and transforms with the re-run.

    Args:
        node: resolved name of the node.
        part: the file.
        open_time: log time at which it was opened [ns].
        simulation: in its state at the beginning of the file; the caller advances it.
        completeness: completeness check of the session.
        findings: collects the differences.
    """

    def __init__(
        self,
        node: str,
        *,
        part: SessionPart,
        open_time: int,
        simulation: Simulation,
        completeness: CompletenessCheck,
        findings: Findings,
    ) -> None:
        self._node, self._part, self._open_time = node, part, open_time
        self._simulation, self._completeness, self._findings = simulation, completeness, findings
        scene = simulation.scene
        self._points, self._topology = f"{node}/points", f"{node}/topology"
        self._state_topic, self._marker_topic = f"{node}/state", f"{node}/obstacles"
        self._wrenches = {name: f"{node}/{name}/wrench" for name in (*scene.gripper_names, *scene.unlinked_names)}
        self._grippers = {f"{node}/{name}/state": name for name in scene.gripper_names}
        self._clouds = outputs.CloudCheck(scene, findings)
        self._states = StateCheck(findings)
        self._gripper_states = GripperStateCheck(node, findings)
        self._markers = MarkerCheck(node, simulation, findings)
        self._has_markers = bool(self._markers.names)
        self._latched = frozenset({self._topology, self._state_topic, self._marker_topic, *self._grippers})
        self._compared_topics = frozenset({self._points, *self._wrenches.values(), *self._latched})
        completeness.declare(self._points, "cloud", droppable=True)
        completeness.declare(self._topology, "topology", droppable=False)
        completeness.declare(self._state_topic, "state", droppable=False)
        completeness.declare(self._marker_topic, "marker message", droppable=False)
        completeness.declare(_TF, "transform", droppable=True)
        for topic in self._wrenches.values():
            completeness.declare(topic, "wrench", droppable=True)
        for topic in self._grippers:
            completeness.declare(topic, "gripper state", droppable=False)
        self._frame: Frame | None = None
        self._stamp = -1
        self._first: FramePosition | None = None
        self._received: set[str] = set()
        self._opening_topics: set[str] = set()
        #: Expected wrenches of the frame by topic, and topics of all messages that are due.
        self._expected_wrenches: dict[str, Array] = {}
        self._expected: list[str] = []
        self._reasons: dict[str, str] = {}
        self._changed = False

    @property
    def topics(self) -> frozenset[str]:
        """Topics whose messages are compared here."""
        return self._compared_topics | {_TF}

    def is_compared(self, topic: str) -> bool:
        """Return True if messages of a topic are compared here."""
        return topic in self._compared_topics or (topic == _TF and self._simulation.scene.tf.publish)

    def is_latched(self, topic: str) -> bool:
        """Return True if a topic is latched: a file begins with its last message."""
        return topic in self._latched

    def open_frame(self, frame: Frame, stamp: int) -> None:
        """Begin a frame of the re-run that was due at a ROS time [ns]; its messages follow."""
        simulation = self._simulation
        scene = simulation.scene
        for name in scene.unlinked_names:
            if name in scene.obstacle_names and name not in self._wrenches:
                self._add_wrench(name)
        self._frame, self._stamp = frame, stamp
        self._states.open_frame()
        self._first = self._first or self._findings.position
        self._received = set()
        self._expected_wrenches = {self._wrenches[name]: wrench for name, wrench in outputs.wrenches(scene, frame)}
        self._expected = [self._points, *self._expected_wrenches]
        self._changed = False
        if simulation.obstacles is not None or simulation.pinching is not None or self._markers.names:
            self._changed, moved = self._markers.observe_frame(simulation)
            if moved:
                self._expected.append(self._marker_topic)
            if self._changed:
                # The node sends no obstacle wrenches in a frame that adds or removes obstacles.
                for name in set(scene.obstacle_names).difference(scene.link_names):
                    self._expected.remove(self._wrenches[name])
        self._reasons = self._gripper_states.expected_reasons(frame, simulation)
        self._expected += [f"{self._node}/{name}/state" for name in self._reasons]
        if scene.tf.publish:
            self._expected.append(_TF)

    def compare(self, message: Message, *, is_opening: bool) -> bool | None:
        """Compare a message of a frame, or of the opening, with the re-run; return True if a frame's cloud is equal.

        Args:
            message: a message of a compared topic.
            is_opening: True before the first frame.

        Returns:
            For the cloud of a frame: True if its positions are equal. None for other messages.
        """
        topic = message.topic
        if is_opening:
            self._compare_opening(message)
            return None
        if topic == self._state_topic:
            self._states.compare(message, self._simulation)
            return None
        if topic == self._topology or message.publish_time != self._stamp:
            self._report_orphan(message)
            return None
        if topic in self._received:
            self._findings.add_difference(self._kind(topic), f"a second message of {topic}")
            return None
        self._received.add(topic)
        return self._compare_output(message)

    def close_frame(self) -> None:
        """End a frame: report the messages that it lacks."""
        if self._frame is None:
            return
        for topic in self._expected:
            if topic not in self._received:
                self._completeness.add_missing(topic)
        if self._states.is_due(self._simulation):
            reason = f"a message of {self._state_topic} that is missing: whether time passes has changed"
            self._findings.add_difference("state", reason)
        self._frame = None

    def finish(self) -> None:
        """End a file; report latched topics, such as the topology, with which it must begin but does not."""
        required = [self._topology]
        if self._part.index == 0 and "dropped" in self._part.end_notes:
            # The node's recorder counts dropped messages; other writers of sessions send no states.
            required += [self._state_topic, *self._grippers, *([self._marker_topic] if self._has_markers else [])]
        for topic in required:
            if topic in self._opening_topics:
                continue
            if topic == self._topology or self._completeness.is_seen(topic):
                reason = f"{topic}, of which {self._part.path.name} must begin with a message"
                self._findings.add_difference(self._kind(topic), reason, position=self._first)
            else:
                self._findings.add_absent(topic)

    def end(self) -> None:
        """End the session: report topics without any message."""
        for topic in (self._points, *self._wrenches.values(), *self._grippers, self._marker_topic, _TF):
            if self._completeness.is_absent(topic):
                self._findings.add_absent(topic)

    def _add_wrench(self, name: str) -> None:
        """Add the wrench topic of an obstacle that was added during the recording."""
        topic = self._wrenches[name] = f"{self._node}/{name}/wrench"
        self._compared_topics |= {topic}
        self._completeness.declare(topic, "wrench", droppable=True)

    def _compare_output(self, message: Message) -> bool | None:
        topic, simulation, findings = message.topic, self._simulation, self._findings
        if topic == self._points:
            findings.count_compared("cloud")
            return self._clouds.compare(message, simulation, self._stamp)
        if topic in self._expected_wrenches:
            findings.count_compared("wrench")
            wrench, frame_id = self._expected_wrenches[topic], simulation.scene.frame_id
            outputs.compare_wrench(message, wrench, frame_id=frame_id, stamp=self._stamp, findings=findings)
        elif topic in self._grippers and self._grippers[topic] in self._reasons:
            name = self._grippers[topic]
            self._gripper_states.compare(message, name, self._reasons[name], simulation)
        elif topic == self._marker_topic:
            findings.count_compared("marker message")
            self._markers.compare(message, simulation, self._stamp, changed=self._changed)
        elif topic == _TF:
            findings.count_compared("transform")
            outputs.compare_transforms(message, self._node, simulation, self._stamp, findings)
        else:
            self._report_orphan(message)
        return None

    def _compare_opening(self, message: Message) -> None:
        """Compare a message at the beginning of a file: the last one of a latched topic."""
        topic = message.topic
        if topic == self._state_topic and topic in self._opening_topics and message.publish_time > self._open_time:
            # The clock may have stopped or started before the first frame.
            self._states.compare(message, self._simulation)
            return
        part, completeness = self._part, self._completeness
        is_repeated = part.index > 0 and completeness.is_repeated(message)
        is_first_read = (
            part.index > 0 and completeness.last_message(topic) is None and message.publish_time <= self._open_time
        )
        if topic not in self._latched or not (is_repeated or is_first_read or message.publish_time == self._open_time):
            self._report_orphan(message)
            return
        if topic in self._opening_topics:
            self._findings.add_difference(self._kind(topic), f"a second message of {topic}")
            return
        self._opening_topics.add(topic)
        if topic == self._topology:
            self._findings.count_compared("topology")
            outputs.compare_topology(message, self._simulation.scene, self._findings)
        elif topic == self._marker_topic:
            self._findings.count_compared("marker message")
            self._markers.compare(message, self._simulation, None)
        elif topic == self._state_topic:
            self._states.compare(message, self._simulation)
        elif is_repeated:
            # The original message was compared already.
            self._findings.count_compared("gripper state")
        else:
            self._gripper_states.compare_older(message, self._grippers[topic], self._simulation)

    def _report_orphan(self, message: Message) -> None:
        reason = f"a message of {message.topic} that belongs to no frame"
        self._findings.add_difference(self._kind(message.topic), reason)

    def _kind(self, topic: str) -> str:
        if topic == self._points:
            return "cloud"
        if topic in self._grippers:
            return "gripper state"
        kinds = {self._topology: "topology", self._state_topic: "state", self._marker_topic: "marker message"}
        return kinds.get(topic, "transform" if topic == _TF else "wrench")
