# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the commands as they were received are the events that took effect.

Running a session again shows that its events lead to its clouds. That the events are what was commanded shows in the
received messages beside them: every grasp takes effect with the next frame, and every target that took effect is one of
those received.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message

#: Received targets that are kept for comparison: more than the node lets wait.
_KEPT = 20_000
#: A target may have been received this long before the recording began, and wait for its stamp [ns].
_GRACE = 1_500_000_000

_Pose = tuple[float, ...]


class CommandCheck:
    """Compares received commands with events, message by message in the order of the file.

    Args:
        node: resolved name of the node.
        grippers: their names.
        obstacles: names of those whose targets are compared: described at the beginning, following no TF frame.
        frame_id: the cloth's coordinate frame; targets in other frames were transformed before they took effect, so
            that a gripper which was sent one is not compared from then on.
        follows_frame: the grippers follow TF frames: their targets come from there.
        from_start: the recording began with the first frame; before one that began later, commands may have come that
            it does not hold.
    """

    def __init__(
        self,
        *,
        node: str,
        grippers: Iterable[str],
        obstacles: Iterable[str] = (),
        frame_id: str,
        follows_frame: bool,
        from_start: bool,
    ) -> None:
        self._obstacles = set(obstacles)
        self._follows_frame = follows_frame
        self._frame_id = frame_id
        self._kinds = {f"{node}/{name}/{leaf}": (name, leaf) for name in grippers for leaf in _READERS}
        self._kinds |= {f"{node}/{name}/target": (name, "target") for name in self._obstacles}
        self._targets: dict[str, deque[_Pose]] = {}
        self._grasps: dict[str, list[bool]] = {}
        self._transformed: set[str] = set()
        self._known_from: int | None = -1 if from_start else None

    @property
    def topics(self) -> frozenset[str]:
        """The topics of commands."""
        return frozenset(self._kinds)

    def receive(self, message: Message) -> None:
        """Take note of a received command. Raises SessionError if its bytes do not parse."""
        name, leaf = self._kinds[message.topic]
        content = decode(message.data, message.type_name)
        if leaf == "grasp":
            self._grasps.setdefault(name, []).append(bool(content.data))
            return
        if content.header.frame_id not in ("", self._frame_id):
            self._transformed.add(name)
        self._targets.setdefault(name, deque(maxlen=_KEPT)).append(_READERS[leaf](content))

    def compare(self, record: FrameRecord, log_time: int) -> str | None:
        """What of a frame's events was not commanded so, in words; None if nothing."""
        if self._known_from is None:
            self._known_from = log_time + _GRACE
        waiting, self._grasps = self._grasps, {}
        found = None
        for event in record.events:
            name = str(event.get("gripper", ""))
            if event.get("kind") == "grasp":
                received = waiting.get(name, [])
                # Those that were not received came by a service.
                if received and received[0] == event["closed"]:
                    received.pop(0)
            elif event.get("kind") == "set_parameters":
                self._obstacles -= {key.removesuffix(".frame") for key in event["values"] if key.endswith(".frame")}
            elif log_time > self._known_from and not self._is_known(event):
                name = name or event["obstacle"]
                found = found or f"{name} moved to {list(event['position'])}, which was not commanded"
        # A clock that went back clears what waits.
        if "clock_jump" not in record.extras:
            for name, left in waiting.items():
                if left:
                    action = "close" if left[0] else "open"
                    found = found or f"{name} was commanded to {action}, which did not take effect"
        return found

    def _is_known(self, event: Any) -> bool:
        """Whether an event is none that moves something, or the target was received."""
        if event.get("kind") == "move":
            name = event["obstacle"]
            if name not in self._obstacles:
                return True
        elif event.get("kind") != "target" or self._follows_frame:
            return True
        else:
            name = event["gripper"]
        if name in self._transformed:
            return True
        wanted = _pose(event["position"], event.get("orientation"))
        return any(_same(wanted, received) for received in reversed(self._targets.get(name, ())))


def _pose(position: Iterable[float], orientation: Iterable[float] | None) -> _Pose:
    return (*position, *(() if orientation is None else orientation))


def _same(one: _Pose, other: _Pose) -> bool:
    return len(one) == len(other) and all(
        a == b and math.copysign(1.0, a) == math.copysign(1.0, b) for a, b in zip(one, other, strict=True)
    )


def _read_pose(message: Any) -> _Pose:
    p, q = message.pose.position, message.pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def _read_point(message: Any) -> _Pose:
    return (message.point.x, message.point.y, message.point.z)


_READERS: dict[str, Any] = {"target": _read_pose, "point": _read_point, "grasp": bool}
