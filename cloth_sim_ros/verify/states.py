# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of the node's and grippers' recorded states with the re-run."""

from __future__ import annotations

from typing import Any

from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.events import Reset
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.verdict import Findings

STATE, STATUS = "lifecycle_msgs/msg/State", "diagnostic_msgs/msg/DiagnosticStatus"
#: Ids and labels of managed (lifecycle) nodes.
_INACTIVE, _ACTIVE = (2, "inactive"), (3, "active")
_OK, _WARN = 0, 1


class StateCheck:
    """Comparison of the node's `~/state` with the re-run: active while time passes, otherwise inactive.

    Args:
        findings: collects the differences.
    """

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._last: tuple[int, str] | None = None
        #: True if the last state precedes the last frame.
        self._is_older = False
        #: True if the frame before the last state was paused.
        self._is_explained = False

    def compare(self, message: Message, simulation: Simulation) -> None:
        """Compare a message on `~/state` with the pause of the simulation at the last frame; report a difference."""
        try:
            content = decode(message.data, STATE)
        except SessionError as error:
            self._findings.add_difference("state", f"the state of the node cannot be read: {error}")
            return
        if self._last == (content.id, content.label):
            self._findings.add_difference(
                "state", f"the state of the node, {content.label}, that is there twice in a row"
            )
        self._last, self._is_explained, self._is_older = (content.id, content.label), simulation.paused, False
        if self._last == (_INACTIVE if simulation.paused else _ACTIVE):
            self._findings.count_compared("state")
        elif self._last == _ACTIVE:
            self._findings.add_difference("state", "the state of the node (active is recorded, the frame is paused)")
        elif self._last[0] in (_INACTIVE[0], _ACTIVE[0]) and self._last != _INACTIVE:
            self._findings.add_difference("state", f"the state of the node, by its label {content.label!r}")
        else:
            self._findings.count_not_compared(message.topic, f"{content.label}, which the node's clock or end decides")

    def open_frame(self) -> None:
        """Begin a frame of the re-run; from then on the last state counts as older than the frame."""
        self._is_older = True

    def is_due(self, simulation: Simulation) -> bool:
        """Return True if the node must have sent another state, because the last one contradicts the last frame."""
        if simulation.paused:
            return self._last == _ACTIVE
        return self._last == _INACTIVE and (self._is_explained or self._is_older)


class GripperStateCheck:
    """Comparison of `~/<gripper>/state` with the re-run: open or closed, and the number of grasped particles.

    Args:
        node: resolved name of the node.
        findings: collects the differences.
    """

    def __init__(self, node: str, findings: Findings) -> None:
        self._prefix, self._findings = node.strip("/"), findings

    @staticmethod
    def expected_reasons(frame: Frame, simulation: Simulation) -> dict[str, str]:
        """Return the reason of a failed grasp, or "", by name of the grippers whose state a frame must send."""
        if not frame.events and not frame.pinches:
            return {}
        changed = {grasp.gripper: grasp.reason for grasp in (*frame.grasps, *frame.pinches) if not grasp.pending}
        if any(isinstance(event, Reset) for event in frame.events):
            changed = {name: "" for name in simulation.grippers.names} | changed
        return changed

    def compare(self, message: Message, name: str, reason: str, simulation: Simulation) -> None:
        """Compare a gripper's recorded state with the simulation after the last frame; report a difference."""
        recorded = self._read(message, name)
        if recorded is None:
            return
        self._findings.count_compared("gripper state")
        expected = self._expected(name, reason, simulation)
        differing = [key for key, value in expected.items() if recorded.get(key) != value]
        unexpected = [key for key in recorded if key not in expected]
        if differing == ["message"] and self._findings.verdict.environment:
            self._findings.count_not_compared(message.topic, "texts, by other code")
        elif differing or unexpected:
            key = (differing or unexpected)[0]
            values = f"{recorded.get(key)} is recorded, {expected.get(key)} is due"
            rounding = key in ("grasped_count", "message", "level")
            text = f"the state of {name}, by its {key} ({values})"
            self._findings.add_difference("gripper state", text, rounding=rounding)

    def compare_older(self, message: Message, name: str, simulation: Simulation) -> None:
        """Compare a gripper's state from before the file's beginning, as far as it must hold; report a difference."""
        recorded = self._read(message, name)
        if recorded is None:
            return
        expected = self._expected(name, "", simulation)
        if recorded == expected:
            self._findings.count_compared("gripper state")
            return
        recorded_closed, frame = recorded.get("closed"), str(recorded.get("frame", ""))
        if recorded_closed != expected["closed"] or not frame.isdecimal() or int(frame) > simulation.frame:
            self._findings.add_difference("gripper state", f"the state of {name} that the file begins with")
        else:
            self._findings.count_not_compared(message.topic, "sent before the file began")

    def _read(self, message: Message, name: str) -> dict[str, object] | None:
        try:
            content = decode(message.data, STATUS)
        except SessionError as error:
            self._findings.add_difference("gripper state", f"the state of {name} cannot be read: {error}")
            return None
        if len({value.key for value in content.values}) < len(content.values):
            self._findings.add_difference("gripper state", f"the state of {name}, by a key that is there twice")
            return None
        entries: dict[str, str] = {}
        for pair in content.values:
            current_key = old_keys.GRIPPER_STATE.get(pair.key, pair.key)
            if entries.setdefault(current_key, pair.value) != pair.value:
                self._findings.add_difference("gripper state", f"the state of {name}, by its {pair.key} ({pair.value})")
                return None
        return {
            "level": _level(content.level),
            "name": content.name,
            "message": content.message,
            "hardware_id": content.hardware_id,
            **entries,
        }

    def _expected(self, name: str, reason: str, simulation: Simulation) -> dict[str, object]:
        grippers = simulation.grippers
        index = grippers.names.index(name)
        closed, grasped = grippers.is_closed(index), simulation.grasped_count(index)
        summary = f"closed, holds {pluralize(grasped, 'particle') if grasped else 'nothing'}" if closed else "open"
        return {
            "level": _WARN if closed and not grasped else _OK,
            "name": f"{self._prefix}: {name}",
            "message": f"{summary}: {reason}" if reason else summary,
            "hardware_id": "none",
            "closed": str(closed).lower(),
            "grasped_count": str(grasped),
            "frame": str(simulation.frame),
            "simulated_time": f"{simulation.time:.6f}",
        }


def _level(value: Any) -> int:
    """Return a byte field as an int; rosbags gives a number or one byte."""
    return value[0] if isinstance(value, bytes) else int(value)
