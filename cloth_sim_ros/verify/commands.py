# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of received commands with the events that took effect.

The re-run shows that the events lead to the clouds. The received messages show that the events were commanded. Every
grasp takes effect with the next frame. When a frame begins, the newest target that has arrived takes effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Move, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.verdict import Findings

#: Maximum number of waiting targets; larger than the limit of the node.
_MAX_WAITING_TARGETS = 20_000
#: Maximum time that a target received before the recording waits for its stamp [ns].
_GRACE = 1_500_000_000
#: Maximum lead of a stamp over its arrival [ns].
_MAX_STAMP_LEAD = 1_000_000_000
#: Events that services and the node cause, without a message.
_UNCOMMANDED_EVENTS = ("set_parameters", "pause", "step", "reset", "relax", "move_obstacles")

_Pose = tuple[float, ...]


class _PendingTarget(NamedTuple):
    """A received target that has not taken effect yet."""

    stamp: int
    """ROS time from which the target is valid [ns]."""
    arrival_index: int
    """Index in the order of arrival."""
    pose: _Pose
    certain: bool
    """True if the node must have applied it in the next frame that is due at its stamp or later."""
    topic: str


class CommandCheck:
    """Comparison of received commands with the events of the next frames, message by message in the file's order.

    Args:
        node: resolved name of the node.
        scene: effective at the beginning. Bodies that follow a TF frame are not compared. Targets in another coordinate
            frame were transformed before they took effect; the body is not compared from then on.
        from_start: True if the recording began with the first frame. Otherwise commands may precede the recording.
        findings: collects the differences.
    """

    def __init__(self, *, node: str, scene: Scene, from_start: bool, findings: Findings) -> None:
        self._findings, self._frame_id, self._node = findings, scene.frame_id, node
        self._grippers = frozenset(scene.gripper_names)
        bodies = [(name, leaf) for name in scene.gripper_names for leaf in _READERS]
        bodies += [(name, leaf) for name in scene.unlinked_names for leaf in ("target", "point")]
        self._kinds = {f"{node}/{name}/{leaf}": (name, leaf) for name, leaf in bodies}
        #: Bodies that are not compared, with the reason: received commands alone do not move them.
        self._untracked = {name: _FOLLOWS for name in scene.gripper_names if scene.of_gripper(name, "frame")}
        self._untracked |= {name: _FOLLOWS for name, obstacle in scene.described.items() if obstacle.frame}
        #: Grippers that velocities moved.
        self._twisted: set[str] = set()
        self._waiting: dict[str, list[_PendingTarget]] = {}
        self._newest: dict[str, int] = {}
        self._grasps: dict[str, list[bool]] = {}
        self._count = 0
        self._complete_from: int | None = -1 if from_start else None

    @property
    def topics(self) -> frozenset[str]:
        """Topics on which the node receives commands."""
        return frozenset(self._kinds)

    def receive(self, message: Message, simulation: Simulation) -> None:
        """Store a command on one of `topics`, received after the last frame, until an event matches it."""
        name, leaf = self._kinds[message.topic]
        if leaf == "twist":
            self._twisted.add(name)
            self._skip(message.topic, "a velocity, which the node integrates frame by frame")
            return
        try:
            # A wrong type in the declaration is a difference of its own.
            content = decode(message.data, _TYPES[leaf])
            pose = None if leaf == "grasp" else _READERS[leaf](content)
        except SessionError:
            self._skip(message.topic, "refused: its bytes are no such message")
            return
        if pose is None:
            self._grasps.setdefault(name, []).append(bool(content.data))
            return
        if content.header.frame_id not in ("", self._frame_id):
            self._untracked[name] = _TRANSFORMED
        if name in self._untracked:
            self._skip(message.topic, self._untracked[name])
            return
        stamp = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
        is_refused = self._is_refused(name, pose, simulation)
        if is_refused or content.header.stamp.sec < 0 or content.header.stamp.nanosec >= 10**9:
            self._skip(message.topic, "refused by the node's own rules")
            return
        arrived = message.publish_time
        stamp, newest = stamp or arrived, self._newest.get(name, 0)
        if stamp > arrived + _MAX_STAMP_LEAD:
            self._skip(message.topic, "refused by the node's own rules")
            return
        self._newest[name] = max(stamp, newest)
        self._count += 1
        waiting = self._waiting.setdefault(name, [])
        waiting.append(_PendingTarget(stamp, self._count, pose, newest <= stamp <= arrived, message.topic))
        if len(waiting) > _MAX_WAITING_TARGETS:
            self._skip(waiting.pop(0).topic, "more than can wait")

    def compare(self, record: FrameRecord, log_time: int, stamp: int, simulation: Simulation) -> None:
        """Compare the stored commands with the events of a frame; report those without a counterpart.

        Args:
            record: of the frame.
            log_time: log time of the record [ns].
            stamp: ROS time at which the frame was due [ns].
            simulation: after the frame.
        """
        if self._complete_from is None:
            self._complete_from = log_time + _GRACE
        is_complete = log_time > self._complete_from
        is_cleared = "clock_jump" in record.extras
        is_forgiven = is_cleared or any(event.get("kind") == "reset" for event in record.events)
        grasps, self._grasps = self._grasps, {}
        moved = set()
        for event in record.events:
            kind = event.get("kind")
            if kind == "grasp":
                self._match_grasp(event, grasps)
            elif kind in ("target", "move"):
                name = str(event["gripper" if kind == "target" else "obstacle"])
                moved.add(name)
                self._match_target(name, event, stamp, known=is_complete)
            elif kind in _UNCOMMANDED_EVENTS:
                cause = "a robot's joint states or TF" if kind == "move_obstacles" else "a service or the node itself"
                self._skip("events", f"{kind}, by {cause}")
                if kind == "set_parameters":
                    self._update_bodies(event["values"])
        for name in [name for name, waiting in self._waiting.items() if waiting and name not in moved]:
            self._check_overdue(name, stamp, simulation, known=is_complete and not is_forgiven)
        for name, unmatched in grasps.items():
            # A clock jump back clears the waiting commands.
            if is_cleared:
                self._skip(f"{name}/grasp", "cleared when the clock went back", len(unmatched))
            elif unmatched:
                action = "close" if unmatched[0] else "open"
                self._findings.add_difference("command", f"{name} was commanded to {action}, which did not take effect")
        if is_cleared:
            for name, waiting in self._waiting.items():
                self._drop(waiting, "cleared when the clock went back")
                self._newest.pop(name, None)

    def end(self) -> None:
        """Report commands that still wait at the end of the session as not compared."""
        for waiting in self._waiting.values():
            self._drop(waiting, "waiting at the end, or refused as too far ahead or too old")
        for name, unmatched in self._grasps.items():
            self._skip(f"{name}/grasp", "waiting at the end", len(unmatched))

    def _match_grasp(self, event: Mapping[str, Any], grasps: Mapping[str, list[bool]]) -> None:
        received = grasps.get(str(event.get("gripper", "")), [])
        if received and received[0] == event.get("closed"):
            received.pop(0)
            self._findings.count_compared("command")
        else:
            self._skip("events", "grasp without a message, by a service, an action or gripper.timeout")

    def _match_target(self, name: str, event: Mapping[str, Any], stamp: int, *, known: bool) -> None:
        if name in self._untracked:
            self._skip("events", f"{event['kind']} of {name}: {self._untracked[name]}")
            return
        pose = _pose(event["position"], event.get("orientation"))
        waiting = self._waiting.get(name, [])
        candidates = [target for target in waiting if _is_same_pose(pose, target.pose)]
        if not candidates:
            if name in self._twisted:
                self._skip("events", f"target of {name} by a velocity")
            elif known:
                reason = f"{name} moved to {list(event['position'])}, which was not commanded"
                self._findings.add_difference("command", reason)
            else:
                self._skip("events", f"{event['kind']} that may have been commanded before the recording began")
            return
        self._findings.count_compared("command")
        # A target with the same pose may belong to a later frame. On wall time, a frame that begins late also applies
        # targets stamped after it was due; therefore later ones may belong to this frame.
        match = max((target for target in candidates if target.stamp <= stamp), default=min(candidates))
        replaced = [target for target in waiting if target < match]
        newest, later = max(candidates), [target for target in waiting if target > match]
        self._waiting[name] = [target._replace(certain=target.certain and target > newest) for target in later]
        self._drop(replaced, "replaced by a newer one in the same frame, refused, or too old")
        self._check_overdue(name, stamp, None, known=known)

    def _check_overdue(self, name: str, stamp: int, simulation: Simulation | None, *, known: bool) -> None:
        """Report waiting targets of a body that the node must have applied by a stamp [ns]."""
        waiting = self._waiting.get(name, [])
        overdue = [target for target in waiting if target.certain and target.stamp <= stamp]
        if not overdue:
            return
        self._waiting[name] = [target for target in waiting if target > max(overdue)]
        if known and not (simulation is not None and self._may_be_impossible(name, simulation)):
            position = list(overdue[-1].pose[:3])
            self._findings.add_difference("command", f"{name} was commanded to {position}, which did not take effect")
        else:
            cleared = [target for target in waiting if target <= max(overdue)]
            self._drop(cleared, "cleared, or received before the recording")

    def _may_be_impossible(self, name: str, simulation: Simulation) -> bool:
        """Return True if the node may have refused a body's target: it was removed, or its pads have no pose yet."""
        grippers = simulation.grippers
        if name not in self._grippers:
            return simulation.obstacles is None or name not in simulation.obstacles.names
        return simulation.scene.pinches(name) and not grippers.is_placed(grippers.names.index(name))

    def _update_bodies(self, values: Mapping[str, Any]) -> None:
        for key, value in values.items():
            if key.endswith(".shape"):
                # An obstacle that was added during the recording.
                name = key.removesuffix(".shape")
                self._kinds |= {f"{self._node}/{name}/{leaf}": (name, leaf) for leaf in ("target", "point")}
            if key.endswith(".frame") and value:
                name = key.removesuffix(".frame")
                names = self._grippers if name == "gripper" else (name,)
                self._untracked |= dict.fromkeys(names, _FOLLOWS)
                for follower in names:
                    self._drop(self._waiting.get(follower, []), _FOLLOWS)

    def _is_refused(self, name: str, pose: _Pose, simulation: Simulation) -> bool:
        kind = Target if name in self._grippers else Move
        try:
            simulation.check(kind(name, pose[:3], pose[3:] or None))
        except EventError:
            return True
        return False

    def _drop(self, waiting: list[_PendingTarget], reason: str) -> None:
        for target in waiting:
            self._skip(target.topic, reason)
        waiting.clear()

    def _skip(self, topic: str, reason: str, count: int = 1) -> None:
        self._findings.count_not_compared(topic, reason, count)


_FOLLOWS = "follows a TF frame"
_TRANSFORMED = "in another coordinate frame"


def _pose(position: Iterable[float], orientation: Iterable[float] | None) -> _Pose:
    return (*position, *(() if orientation is None else orientation))


def _is_same_pose(pose_a: _Pose, pose_b: _Pose) -> bool:
    signs_a, signs_b = ([math.copysign(1.0, component) for component in pose] for pose in (pose_a, pose_b))
    return pose_a == pose_b and signs_a == signs_b


def _read_pose(message: Any) -> _Pose:
    p, q = message.pose.position, message.pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def _read_point(message: Any) -> _Pose:
    return (message.point.x, message.point.y, message.point.z)


_TYPES = {"target": messages.POSE, "point": messages.POINT, "grasp": messages.BOOL}
_READERS: dict[str, Any] = {"target": _read_pose, "point": _read_point, "grasp": bool, "twist": None}
