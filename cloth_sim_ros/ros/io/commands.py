# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command topics of grippers and obstacles.

A callback only checks a message and queues an event.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import attrs
from geometry_msgs.msg import PointStamped, PoseStamped, TwistStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_msgs.msg import Bool

from cloth_sim_ros.ros.io.output import OPTIONS, RecordSink, overridden_profile
from cloth_sim_ros.ros.io.qos_rules import SUBSCRIPTION
from cloth_sim_ros.ros.io.stamps import OldStampError, StampError, StampGate, to_ros_time
from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.event_queue import MAX_QUEUED_EVENTS, EventQueue, EventResult, QueueFullError
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.ros.io.twists import TwistCommands

#: Best effort, so that any publisher matches; only the newest target counts.
TARGET_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
#: Reliable, because every grasp must arrive.
GRASP_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


class CommandSubscriptions:
    """Subscriptions of command topics; `subscribe` creates those of grippers, `subscribe_obstacles` of obstacles.

    Args:
        node: the node.
        simulation: the cloth; refuses events that can't take effect.
        queue: receives the events.
        frames: transforms poses into the cloth's frame.
        sink: records the bytes of each message.
        log: receives refusals.
        lock: held during each callback.
    """

    def __init__(
        self,
        node: Node,
        simulation: Simulation,
        queue: EventQueue,
        frames: FrameTransformer,
        sink: RecordSink,
        log: ThrottledLog,
        lock: AbstractContextManager[Any],
    ) -> None:
        self._node, self._clock, self._check, self._queue = node, node.get_clock(), simulation.check, queue
        self._frames, self._sink, self._log, self._lock = frames, sink, log, lock
        self._simulation, self._scene = simulation, simulation.scene
        #: Commanded velocities of the grippers; None without their topics.
        self.twists: TwistCommands | None = None
        self._grippers = simulation.scene.gripper_names
        self._gates = {name: StampGate() for name in self._grippers}
        self._obstacles: dict[str, Subscription] = {}
        #: Number of commands older than the newest one, by gripper or obstacle.
        self._n_outdated: dict[str, int] = {}
        self._last_target_times: dict[str, int] = {}
        #: Messages at the last call of `is_drained`, and the number of consecutive spins that delivered some.
        self._received_before = self._busy_spins = 0
        #: Counts of messages: received, refused, and older than the newest one.
        self.received = self.refused = self.outdated = 0

    def subscribe(self) -> None:
        """Subscribe to the command topics of the grippers. From then on every matched publisher is served."""
        if self._grippers and self._scene.gripper.twist_max_speed:
            from cloth_sim_ros.ros.io.twists import TwistCommands

            name = self._node.get_fully_qualified_name()
            self.twists = TwistCommands(self._simulation, self._frames, name, self._log)
            for gripper in self._grippers:
                self._create_subscription(gripper, "twist", TwistStamped, TARGET_QOS, self._twist)
        for gripper in self._grippers:
            for leaf, kind, qos, on_message in (
                ("target", PoseStamped, TARGET_QOS, functools.partial(self._pose, Target)),
                ("point", PointStamped, TARGET_QOS, self._point),
                ("grasp", Bool, GRASP_QOS, self._grasp),
            ):
                self._create_subscription(gripper, leaf, kind, qos, on_message)

    def subscribe_obstacles(self, names: list[str]) -> None:
        """Subscribe to the targets of the named obstacles, and unsubscribe from those of all others."""
        for name in [name for name in self._obstacles if name not in names]:
            self._node.destroy_subscription(self._obstacles.pop(name))
            del self._gates[name]
        for name in names:
            if name not in self._obstacles:
                self._gates[name] = StampGate()
                move = functools.partial(self._pose, Move)
                self._obstacles[name] = self._create_subscription(name, "target", PoseStamped, TARGET_QOS, move)

    def _create_subscription(
        self, name: str, leaf: str, kind: Any, qos: QoSProfile, on_message: Callable[[str, Any, int], None]
    ) -> Subscription:
        topic = f"~/{name}/{leaf}"
        profile = overridden_profile(self._node, topic, qos, endpoint_kind=SUBSCRIPTION)
        recorded_topic = self._node.resolve_topic_name(topic, only_expand=True)

        # Of exactly one argument: rclpy inspects the signature.
        def receive(data: bytes) -> None:
            with self._lock:
                now = self._clock.now().nanoseconds
                self.received += 1
                if self._sink.running:
                    self._sink.add(recorded_topic, kind, data, stamp=now, qos=profile, droppable=False)
                self._receive(name, leaf, kind, data, lambda message: on_message(name, message, now))

        # A volatile best-effort subscription matches every publisher and needs no event, which would slow each spin.
        on_incompatible = None
        if profile.reliability != ReliabilityPolicy.BEST_EFFORT or profile.durability != DurabilityPolicy.VOLATILE:
            on_incompatible = functools.partial(self._warn_of_incompatible_qos, self._node.resolve_topic_name(topic))
        events = SubscriptionEventCallbacks(incompatible_qos=on_incompatible, use_default_callbacks=False)
        # Raw, so that the received bytes are recorded, and so that the node refuses malformed ones itself.
        return self._node.create_subscription(
            kind, topic, receive, profile, raw=True, event_callbacks=events, qos_overriding_options=OPTIONS
        )

    def _warn_of_incompatible_qos(self, topic: str, event: Any) -> None:
        if event.last_policy_kind == QoSPolicyKind.DURABILITY:
            fault = "is volatile, so none of its messages arrive: make it transient local"
        else:
            fault = "offers best effort, so none of its messages arrive: make it reliable"
        self._log.warn(f"misfit {topic}", f"a publisher of {topic} {fault}")

    def last_target_time(self, gripper: str) -> int | None:
        """Return the ROS time [ns] at which a gripper's newest accepted target or twist came; None before the first."""
        return self._last_target_times.get(gripper)

    def is_drained(self) -> bool:
        """Return false if commands came since the last call, ten times in a row at most. Call it once after each spin.

        If it is false, call it again after one more spin.
        """
        has_new, self._received_before = self.received > self._received_before, self.received
        self._busy_spins = self._busy_spins + 1 if has_new else 0
        # At most as many spins as the middleware queues messages, so that a flood does not delay the frame.
        if has_new and self._busy_spins <= TARGET_QOS.depth:
            return False
        self._busy_spins = 0
        return True

    def limit_times(self, now: int) -> None:
        """Limit the times of the newest targets to the present ROS time [ns], because wall time was set back."""
        self._last_target_times = {name: min(time, now) for name, time in self._last_target_times.items()}
        if self.twists is not None:
            self.twists.limit_times(now)

    def reset_stamps(self) -> None:
        """Forget stamps and velocities because time was set back: commands of any stamp are accepted next."""
        for gate in self._gates.values():
            gate.reset()
        self._last_target_times.clear()
        if self.twists is not None:
            self.twists.clear()

    def _receive(self, name: str, leaf: str, kind: Any, data: bytes, on_message: Callable[[Any], None]) -> None:
        try:
            message = deserialize_message(data, kind)
        except (RuntimeError, UnicodeDecodeError) as error:
            self._log.debug(functools.partial("{} of '{}': {}".format, leaf, name, error))
            self._refuse(
                name, leaf, "bytes", f"its {len(data)} bytes are no {kind.__name__}; check the type of its publisher"
            )
            return
        try:
            on_message(message)
        except OldStampError as error:
            self.outdated += 1
            self._n_outdated[name] = self._n_outdated.get(name, 0) + 1
            self._log.warn(
                f"{leaf} {name} old",
                f"{leaf} of '{name}' is dropped: {error}; {self._n_outdated[name]} of '{name}' so far: send in order "
                "of stamps, or with stamp 0, which means now",
            )
        except (StampError, FrameError, EventError, QueueFullError, ValueError) as error:
            self._refuse(name, leaf, type(error).__name__, str(error))

    def _refuse(self, name: str, leaf: str, kind: str, reason: str) -> None:
        self.refused += 1
        # The error of an event's check names its target already.
        subject = f"target of '{name}'"
        if reason.startswith(f"{subject}: "):
            reason = reason.removeprefix(f"{subject}: ")
        elif reason.startswith(subject):
            reason = f"it{reason.removeprefix(subject)}"
        self._log.warn(f"{leaf} {name} {kind}", f"{leaf} of '{name}' is refused: {reason}")

    def _pose(self, kind: type[Target | Move], name: str, message: PoseStamped, now: int) -> None:
        p, q = message.pose.position, message.pose.orientation
        self._queue_target(kind(name, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)), message.header, now)

    def _point(self, gripper: str, message: PointStamped, now: int) -> None:
        p = message.point
        self._queue_target(Target(gripper, (p.x, p.y, p.z)), message.header, now)

    def _queue_target(self, event: Target | Move, header: Any, now: int) -> None:
        stamp = to_ros_time(header.stamp.sec, header.stamp.nanosec)
        # Values are checked first, so that an invalid one is reported rather than its frame or stamp.
        self._check(event)
        position, orientation = self._frames.to_cloth(header.frame_id, event.position, event.orientation, stamp)
        event = attrs.evolve(event, position=position, orientation=orientation)
        self._check(event)
        name = event.gripper if isinstance(event, Target) else event.obstacle
        n_evicted = self._queue.n_evicted
        self._queue.put(event, stamp=self._gates[name].accept(stamp, now))
        self._last_target_times[name] = now
        if self.twists is not None:
            self.twists.forget_velocity(name)
        if self._queue.n_evicted > n_evicted:
            self._log.warn(
                "displaced",
                f"{MAX_QUEUED_EVENTS} commands wait for a frame, and one of '{name}' replaced the oldest target; "
                f"{self._queue.n_evicted} so far: does /clock stand still, or does a sender flood?",
            )
        self._log.debug(functools.partial(_describe_command, event, stamp))

    def _twist(self, gripper: str, message: TwistStamped, now: int) -> None:
        assert self.twists is not None
        self.twists.receive(gripper, message, now)
        self._last_target_times[gripper] = now

    def _grasp(self, gripper: str, message: Bool, _now: int) -> None:
        event = Grasp(gripper, bool(message.data))
        self._check(event)
        self._queue.put(event, answer=self._report_result)
        self._log.debug(functools.partial(_describe_command, event, 0))

    def _report_result(self, result: EventResult) -> None:
        """Log the result of a grasp that came by a topic, unless its pads still move, or why it had no effect."""
        grasp = result.grasp
        if grasp is None:
            self._log.warn("grasp lost", f"a grasp did not take effect: {result.reason}")
        elif not grasp.pending:
            self._log_grasp(grasp)

    def log_grasps(self, frame: Frame) -> None:
        """Log the result of each grasp whose pads came to rest in a frame."""
        for grasp in frame.pinches:
            self._log_grasp(grasp)

    def _log_grasp(self, grasp: GraspResult) -> None:
        if not grasp.closed:
            outcome = "is open"
        elif grasp.grasped_count:
            outcome = f"is closed and holds {pluralize(grasp.grasped_count, 'particle')}"
        else:
            outcome = "is closed and holds nothing"
        cause = f": {grasp.reason}" if grasp.reason else ""
        self._log.info(f"grasp {grasp.gripper} {outcome}", f"gripper '{grasp.gripper}' {outcome}{cause}")


def _describe_command(event: Event, stamp: int) -> str:
    """Return the text of a received command for DEBUG lines."""
    when = f"stamped {stamp / 1e9:.3f} s" if stamp else "for now"
    return f"command received, {when}: {event}"
