# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Client of one gripper: sends its commands and receives its state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import attrs
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from cloth_sim_ros.ros.io.messages import set_stamp
from cloth_sim_ros.ros.io.output import LATCHED_QOS
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.gripper_script import GripperScript, TimedGrasp

#: Longest wait for the result of a grasp, in the cloth's time [s]. It comes after the frame, or when pads have stopped.
_ANSWER_TIMEOUT = 7.0
#: Longest wait for the delivery of the last grasp.
_DELIVERY_TIMEOUT = Duration(seconds=0.5)


@attrs.frozen
class GraspReport:
    """Result of one closing of a gripper: number of particles held (None if unknown), and the node's message."""

    #: Number of particles held; None if the node did not answer.
    held: int | None
    #: The node's message, or why there is none.
    text: str


def describe_holds(holds: Sequence[GraspReport]) -> str:
    """Return the results of a script's closings as one text, in order."""
    if not holds:
        return "the script closes nothing"
    return "; ".join(_describe_report(hold) for hold in holds)


def _describe_report(hold: GraspReport) -> str:
    if hold.held is None:
        return f"the result of a grasp is not known: {hold.text}"
    return f"held {pluralize(hold.held, 'particle')}" if hold.held else "held nothing (the node's log says why)"


class GripperClient:
    """Client that plays the script of one gripper: it sends targets and grasps, and receives results of grasps.

    All times are in the cloth's time [s].

    Args:
        node: the caller's node.
        script: the script.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
    """

    def __init__(self, node: Node, script: GripperScript, target: str) -> None:
        self._node, self.script = node, script
        prefix = f"{target}/{script.gripper}"
        self._targets = node.create_publisher(PoseStamped, f"{prefix}/target", QoSProfile(depth=10))
        # Reliable, like the node's subscription: a missing grasp would drop the cloth.
        self._grasps = node.create_publisher(
            Bool, f"{prefix}/grasp", QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        )
        # The state of the gripper: latched, and published again after each grasp.
        node.create_subscription(DiagnosticStatus, f"{prefix}/state", self._on_state, LATCHED_QOS)
        self._status: dict[str, str] | None = None
        #: Deadline of the answer to the newest closing [s]; None if none is pending.
        self._answer_deadline: float | None = None
        #: Script time up to which the gripper stays at the position of its closing [s].
        self._hold_until = math.inf
        #: Grasps of the script that have not been sent.
        self.pending: list[TimedGrasp] = list(script.grasps)
        #: One report for each closing.
        self.reports: list[GraspReport] = []
        self.targets_sent = 0

    def is_connected(self) -> bool:
        """Return true if the node subscribes to the commands and has published the gripper's state."""
        listens = self._targets.get_subscription_count() and self._grasps.get_subscription_count()
        return bool(listens and self._status is not None)

    def open(self) -> None:
        """Publish a grasp that opens the gripper; `is_open` is true once the node has answered it.

        This node has matched the node's subscriptions. Its middleware may need seconds longer to match these
        publishers, and targets, sent as best effort, would not arrive until then. The grasp is reliable, and its
        publisher was announced after that of targets. Therefore a node that answers the grasp has matched both. The
        middleware's acknowledgement says less and, for a new publisher, comes three seconds later.
        """
        # The previous state belongs to an earlier grasp.
        self._status = None
        self._grasps.publish(Bool(data=False))

    def is_open(self) -> bool:
        """Return true if the node has reported an open gripper since `open` was called."""
        return self._status_if(closed=False) is not None

    def limit_time(self, elapsed: float, now: float) -> float:
        """Return the script time that may be played [s]: `elapsed`, but not beyond a closing without its result.

        Until the result of the last closing is known, the gripper stays at its position.
        """
        return elapsed if self._collect_answer(now) else min(elapsed, self._hold_until)

    def send_commands(self, elapsed: float, now: float) -> None:
        """Publish the target at a script time [s], and the due grasps; a grasp waits for the previous result."""
        self._send_target(min(elapsed, self.script.duration))
        # The result of the last grasp must be known before the gripper opens again.
        while self.pending and self.pending[0].time <= elapsed and self._collect_answer(now):
            grasp = self.pending.pop(0)
            self._status = None
            self._grasps.publish(Bool(data=grasp.closed))
            if grasp.closed:
                self._answer_deadline = now + _ANSWER_TIMEOUT
                self._hold_until = max(elapsed, self.script.rest_end(grasp.time))

    def has_played(self, elapsed: float, now: float) -> bool:
        """Return true if the script has ended and its last result is known or overdue; append its report then."""
        return elapsed > self.script.duration and not self.pending and self._collect_answer(now)

    def finish(self) -> None:
        """Wait at most 0.5 s until the node has received the last grasp."""
        self._grasps.wait_for_all_acked(_DELIVERY_TIMEOUT)

    def _collect_answer(self, now: float) -> bool:
        """Append the report of the last closing once its result is known or overdue; false while it is pending."""
        if self._answer_deadline is None:
            return True
        status = self._status_if(closed=True)
        if status is not None:
            self.reports.append(GraspReport(int(status["grasped_count"]), status["words"]))
        elif now > self._answer_deadline:
            self.reports.append(GraspReport(None, f"it did not answer within {_ANSWER_TIMEOUT:g} s"))
        else:
            return False
        self._answer_deadline = None
        return True

    def _on_state(self, status: Any) -> None:
        pairs = ((pair.key, pair.value) for pair in status.values)
        self._status = dict(old_keys.current_entries(pairs, old_keys.GRIPPER_STATE)) | {"words": str(status.message)}

    def _status_if(self, *, closed: bool) -> dict[str, str] | None:
        """Return the gripper's state published since the last command, if it says closed (or open); else None."""
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
