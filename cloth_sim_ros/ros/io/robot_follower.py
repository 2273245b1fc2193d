# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robot follower: moves the obstacles of a robot's links to the poses of its joint states or TF frames."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.joint_states import JointStates
from cloth_sim_ros.ros.io.output import OPTIONS, RecordSink, overridden_profile
from cloth_sim_ros.ros.io.qos_rules import SUBSCRIPTION
from cloth_sim_ros.ros.io.robot_start import JOINT_STATES_QOS, link_poses
from cloth_sim_ros.ros.io.stamps import OldStampError, to_ros_time
from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.robot.links import RobotLinks
from cloth_sim_ros.scene.robot_section import JOINT_STATES
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, MoveObstacles, Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.scene.robot.pad_stops import PadStops

#: Silence of the joint states after which the log says that the links stand [ns].
_SILENCE = 1_000_000_000


class RobotFollower:
    """Source of events that move the obstacles of a robot's links to its joint states or TF frames.

    Args:
        node: the node.
        simulation: the cloth.
        links: the robot's links.
        states: the positions of its joints at the start.
        frames: looks up TF frames.
        commands: counts the messages with the commands, so that a frame waits for those that have arrived.
        sink: records the joint states.
        log: receives refusals and silences.
        lock: held during each callback.
    """

    def __init__(
        self,
        node: Node,
        simulation: Simulation,
        links: RobotLinks,
        states: JointStates,
        frames: FrameTransformer,
        commands: CommandSubscriptions,
        sink: RecordSink,
        log: ThrottledLog,
        lock: AbstractContextManager[Any],
    ) -> None:
        self._node, self._simulation, self._links, self._states = node, simulation, links, states
        self._frames, self._commands, self._sink, self._log, self._lock = frames, commands, sink, log, lock
        self._settings = simulation.scene.robot
        self._needs_poll = bool(self._settings.frame) or self._settings.source != JOINT_STATES
        self._start_poses: Array = np.array([_start_pose(simulation, name) for name in links.names]).reshape(-1, 7)
        self._poses, self._start_positions = self._start_poses, states.positions.copy()
        self._stops: PadStops | None = None
        if any(self._settings.pads):
            from cloth_sim_ros.scene.robot.pad_stops import PadStops

            self._stops = PadStops(simulation.scene, links)
            # The start counts as accepted: the first state may close the fingers at once.
            self._stops.limit_positions(self._start_positions)
        #: ROS time of the newest state, or of the first frame before it [ns]; 0 before both.
        self._last_state = 0
        #: True if the next frame has to repeat the command of the links; the same from the next state on.
        self._must_send = self._resends = False
        self._is_silent = self._has_failed = False
        #: Joints whose states have stopped while those of others come.
        self._silent_joints: list[str] = []

    def subscribe(self) -> None:
        """Subscribe to the joint states, unless TF gives the poses."""
        if self._settings.source != JOINT_STATES:
            return
        topic = self._settings.joint_states_topic
        profile = overridden_profile(self._node, topic, JOINT_STATES_QOS, endpoint_kind=SUBSCRIPTION)
        recorded_topic = self._node.resolve_topic_name(topic, only_expand=True)

        # Of exactly one argument: rclpy inspects the signature.
        def receive(data: bytes) -> None:
            with self._lock:
                now = self._node.get_clock().now().nanoseconds
                self._commands.received += 1
                if self._sink.running:
                    self._sink.add(recorded_topic, JointState, data, stamp=now, qos=profile, droppable=False)
                self._receive(data, now)

        self._node.create_subscription(JointState, topic, receive, profile, raw=True, qos_overriding_options=OPTIONS)

    def events(self, now: int) -> list[Event]:
        """Return the event, if any, that moves the links in the frame due at a ROS time [ns]; failures are logged."""
        is_changed = self._states.apply(now)
        self._report_silence(now)
        must_send, self._must_send = self._must_send, False
        if not (is_changed or self._needs_poll or must_send):
            return []
        accepted = None if self._stops is None else self._stops.accepted
        try:
            positions = (
                self._states.positions if self._stops is None else self._stops.limit_positions(self._states.positions)
            )
            poses = link_poses(self._links, positions, self._frames, self._settings)
            if np.array_equal(poses, self._poses) and not must_send:
                return []
            event = self._event(poses)
            if event.obstacles:
                self._simulation.check(event)
        except (FrameError, EventError) as error:
            self._has_failed, self._must_send = True, must_send
            if self._stops is not None:
                # The fingers stay where they are, too: the next state moves them from there.
                self._stops.accepted = accepted
            self._log.warn("robot", f"the robot's links stay where they are: {error}")
            return []
        if self._has_failed:
            self._has_failed = False
            self._log.info("robot found", "the robot's links move again")
        self._poses = poses
        return [event] if event.obstacles else []

    def observe(self, frame: Frame) -> None:
        """Let `events` send the links' poses again after a reset, changed parameters, or a stop and a new state."""
        if frame.events and any(isinstance(event, Reset | SetParameters) for event in frame.events):
            self._must_send = True
            if self._stops is not None:
                self._stops.update(self._simulation.scene)
        self._resends = self._resends or bool(frame.stopped)

    def limit_times(self, now: int) -> None:
        """Limit remembered times to the present ROS time [ns], because wall time was set back."""
        self._states.limit_times(now)
        self._last_state = min(self._last_state, now)

    def restart_time(self) -> None:
        """Return to the joint positions of the start because the clock was set back: any stamp is accepted next.

        A simulator that starts again has its robot at its start, and joint states that come after the reset.
        """
        self._states.restart_time(self._start_positions)
        self._last_state, self._poses = 0, self._start_poses
        if self._stops is not None:
            self._stops.accepted = None
            self._stops.limit_positions(self._start_positions)

    def poses(self) -> dict[str, tuple[float, ...]]:
        """Return the newest poses of the links' obstacles by name, 7 numbers each."""
        return {name: tuple(pose) for name, pose in zip(self._links.names, self._poses.tolist(), strict=True)}

    def _event(self, poses: Array) -> MoveObstacles:
        """Return the event that moves the present obstacles among the links."""
        names, present = self._links.names, self._simulation.scene.obstacles
        if set(names) <= set(present):
            return MoveObstacles(names, poses)
        indices = [k for k, name in enumerate(names) if name in present]
        return MoveObstacles([names[k] for k in indices], poses[indices])

    def _receive(self, data: bytes, now: int) -> None:
        try:
            message = deserialize_message(data, JointState)
        except (RuntimeError, UnicodeDecodeError):
            self._refuse("bytes", f"its {len(data)} bytes are no JointState; check the type of its publisher")
            return
        if not message.position:
            # Velocities or efforts alone are valid, and say nothing of the links.
            return
        try:
            stamp = to_ros_time(message.header.stamp.sec, message.header.stamp.nanosec)
            if self._states.add(message.name, message.position, stamp, now):
                self._last_state = now
                self._must_send, self._resends = self._must_send or self._resends, False
        except OldStampError as error:
            self._commands.outdated += 1
            self._log.warn("joint state old", f"a joint state is dropped: {error}")
        except ValueError as error:
            self._refuse(type(error).__name__, str(error))

    def _refuse(self, kind: str, reason: str) -> None:
        self._commands.refused += 1
        self._log.warn(f"joint state {kind}", f"a joint state is refused: {reason}")

    def _report_silence(self, now: int) -> None:
        """Log once when joint states stop, of all joints or of some, and when they come again."""
        if self._settings.source != JOINT_STATES:
            return
        self._last_state = self._last_state or now
        is_silent, topic = now - self._last_state > _SILENCE, self._settings.joint_states_topic
        joints = [] if is_silent else self._states.silent_since(now - _SILENCE)
        if joints and joints != self._silent_joints:
            listed = ", ".join(joints)
            self._log.warn(
                "joints", f"no joint state on {topic} names {listed} for 1 s: the links that they move stand"
            )
        if is_silent and not self._is_silent:
            self._log.warn("joint states", f"no joint state has come on {topic} for 1 s: the robot's links stand")
        elif not is_silent and not joints and (self._is_silent or self._silent_joints):
            self._log.info("joint states again", f"joint states come on {topic} again")
        self._is_silent, self._silent_joints = is_silent, joints


def _start_pose(simulation: Simulation, name: str) -> tuple[float, ...]:
    description = simulation.scene.described[name]
    return (*description.position, *description.orientation)
