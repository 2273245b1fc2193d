# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What holds until it changes, for those who come later too: what each gripper holds, and whether time passes."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State
from rclpy.node import Node
from rclpy.serialization import serialize_message

from cloth_sim_ros.ros.outputs import LATCHED, Output, Tape
from cloth_sim_ros.session.words import counted
from cloth_sim_ros.simulation.events import Reset
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Labels are those of managed nodes.
_LABELS = {
    State.PRIMARY_STATE_ACTIVE: "active",
    State.PRIMARY_STATE_INACTIVE: "inactive",
    State.PRIMARY_STATE_FINALIZED: "finalized",
}


class States:
    """Latched topics: ~/state, and ~/<gripper>/state, sent again after every grasp, whether or not it changed anything.

    Args:
        node: the node.
        simulation: the cloth.
        tape: records them.
    """

    def __init__(self, node: Node, simulation: Simulation, tape: Tape) -> None:
        self._simulation = simulation
        self._name = node.get_fully_qualified_name().strip("/")
        self._state = Output(node, State, "~/state", tape, qos=LATCHED)
        names = simulation.grippers.names
        self._grippers = {name: Output(node, DiagnosticStatus, f"~/{name}/state", tape, qos=LATCHED) for name in names}
        self._latest: dict[Output, bytes] = {}
        self._said = 0

    def start(self, stamp: int, *, waits: bool = False) -> None:
        """Say what is so at the beginning, at a ROS time [ns]; `waits`: no time passes until /clock comes."""
        if waits:
            self._send_state(State.PRIMARY_STATE_INACTIVE, stamp)
        else:
            self._say_state(stamp)
        self._say_grippers({name: "" for name in self._grippers}, stamp)

    def record(self, stamp: int) -> None:
        """Record what was said last, at the beginning of a recording."""
        for output, data in self._latest.items():
            output.record(data, stamp)

    def show(self, frame: Frame, stamp: int) -> None:
        """Say what a frame has changed."""
        self._say_state(stamp)
        if not frame.events and not frame.pinches:
            return
        # Pads that only begin to close hold nothing yet: it is told when they have.
        changed = {grasp.gripper: grasp.reason for grasp in (*frame.grasps, *frame.pinches) if not grasp.pending}
        if any(isinstance(event, Reset) for event in frame.events):
            changed = {name: "" for name in self._grippers} | changed
        self._say_grippers(changed, stamp)

    def end(self, stamp: int) -> None:
        """Say that this was all."""
        self._send_state(State.PRIMARY_STATE_FINALIZED, stamp)

    def fail(self, reason: str, stamp: int) -> None:
        """Say that a frame failed, at a ROS time [ns].

        Its id is that of managed nodes whose code has raised and that wait for their error to be handled.
        """
        self._said = State.TRANSITION_STATE_ERRORPROCESSING
        self._send(self._state, State(id=self._said, label=f"failed: {reason}"), stamp)

    def _say_state(self, stamp: int) -> None:
        now = State.PRIMARY_STATE_INACTIVE if self._simulation.paused else State.PRIMARY_STATE_ACTIVE
        if now != self._said:
            self._send_state(now, stamp)

    def _send_state(self, state: int, stamp: int) -> None:
        self._said = state
        self._send(self._state, State(id=state, label=_LABELS[state]), stamp)

    def _say_grippers(self, reasons: dict[str, str], stamp: int) -> None:
        for name, reason in reasons.items():
            self._send(self._grippers[name], self._status(name, reason), stamp)

    def _status(self, name: str, reason: str) -> DiagnosticStatus:
        grippers, simulation = self._simulation.grippers, self._simulation
        index = grippers.names.index(name)
        closed, held = grippers.is_closed(index), simulation.held(index)
        words = f"closed, holds {counted(held, 'particle') if held else 'nothing'}" if closed else "open"
        values = {
            "closed": str(closed).lower(),
            "held": str(held),
            "frame": str(simulation.frame),
            "simulated_time": f"{simulation.time:.6f}",
        }
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if closed and not held else DiagnosticStatus.OK,
            name=f"{self._name}: {name}",
            message=f"{words}: {reason}" if reason else words,
            hardware_id="none",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )

    def _send(self, output: Output, message: object, stamp: int) -> None:
        data = bytes(serialize_message(message))
        self._latest[output] = data
        output.send(data, stamp)
