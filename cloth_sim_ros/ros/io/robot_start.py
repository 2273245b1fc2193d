# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start of a robot's links: waits for the description and for the first poses, and extends the scene by the links."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.ros.io.joint_states import JointStates
from cloth_sim_ros.ros.io.output import overridden_profile
from cloth_sim_ros.ros.io.qos_rules import SUBSCRIPTION
from cloth_sim_ros.ros.io.stamps import to_ros_time
from cloth_sim_ros.ros.io.start_wait import await_condition
from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.reporting.log import shorten_lines
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.robot.kinematics import transform_of
from cloth_sim_ros.scene.robot.links import RobotLinks, add_links, read_description, with_poses, without_links
from cloth_sim_ros.scene.robot_section import TF, RobotParameters
from cloth_sim_ros.scene.scene import Scene

#: The topic of a description is latched (transient local).
DESCRIPTION_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
#: Best effort, so that any publisher matches.
JOINT_STATES_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
#: Wait for the joints that no state has named, from the first state on [s].
_MISSING_TIMEOUT = 2.0


class RobotStart:
    """Start of a robot's links, once a node: `extend` waits for description and poses, and adds links as obstacles.

    Args:
        node: the node, which is in no executor yet.
        signal_name: returns the name of the signal that has come; empty if none has.
    """

    def __init__(self, node: Node, signal_name: Callable[[], str]) -> None:
        self._node, self._signal_name = node, signal_name
        #: The robot's links, the positions of its joints, and TF; None before `extend`.
        self.links: RobotLinks | None = None
        self.states = JointStates(())
        self.frames: FrameTransformer | None = None
        self._settings: RobotParameters | None = None
        #: The description from its topic, and the newest other one, which is not used.
        self._description = self._ignored = ""

    def extend(self, values: Mapping[str, Any], files: Mapping[str, bytes]) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Wait, without limit, for the robot; return a scene's parameters with its links as obstacles, and its files.

        Raises:
            ParameterError: for an invalid scene or description, naming the remedy.
            StopRequestedError: if a signal came meanwhile.
        """
        scene = Scene.from_parameters(without_links(values), files=files)
        settings = scene.robot
        _check_tf(settings)
        folder = Path()
        if settings.description_file:
            description: bytes | str = read_description(settings.description_file)
            folder = Path(settings.description_file).parent
        else:
            description = self._await_description(settings)
        extended, contents, links = add_links(scene, values, description, folder=folder)
        for note in links.notes:
            self._node.get_logger().info(note)
        self.links, self.states = links, JointStates(links.joint_names)
        self.frames = FrameTransformer(self._node, scene.frame_id)
        self._settings = settings
        poses = self._await_poses(links, settings)
        self.frames.link_pose = self._link_pose
        self._node.get_logger().info(
            f"robot: {len(links.names)} collision shapes of {len(set(links.links))} links are obstacles"
        )
        return with_poses(extended, links, poses), contents

    def _await_description(self, settings: RobotParameters) -> str:
        topic = self._node.resolve_topic_name(settings.description_topic)

        def receive(data: bytes) -> None:
            text = self._read(data, String, topic).data
            self._description = self._description or text
            if text not in (self._description, self._ignored, ""):
                self._ignored = text
                self._node.get_logger().warning(
                    f"the robot's description on {topic} has changed: the links stay those of the first one; restart "
                    "the node to use the new one"
                )

        # It stays, to tell of changes.
        self._node.create_subscription(String, settings.description_topic, receive, DESCRIPTION_QOS, raw=True)
        self._wait(
            lambda: bool(self._description),
            lambda: (
                f"waiting for the robot's description on {topic} (robot.description_topic): start "
                "robot_state_publisher, or set robot.description_file"
            ),
        )
        return self._description

    def _await_poses(self, links: RobotLinks, settings: RobotParameters) -> Array:
        """Wait for the poses of all links; return them, shape (count, 7). After 2 s, missing joints stay near 0."""
        poses: list[Array] = []
        reason = ""

        def find_poses() -> bool:
            nonlocal reason
            try:
                assert self.frames is not None
                poses.append(link_poses(links, self.states.positions, self.frames, settings))
            except FrameError as error:
                reason = str(error)
            return bool(poses)

        if settings.source == TF:
            self._wait(find_poses, lambda: f"waiting for the TF frames of the robot's links: {reason}")
            return poses[-1]
        topic = self._node.resolve_topic_name(settings.joint_states_topic)

        def receive(data: bytes) -> None:
            self._receive(self._read(data, JointState, topic))

        profile = overridden_profile(
            self._node, settings.joint_states_topic, JOINT_STATES_QOS, endpoint_kind=SUBSCRIPTION
        )
        subscription = self._node.create_subscription(
            JointState, settings.joint_states_topic, receive, profile, raw=True
        )
        first = 0.0

        def is_complete() -> bool:
            nonlocal first
            self.states.apply(2**63 - 1)
            if self.states.is_known.any():
                first = first or time.monotonic()
            is_late = first and time.monotonic() - first > _MISSING_TIMEOUT
            return not self.states.missing or bool(is_late)

        self._wait(
            is_complete,
            lambda: (
                f"waiting for joint states on {topic} (robot.joint_states_topic) that name "
                f"{', '.join(self.states.missing)}"
            ),
        )
        if missing := self.states.missing:
            fallback = links.kinematics.joint_positions({})
            is_missing = ~self.states.is_known
            self.states.positions[is_missing] = fallback[is_missing]
            self._node.get_logger().warning(
                f"no joint state on {topic} names {', '.join(missing)}: these joints stay at 0, or at their limit "
                "nearest to it, until one does"
            )
        self._wait(find_poses, lambda: f"waiting for the robot's mount (robot.frame): {reason}")
        self._node.destroy_subscription(subscription)
        return poses[-1]

    def _read(self, data: bytes, kind: Any, topic: str) -> Any:
        """Deserialize a message; return an empty one, with a warning, if the bytes are not of its type."""
        try:
            return deserialize_message(data, kind)
        except (RuntimeError, UnicodeDecodeError):
            self._node.get_logger().warning(
                f"{len(data)} bytes on {topic} are no {kind.__name__}; check the type of its publisher",
                throttle_duration_sec=1.0,
            )
            return kind()

    def _receive(self, message: JointState) -> None:
        if not message.position:
            return
        now, time_of = self._node.get_clock().now().nanoseconds, message.header.stamp
        try:
            self.states.add(message.name, message.position, to_ros_time(time_of.sec, time_of.nanosec), now)
        except ValueError as error:
            text = shorten_lines(f"a joint state is refused: {error}")
            self._node.get_logger().warning(text, throttle_duration_sec=1.0)

    def _wait(self, is_done: Callable[[], bool], describe: Callable[[], str]) -> None:
        def on_jump_back() -> None:
            # Joint states accept the older stamps by themselves.
            if self.frames is not None:
                self.frames.clear()

        await_condition(self._node, is_done, describe, self._signal_name, on_jump_back=on_jump_back)

    def _link_pose(self, name: str) -> tuple[tuple[float, ...], tuple[float, ...], int] | None:
        """Return a link's position [m], orientation x, y, z, w and stamp [ns]; None for a frame that TF places."""
        links, frames, settings = self.links, self.frames, self._settings
        assert links is not None and frames is not None and settings is not None
        # TF places the mount, and all links with it.
        if settings.source == TF or name not in links.kinematics.placements or name == settings.frame:
            return None
        mount, stamp = mount_of(frames, settings)
        pose = links.link_pose(name, self.states.positions, mount).tolist()
        return tuple(pose[:3]), tuple(pose[3:]), max(self.states.stamp, stamp)


def _check_tf(settings: RobotParameters) -> None:
    """Raise ParameterError if a robot's parameters need tf2_ros and it is not installed.

    Raises:
        ParameterError: naming the parameter and the remedy.
    """
    if not settings.frame and settings.source != TF:
        return
    try:
        import tf2_ros  # noqa: F401
    except ImportError as error:
        name = "robot.frame" if settings.frame else "robot.source"
        raise ParameterError(
            f"{name} needs tf2_ros, which is not installed: sudo apt install ros-jazzy-tf2-ros-py, or leave it out"
        ) from error


def link_poses(links: RobotLinks, positions: Array, frames: FrameTransformer, settings: RobotParameters) -> Array:
    """Return the poses (count, 7) of the links' obstacles in the cloth's frame, by TF or joints, or FrameError.

    Raises:
        FrameError: if TF lacks a frame.
    """
    if settings.source == TF:
        return links.poses_from_links({link: _transform(frames, link)[0] for link in dict.fromkeys(links.links)})
    return links.poses(positions, mount_of(frames, settings)[0])


def mount_of(frames: FrameTransformer, settings: RobotParameters) -> tuple[Array | None, int]:
    """Return the transform (4, 4) of `robot.frame` in the cloth's frame and its stamp [ns]; (None, 0) if it is not set.

    The transform is None, and the stamp 0, if `robot.frame` is not set.

    Raises:
        FrameError: if TF lacks it.
    """
    return _transform(frames, settings.frame) if settings.frame else (None, 0)


def _transform(frames: FrameTransformer, frame: str) -> tuple[Array, int]:
    position, orientation, stamp = frames.newest(frame)
    return transform_of(position, orientation), stamp
