# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command topics of grippers and obstacles. A callback checks a message and queues an event, nothing more."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import attrs
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_msgs.msg import Bool

from cloth_sim_ros.ros.event_queue import MOST_WAITING, EventQueue, Outcome, QueueFullError
from cloth_sim_ros.ros.frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.ros.outputs import Tape
from cloth_sim_ros.ros.qos_overrides import OPTIONS, overridden_profile
from cloth_sim_ros.ros.qos_rules import SUBSCRIPTION
from cloth_sim_ros.ros.stamps import OldStampError, StampError, StampGate, checked
from cloth_sim_ros.session.words import counted
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.grippers import GraspResult

#: Best effort, so that any publisher matches; the newest target is what counts.
TARGETS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
#: No grasp may be lost.
GRASPS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


class Commands:
    """Subscriptions of every gripper and obstacle of a cloth, from `listen` on.

    Args:
        node: the node.
        grippers: names.
        queue: where events wait.
        check: refuses events that can't take effect, with EventError.
        frames: brings poses into the cloth's frame.
        tape: records the bytes as they came.
        log: for refusals.
        turn: held while the queue is worked on.
    """

    def __init__(
        self,
        node: Node,
        *,
        grippers: list[str],
        queue: EventQueue,
        check: Callable[[Event], None],
        frames: FrameTransformer,
        tape: Tape,
        log: ThrottledLog,
        turn: AbstractContextManager[Any],
    ) -> None:
        self._node = node
        self._clock = node.get_clock()
        self._queue = queue
        self._check = check
        self._frames = frames
        self._tape = tape
        self._log = log
        self._turn = turn
        self._grippers = grippers
        self._gates = {name: StampGate() for name in grippers}
        self._obstacles: dict[str, Subscription] = {}
        #: Commands older than the newest, by gripper or obstacle.
        self._dropped: dict[str, int] = {}
        self._heard: dict[str, int] = {}
        #: Messages that had arrived at the last call of `settled`, and the number of turns in a row that brought some.
        self._seen = 0
        self._turns = 0
        #: Messages that arrived, and of them those that were refused or older than the newest.
        self.received = 0
        self.refused = 0
        self.outdated = 0

    def listen(self) -> None:
        """Subscribe: whoever meets a subscription may rely on being heard."""
        for gripper in self._grippers:
            for leaf, kind, qos, handle in (
                ("target", PoseStamped, TARGETS, self._target),
                ("point", PointStamped, TARGETS, self._point),
                ("grasp", Bool, GRASPS, self._grasp),
            ):
                self._subscribe(gripper, leaf, kind, qos, handle)

    def listen_to_obstacles(self, names: list[str]) -> None:
        """Subscribe for the obstacles that there are now, and no more for those that are gone."""
        for name in [name for name in self._obstacles if name not in names]:
            self._node.destroy_subscription(self._obstacles.pop(name))
            del self._gates[name]
        for name in names:
            if name not in self._obstacles:
                self._gates[name] = StampGate()
                self._obstacles[name] = self._subscribe(name, "target", PoseStamped, TARGETS, self._move)

    def _subscribe(
        self, name: str, leaf: str, kind: Any, qos: QoSProfile, handle: Callable[[str, Any, int], None]
    ) -> Subscription:
        topic = f"~/{name}/{leaf}"
        profile = overridden_profile(self._node, topic, qos, endpoint_kind=SUBSCRIPTION)
        take = functools.partial(
            self._take, name, leaf, kind, profile, self._node.resolve_topic_name(topic, only_expand=True), handle
        )
        # Raw, so that the very bytes that came are recorded, and so that broken ones are ours to refuse.
        # A volatile best-effort subscription matches every publisher: it needs no event, which costs each turn time.
        choosy = profile.reliability != ReliabilityPolicy.BEST_EFFORT or profile.durability != DurabilityPolicy.VOLATILE
        misfit = functools.partial(self._warn_of_misfit, self._node.resolve_topic_name(topic)) if choosy else None
        events = SubscriptionEventCallbacks(incompatible_qos=misfit, use_default_callbacks=False)
        return self._node.create_subscription(
            kind, topic, self._single(take), profile, raw=True, event_callbacks=events, qos_overriding_options=OPTIONS
        )

    def _warn_of_misfit(self, topic: str, event: Any) -> None:
        if event.last_policy_kind == QoSPolicyKind.DURABILITY:
            fault = "is volatile, and nothing that it sends is heard: make it transient local"
        else:
            fault = "offers best effort, and nothing that it sends is heard: make it reliable"
        self._log.warn(f"misfit {topic}", f"a publisher of {topic} {fault}")

    def heard(self, gripper: str) -> int | None:
        """When the newest target of a gripper or obstacle came, ROS time [ns]; None if none has."""
        return self._heard.get(gripper)

    def settled(self) -> bool:
        """Whether every command that has arrived was taken, judged by the executor's turns since the last call.

        While it is False, ask again one turn later.
        """
        taken, self._seen = self.received > self._seen, self.received
        self._turns = self._turns + 1 if taken else 0
        # No more than the middleware keeps: a flood must not hold up the frame.
        if taken and self._turns <= TARGETS.depth:
            return False
        self._turns = 0
        return True

    def forget_stamps(self) -> None:
        """Accept any stamp next: the clock was set back, or the cloth was."""
        for gate in self._gates.values():
            gate.forget()
        self._heard.clear()

    def _single(self, take: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Return a function of exactly one argument: rclpy looks at how many a callback could take."""

        def callback(data: bytes) -> None:
            with self._turn:
                take(data)

        return callback

    def _take(
        self,
        name: str,
        leaf: str,
        kind: Any,
        qos: QoSProfile,
        topic: str,
        handle: Callable[[str, Any, int], None],
        data: bytes,
    ) -> None:
        now = self._clock.now().nanoseconds
        self.received += 1
        if self._tape.running:
            self._tape.add(topic, kind, data, stamp=now, qos=qos, droppable=False)
        try:
            message = deserialize_message(data, kind)
        except (RuntimeError, UnicodeDecodeError) as error:
            self._log.debug(functools.partial("{} of '{}': {}".format, leaf, name, error))
            self._refuse(
                name, leaf, "bytes", f"its {len(data)} bytes are no {kind.__name__}; look at its publisher's type"
            )
            return
        try:
            handle(name, message, now)
        except OldStampError as error:
            self.outdated += 1
            self._dropped[name] = self._dropped.get(name, 0) + 1
            self._log.warn(
                f"{leaf} {name} old",
                f"{leaf} of '{name}' is dropped: {error}; {self._dropped[name]} of '{name}' so far: send in order of "
                "stamps, or with stamp 0, which means now",
            )
        except (StampError, FrameError, EventError, QueueFullError, ValueError) as error:
            self._refuse(name, leaf, type(error).__name__, str(error))

    def _refuse(self, name: str, leaf: str, kind: str, reason: str) -> None:
        self.refused += 1
        # The check of an event names its target itself.
        subject = f"target of '{name}'"
        if reason.startswith(f"{subject}: "):
            reason = reason.removeprefix(f"{subject}: ")
        elif reason.startswith(subject):
            reason = f"it{reason.removeprefix(subject)}"
        self._log.warn(f"{leaf} {name} {kind}", f"{leaf} of '{name}' is refused: {reason}")

    def _target(self, gripper: str, message: PoseStamped, now: int) -> None:
        p, q = message.pose.position, message.pose.orientation
        self._aim(Target(gripper, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)), message.header, now)

    def _point(self, gripper: str, message: PointStamped, now: int) -> None:
        p = message.point
        self._aim(Target(gripper, (p.x, p.y, p.z)), message.header, now)

    def _move(self, obstacle: str, message: PoseStamped, now: int) -> None:
        p, q = message.pose.position, message.pose.orientation
        self._aim(Move(obstacle, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)), message.header, now)

    def _aim(self, event: Target | Move, header: Any, now: int) -> None:
        stamp = checked(header.stamp.sec, header.stamp.nanosec)
        # An invalid value is reported as such, before its frame is looked up and its stamp compared.
        self._check(event)
        position, orientation = self._frames.to_cloth(header.frame_id, event.position, event.orientation, stamp)
        event = attrs.evolve(event, position=position, orientation=orientation)
        self._check(event)
        name = event.gripper if isinstance(event, Target) else event.obstacle
        displaced = self._queue.displaced
        self._queue.put(event, stamp=self._gates[name].accept(stamp, now))
        self._heard[name] = now
        if self._queue.displaced > displaced:
            self._log.warn(
                "displaced",
                f"{MOST_WAITING} commands wait for a frame, and the oldest target gave way to one of '{name}'; "
                f"{self._queue.displaced} so far: does /clock stand still, or does a sender flood?",
            )
        self._log.debug(functools.partial(_in_words, event, stamp))

    def _grasp(self, gripper: str, message: Bool, _now: int) -> None:
        event = Grasp(gripper, bool(message.data))
        self._check(event)
        self._queue.put(event, answer=self._tell)
        self._log.debug(functools.partial(_in_words, event, 0))

    def _tell(self, outcome: Outcome) -> None:
        """Say what a grasp did: it has no other answer."""
        grasp = outcome.grasp
        if grasp is None:
            self._log.warn("grasp lost", f"a grasp did not take effect: {outcome.reason}")
        elif not grasp.pending:
            self._tell_grasp(grasp)

    def show(self, frame: Frame) -> None:
        """Say of pads that came to rest in a frame what is between them."""
        for grasp in frame.pinches:
            self._tell_grasp(grasp)

    def _tell_grasp(self, grasp: GraspResult) -> None:
        if not grasp.closed:
            done = "is open"
        elif grasp.held:
            done = f"is closed and holds {counted(grasp.held, 'particle')}"
        else:
            done = "is closed and holds nothing"
        self._log.info(
            f"grasp {grasp.gripper} {done}",
            f"gripper '{grasp.gripper}' {done}" + (f": {grasp.reason}" if grasp.reason else ""),
        )


def _in_words(event: Event, stamp: int) -> str:
    """Return a command as DEBUG lines have it."""
    when = f"stamped {stamp / 1e9:.3f} s" if stamp else "for now"
    return f"command received, {when}: {event}"
