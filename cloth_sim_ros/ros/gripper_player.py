# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A gripper client as any robot has one: finds the cloth's node and plays a script into its command topics."""

from __future__ import annotations

import time
from collections.abc import Callable

from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from cloth_sim_ros.ros.gripper_script import GraspAt, GripperScript
from cloth_sim_ros.ros.messages import set_stamp

#: The graph becomes known bit by bit: a gripper is unknown only if it stays so this long after the node was seen [s],
#: or after other grippers of it were.
_SETTLING = 3.0
_SETTLING_WITH_OTHERS = 1.0
#: How often a wait looks whether it shall go on.
_POLL = Duration(seconds=0.1)
#: A grasp later than this is made up for: the script goes on from as long before it, not from where the path has come
#: to since [s].
_HELD_UP = 0.1
#: How long the end waits for the last grasp to be received.
_DELIVERY = Duration(seconds=0.5)


class GripperError(RuntimeError):
    """The script can't be played; the message says why."""


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
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self.targets_sent = 0

    def wait_for_gripper(self, limit: float) -> bool:
        """Wait until the cloth's node listens to this gripper, at most `limit` seconds; False if told to end.

        Raises:
            GripperError: if the node does not come, or has no such gripper.
        """
        begun = time.monotonic()
        seen: float | None = None
        while self._proceed():
            if self._targets.get_subscription_count() and self._grasps.get_subscription_count():
                return self._begin_open()
            now = time.monotonic()
            if self._target not in self._node_names():
                seen = None
            elif seen is None:
                seen = now
            if seen is not None and now - seen > _SETTLING_WITH_OTHERS:
                known = self._known_grippers()
                if known or now - seen > _SETTLING:
                    raise GripperError(
                        f"{self._target} has no gripper '{self._script.gripper}'; it has {', '.join(known) or 'none'}"
                    )
            if now - begun > limit:
                raise GripperError(
                    f"no node {self._target} came within {limit:g} s; is it running, in this ROS_DOMAIN_ID?"
                )
            self._executor.spin_once(timeout_sec=0.02)
        return False

    def _begin_open(self) -> bool:
        """Open the gripper, and wait until the node has received that.

        We have met the node's subscriptions; it may take the node seconds longer to meet our publishers, and targets,
        sent as best effort, would be lost until then. What it acknowledges here it has met.
        """
        self._grasps.publish(Bool(data=False))
        while self._proceed():
            if self._grasps.wait_for_all_acked(_POLL):
                return True
        return False

    def play(self) -> bool:
        """Play the script from beginning to end, in the time of the node's clock; False if told to end early.

        Where we were held up over a grasp, all that follows is later: a hand that closes where the cloth is no more
        holds nothing.
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
            while waiting and waiting[0].time <= elapsed:
                self._grasps.publish(Bool(data=waiting.pop(0).closed))
            if elapsed > self._script.duration:
                self._grasps.wait_for_all_acked(_DELIVERY)
                return True
            # By the steady clock, without drift; times that have passed are left out.
            due = max(due + period, time.monotonic() - period)
            while (left := due - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
        return False

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

    def _known_grippers(self) -> list[str]:
        namespace, _, name = self._target.rpartition("/")
        topics = self._node.get_subscriber_names_and_types_by_node(name, namespace or "/")
        prefix, suffix = f"{self._target}/", "/grasp"
        return sorted(
            topic[len(prefix) : -len(suffix)]
            for topic, _ in topics
            if topic.startswith(prefix) and topic.endswith(suffix)
        )
