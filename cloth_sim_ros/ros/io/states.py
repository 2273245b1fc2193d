# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Latched state topics of the node and its grippers."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State
from rclpy.node import Node
from rclpy.serialization import serialize_message

from cloth_sim_ros.ros.io.output import LATCHED_QOS, Output, RecordSink
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.events import Reset
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Labels of ROS 2's managed nodes.
_LABELS = {
    State.PRIMARY_STATE_ACTIVE: "active",
    State.PRIMARY_STATE_INACTIVE: "inactive",
    State.PRIMARY_STATE_FINALIZED: "finalized",
}


class States:
    """Publisher of the latched topics ~/state and ~/<gripper>/state, the latter after every grasp.

    Args:
        node: the node.
        simulation: the cloth.
        sink: records the messages.
    """

    def __init__(self, node: Node, simulation: Simulation, sink: RecordSink) -> None:
        self._simulation = simulation
        self._name = node.get_fully_qualified_name().strip("/")
        self._state = Output(node, State, "~/state", sink, qos=LATCHED_QOS)
        names = simulation.grippers.names
        self._grippers = {
            name: Output(node, DiagnosticStatus, f"~/{name}/state", sink, qos=LATCHED_QOS) for name in names
        }
        self._latest: dict[Output, bytes] = {}
        self._published_state = 0

    def start(self, stamp: int, *, waits: bool = False) -> None:
        """Publish the first states of the node and its grippers.

        Args:
            stamp: ROS time [ns].
            waits: true if no time passes until /clock comes.
        """
        self._update_state(stamp, waits=waits)
        self._publish_grippers({name: "" for name in self._grippers}, stamp)

    def record(self, stamp: int) -> None:
        """Record the newest messages on ~/state and ~/<gripper>/state when a recording starts, at a ROS time [ns]."""
        for output, data in self._latest.items():
            output.record(data, stamp)

    def send(self, frame: Frame, stamp: int) -> None:
        """Publish ~/state if it changed, and states of grippers after a grasp or a reset, at a ROS time [ns]."""
        self._update_state(stamp)
        if not frame.events and not frame.pinches:
            return
        # Pads that start to close hold nothing yet; their state is published when they come to rest.
        changed = {grasp.gripper: grasp.reason for grasp in (*frame.grasps, *frame.pinches) if not grasp.pending}
        if any(isinstance(event, Reset) for event in frame.events):
            changed = {name: "" for name in self._grippers} | changed
        self._publish_grippers(changed, stamp)

    def end(self, stamp: int) -> None:
        """Publish ~/state `finalized` at a ROS time [ns], because the node ends."""
        self._send_state(State.PRIMARY_STATE_FINALIZED, stamp)

    def fail(self, reason: str, stamp: int) -> None:
        """Publish ~/state with the reason of a failed frame, at a ROS time [ns].

        The id is that of a managed node during error processing.
        """
        self._published_state = State.TRANSITION_STATE_ERRORPROCESSING
        self._send(self._state, State(id=self._published_state, label=f"failed: {reason}"), stamp)

    def _update_state(self, stamp: int, *, waits: bool = False) -> None:
        now = State.PRIMARY_STATE_INACTIVE if waits or self._simulation.paused else State.PRIMARY_STATE_ACTIVE
        if now != self._published_state:
            self._send_state(now, stamp)

    def _send_state(self, state: int, stamp: int) -> None:
        self._published_state = state
        self._send(self._state, State(id=state, label=_LABELS[state]), stamp)

    def _publish_grippers(self, reasons: dict[str, str], stamp: int) -> None:
        for name, reason in reasons.items():
            self._send(self._grippers[name], self._status(name, reason), stamp)

    def _status(self, name: str, reason: str) -> DiagnosticStatus:
        grippers, simulation = self._simulation.grippers, self._simulation
        index = grippers.names.index(name)
        closed, grasped = grippers.is_closed(index), simulation.grasped_count(index)
        text = f"closed, holds {pluralize(grasped, 'particle') if grasped else 'nothing'}" if closed else "open"
        values = {
            "closed": str(closed).lower(),
            "grasped_count": str(grasped),
            "frame": str(simulation.frame),
            "simulated_time": f"{simulation.time:.6f}",
        }
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if closed and not grasped else DiagnosticStatus.OK,
            name=f"{self._name}: {name}",
            message=f"{text}: {reason}" if reason else text,
            hardware_id="none",
            values=[
                KeyValue(key=key, value=value)
                for key, value in old_keys.add_old_keys(values, old_keys.GRIPPER_STATE).items()
            ],
        )

    def _send(self, output: Output, message: object, stamp: int) -> None:
        data = bytes(serialize_message(message))
        self._latest[output] = data
        output.send(data, stamp)
