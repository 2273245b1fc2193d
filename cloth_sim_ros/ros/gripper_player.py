# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A gripper client as any robot has one: finds the cloth's node and plays a script into its command topics."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import attrs
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from cloth_sim_ros.ros.gripper_script import GraspAt, GripperScript
from cloth_sim_ros.ros.messages import set_stamp
from cloth_sim_ros.ros.outputs import LATCHED

#: Discovery is gradual: a gripper counts as unknown only if it has not appeared this long after other services of the
#: node [s].
_SETTLING = 1.0
#: A node says what a grasp did after its frame: later than this it has gone, or no frame is due [s].
_ANSWER = 7.0
#: Services that rclpy makes with the node itself, before it is ready.
_OF_RCLPY = "/get_type_description"
#: If a grasp is later than this, the script is set back to this long before it, so that the gripper closes at the place
#: that the script gives [s].
_HELD_UP = 0.1
#: How long the end waits for the last grasp to be received.
_DELIVERY = Duration(seconds=0.5)


class GripperError(RuntimeError):
    """The script can't be played; the message says why."""


@attrs.frozen
class Hold:
    """What became of closing the gripper."""

    #: Particles that it held; None if the node did not say.
    held: int | None
    #: What the node said, or why it said nothing.
    words: str


class GripperPlayer:
    """Plays a script to a cloth's node.

    Args:
        node: a node of the caller's.
        script: what to play.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
        proceed: asked again and again; False ends everything early.
    """

    def __init__(
        self, node: Node, script: GripperScript, *, target: str, proceed: Callable[[], bool] = lambda: True
    ) -> None:
        self._node = node
        self._script = script
        self._target = "/" + target.strip("/")
        self._proceed = proceed
        prefix = f"{self._target}/{script.gripper}"
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
        #: One for each time that the script closes the gripper.
        self.holds: list[Hold] = []
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self.targets_sent = 0

    def wait_for_gripper(self, limit: float) -> bool:
        """Wait until the cloth's node serves this gripper, at most `limit` seconds, and open it; False if told to end.

        Raises:
            GripperError: if the node does not come, does not answer, or has no such gripper.
        """
        begun = time.monotonic()
        settling: float | None = None
        while self._proceed():
            if self._is_met():
                return self._begin_open(begun + limit)
            now = time.monotonic()
            # A node that only has a name is still preparing.
            settling = (settling or now) if self._is_served() else None
            if settling is not None and now - settling > _SETTLING:
                known = self._known_grippers()
                if self._script.gripper not in known:
                    there = ", ".join(known) or "none"
                    raise GripperError(f"{self._target} has no gripper '{self._script.gripper}'; it has {there}")
            if now - begun > limit:
                raise GripperError(self._what_is_missing(limit))
            self._executor.spin_once(timeout_sec=0.02)
        return False

    def _is_met(self) -> bool:
        listens = self._targets.get_subscription_count() and self._grasps.get_subscription_count()
        return bool(listens and self._status is not None)

    def _said(self, status: Any) -> None:
        values = {entry.key: entry.value for entry in status.values}
        self._status = values | {"words": str(status.message)}

    def _status_where(self, *, closed: bool) -> dict[str, str] | None:
        """What was said since it was last forgotten, where it is of a gripper that is closed, or open."""
        status = self._status
        return status if status is not None and status.get("closed") == str(closed).lower() else None

    def _begin_open(self, end: float) -> bool:
        """Open the gripper, once, and wait until the node says that it is open.

        We have met the node's subscriptions; its middleware may take seconds longer to meet our publishers, and
        targets, sent as best effort, would be lost until then. The grasp is reliable, and its publisher was announced
        after that of targets: a node that answers it has met both. Its answer is waited for, not the middleware's
        acknowledgement, which says less and, for a publisher as young as this one, comes three seconds later.

        Raises:
            GripperError: if no answer comes until `end`.
        """
        # What was said before is of an earlier grasp.
        self._status = None
        self._grasps.publish(Bool(data=False))
        while self._proceed():
            self._executor.spin_once(timeout_sec=0.1)
            if self._status_where(closed=False) is not None:
                return True
            if time.monotonic() > end:
                raise GripperError(
                    f"{self._target} serves the gripper '{self._script.gripper}', but does not say that it is open; "
                    "does /clock stand still? What does its log say?"
                )
        return False

    def play(self) -> bool:
        """Play the script from beginning to end, in the time of the node's clock; False if told to end early.

        If this process was held up over a grasp, everything after it is delayed as well: otherwise the gripper would
        close where the cloth no longer is.
        """
        clock = self._node.get_clock()
        start = clock.now().nanoseconds
        waiting = list(self._script.grasps)
        made_up_for: GraspAt | None = None
        period = 1.0 / self._script.rate
        due = time.monotonic()
        while self._proceed():
            elapsed = (clock.now().nanoseconds - start) * 1e-9
            if waiting and elapsed > waiting[0].time + _HELD_UP and waiting[0] is not made_up_for:
                # Once for each: the steps of a simulated clock may be longer.
                made_up_for = waiting[0]
                late = elapsed - max(made_up_for.time - _HELD_UP, 0.0)
                start += int(late * 1e9)
                elapsed -= late
            self._send_target(min(elapsed, self._script.duration))
            # What the last grasp holds is asked before it may be opened again.
            while waiting and waiting[0].time <= elapsed and self._is_answered():
                self._grasp(waiting.pop(0).closed)
            if elapsed > self._script.duration and not waiting and self._is_answered():
                self._grasps.wait_for_all_acked(_DELIVERY)
                return True
            # By the steady clock, without drift; times that have passed are left out.
            due = max(due + period, time.monotonic() - period)
            while (left := due - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
        return False

    def _grasp(self, closed: bool) -> None:
        self._status = None
        self._grasps.publish(Bool(data=closed))
        if closed:
            self._open_question = time.monotonic() + _ANSWER

    def _is_answered(self) -> bool:
        """Whether it is known what the last closing did; notes it."""
        if self._open_question is None:
            return True
        status = self._status_where(closed=True)
        if status is not None:
            self.holds.append(Hold(int(status["held"]), status["words"]))
        elif time.monotonic() > self._open_question:
            self.holds.append(Hold(None, f"it did not answer within {_ANSWER:g} s"))
        else:
            return False
        self._open_question = None
        return True

    def _send_target(self, elapsed: float) -> None:
        position, orientation = self._script.pose(elapsed)
        message = PoseStamped()
        message.header.frame_id = self._script.frame_id
        set_stamp(message.header.stamp, self._node.get_clock().now().nanoseconds)
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = position
        q.x, q.y, q.z, q.w = orientation
        self._targets.publish(message)
        self.targets_sent += 1

    def _node_names(self) -> set[str]:
        return {f"{namespace.rstrip('/')}/{name}" for name, namespace in self._node.get_node_names_and_namespaces()}

    def _is_served(self) -> bool:
        """Whether the node is there and ready: it serves more than what rclpy makes with the node itself.

        By the services' names: asked for by the node's name, the graph answers for one node of that name, and one that
        was killed stays in it for some seconds beside the one that took its place.
        """
        of_node = (name for name, _ in self._node.get_service_names_and_types() if name.startswith(f"{self._target}/"))
        return any(not name.endswith(_OF_RCLPY) and self._node.count_services(name) for name in of_node)

    def _what_is_missing(self, limit: float) -> str:
        if self._target in self._node_names():
            return (
                f"{self._target} is there, but was not ready within {limit:g} s; what does its log say? "
                "--wait gives it longer"
            )
        return f"no node {self._target} came within {limit:g} s; is it running, in this ROS_DOMAIN_ID?"

    def _known_grippers(self) -> list[str]:
        prefix, suffix = f"{self._target}/", "/grasp"
        return sorted(
            topic[len(prefix) : -len(suffix)]
            for topic, _ in self._node.get_topic_names_and_types()
            if topic.startswith(prefix) and topic.endswith(suffix) and self._node.count_subscribers(topic)
        )
