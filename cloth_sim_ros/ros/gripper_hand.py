# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One gripper of a cloth's node as a client has it: its commands, and what the node says of it."""

from __future__ import annotations

import math
from typing import Any

import attrs
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from cloth_sim_ros.ros.messages import set_stamp
from cloth_sim_ros.ros.outputs import LATCHED
from cloth_sim_ros.simulation.gripper_script import GraspAt, GripperScript

#: A node says what a grasp did after its frame, of pads when they have come to rest. In the cloth's time [s].
_ANSWER = 7.0
#: How long the end waits for the last grasp to be received.
_DELIVERY = Duration(seconds=0.5)


@attrs.frozen
class Hold:
    """What became of closing the gripper."""

    #: Particles that it held; None if the node did not say.
    held: int | None
    #: What the node said, or why it said nothing.
    words: str


class Hand:
    """A gripper of the node, and the script that is played to it.

    Times are those of the cloth [s].

    Args:
        node: a node of the caller's.
        script: what is played.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
    """

    def __init__(self, node: Node, script: GripperScript, target: str) -> None:
        self._node, self.script = node, script
        prefix = f"{target}/{script.gripper}"
        self._targets = node.create_publisher(PoseStamped, f"{prefix}/target", QoSProfile(depth=10))
        # Reliable, as the node subscribes it: a lost grasp would drop the cloth.
        self._grasps = node.create_publisher(
            Bool, f"{prefix}/grasp", QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        )
        # What the node says of the gripper: at once to those that come later, and again after each grasp.
        node.create_subscription(DiagnosticStatus, f"{prefix}/state", self._said, LATCHED)
        self._status: dict[str, str] | None = None
        #: Until when an answer to the newest closing is waited for [s]; None where none is.
        self._open_question: float | None = None
        #: Time of the script up to which the gripper stays where it was closed [s].
        self._stay = math.inf
        #: Grasps that are still to come.
        self.waiting: list[GraspAt] = list(script.grasps)
        #: One for each time that the script has closed the gripper.
        self.holds: list[Hold] = []
        self.targets_sent = 0

    def is_met(self) -> bool:
        """Whether the node listens to the commands and has said what the gripper is."""
        listens = self._targets.get_subscription_count() and self._grasps.get_subscription_count()
        return bool(listens and self._status is not None)

    def open(self) -> None:
        """Ask the node to open the gripper.

        We have met the node's subscriptions; its middleware may take seconds longer to meet our publishers, and
        targets, sent as best effort, would be lost until then. The grasp is reliable, and its publisher was announced
        after that of targets: a node that answers it has met both. Its answer is waited for, not the middleware's
        acknowledgement, which says less and, for a publisher as young as this one, comes three seconds later.
        """
        # What was said before is of an earlier grasp.
        self._status = None
        self._grasps.publish(Bool(data=False))

    def is_open(self) -> bool:
        """Whether the node has said, since it was asked, that the gripper is open."""
        return self._status_where(closed=False) is not None

    def stay(self, elapsed: float, now: float) -> float:
        """Return the time that the script may have reached, at most `elapsed`, both since its start [s].

        While it is not known what the last closing holds, the gripper stays where it was closed.
        """
        return elapsed if self._is_answered(now) else min(elapsed, self._stay)

    def command(self, elapsed: float, now: float) -> None:
        """Send the target, and the grasps that are due, at so long after the script's start [s]."""
        self._send_target(min(elapsed, self.script.duration))
        # What the last grasp holds is asked before it may be opened again.
        while self.waiting and self.waiting[0].time <= elapsed and self._is_answered(now):
            grasp = self.waiting.pop(0)
            self._status = None
            self._grasps.publish(Bool(data=grasp.closed))
            if grasp.closed:
                self._open_question = now + _ANSWER
                self._stay = max(elapsed, self.script.rest_end(grasp.time))

    def has_played(self, elapsed: float, now: float) -> bool:
        """Whether the script has ended, with what it held known."""
        return elapsed > self.script.duration and not self.waiting and self._is_answered(now)

    def finish(self) -> None:
        """Wait until the last grasp was received."""
        self._grasps.wait_for_all_acked(_DELIVERY)

    def _is_answered(self, now: float) -> bool:
        """Whether it is known what the last closing did; notes it."""
        if self._open_question is None:
            return True
        status = self._status_where(closed=True)
        if status is not None:
            self.holds.append(Hold(int(status["held"]), status["words"]))
        elif now > self._open_question:
            self.holds.append(Hold(None, f"it did not answer within {_ANSWER:g} s"))
        else:
            return False
        self._open_question = None
        return True

    def _said(self, status: Any) -> None:
        values = {entry.key: entry.value for entry in status.values}
        self._status = values | {"words": str(status.message)}

    def _status_where(self, *, closed: bool) -> dict[str, str] | None:
        """What was said since it was last forgotten, where it is of a gripper that is closed, or open."""
        status = self._status
        return status if status is not None and status.get("closed") == str(closed).lower() else None

    def _send_target(self, elapsed: float) -> None:
        position, orientation = self.script.pose(elapsed)
        message = PoseStamped()
        message.header.frame_id = self.script.frame_id
        set_stamp(message.header.stamp, self._node.get_clock().now().nanoseconds)
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = position
        q.x, q.y, q.z, q.w = orientation
        self._targets.publish(message)
        self.targets_sent += 1
