# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commanded velocities of grippers, which become a target in each frame.

A recorded session holds these targets. Therefore it runs again without the velocities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import attrs

from cloth_sim_ros.physics.plan.gripper_path import normalized, rotated_by, rotation_matrix
from cloth_sim_ros.ros.io.stamps import StampGate, to_ros_time
from cloth_sim_ros.ros.io.tf_frames import FrameTransformer
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: Largest rotation in a frame [rad]: a path takes the shortest way.
_MAX_ROTATION = 3.0


class TwistError(ValueError):
    """Error: a commanded velocity is refused; the message says why."""


@attrs.define
class _Twist:
    """A commanded velocity in the cloth's frame."""

    #: [m/s] and [rad/s], 3 numbers each.
    linear: list[float]
    angular: list[float]
    #: ROS time from which its timeout counts [ns].
    stamp: int


class TwistCommands:
    """Newest commanded velocity of each gripper, turned into a target for each frame.

    Args:
        simulation: the cloth.
        frames: transforms velocities into the cloth's frame.
        node_name: full name of the node; its grippers' own frames are `<node>/<gripper>`.
        log: receives limits and timeouts.
    """

    def __init__(self, simulation: Simulation, frames: FrameTransformer, node_name: str, log: ThrottledLog) -> None:
        self._simulation, self._frames, self._prefix, self._log = simulation, frames, node_name.strip("/"), log
        self._twists: dict[str, _Twist] = {}
        self._gates = {name: StampGate() for name in simulation.scene.gripper_names}

    def receive(self, gripper: str, message: Any, now: int) -> None:
        """Check and store the velocity in a TwistStamped that came at a ROS time [ns]; ValueError if it is refused.

        Raises:
            ValueError: if the gripper can't follow it.
        """
        scene, grippers = self._simulation.scene, self._simulation.grippers
        linear, angular = ([v.x, v.y, v.z] for v in (message.twist.linear, message.twist.angular))
        if not all(map(math.isfinite, (*linear, *angular))):
            raise TwistError(f"its velocities are {linear} and {angular}; they must be finite")
        if frame := scene.of_gripper(gripper, "frame"):
            raise TwistError(f"the gripper follows the TF frame '{frame}' (gripper.frame)")
        if not grippers.is_placed(grippers.names.index(gripper)):
            raise TwistError("the gripper has had no target yet, so it is nowhere: send a target first")
        stamp = to_ros_time(message.header.stamp.sec, message.header.stamp.nanosec)
        rotation = self._rotation(gripper, message.header.frame_id, stamp)
        stamp = min(self._gates[gripper].accept(stamp, now), now)
        section = scene.gripper
        linear = self._limit(gripper, "twist_max_speed", linear, section.twist_max_speed, "m/s")
        angular = self._limit(gripper, "twist_max_rate", angular, section.twist_max_rate, "rad/s")
        self._twists[gripper] = _Twist((rotation @ linear).tolist(), (rotation @ angular).tolist(), stamp)

    def forget_velocity(self, gripper: str) -> None:
        """Forget the velocity of a gripper, because a target was sent to it."""
        self._twists.pop(gripper, None)

    def limit_times(self, now: int) -> None:
        """Count the timeout of each velocity from the present ROS time [ns] at most, because wall time was set back."""
        for twist in self._twists.values():
            twist.stamp = min(twist.stamp, now)

    def clear(self) -> None:
        """Forget all velocities and stamps, because the clock or the cloth was set back."""
        self._twists.clear()
        for gate in self._gates.values():
            gate.reset()

    def events(self, now: int) -> list[Event]:
        """Return targets, at the end of the frame due at a ROS time [ns], by velocities; forget those that time out."""
        simulation = self._simulation
        if not self._twists or simulation.paused:
            return []
        scene, grippers, events = simulation.scene, simulation.grippers, list[Event]()
        for name, twist in list(self._twists.items()):
            silence, index = (now - twist.stamp) * 1e-9, grippers.names.index(name)
            if not grippers.is_placed(index):
                # After a reset.
                del self._twists[name]
                continue
            if silence > scene.gripper.twist_timeout:
                del self._twists[name]
                if any((*twist.linear, *twist.angular)):
                    self._log.info(
                        f"twist {name}",
                        f"'{name}' stops: no twist has come for {silence:.2f} s (gripper.twist_timeout)",
                    )
                continue
            # From the pose, not the target: a gripper that its speed limit or the cloth stops does not wind up.
            pose = grippers.poses()[index].tolist()
            target = Target(name, *_pose_after(pose, twist.linear, twist.angular, scene.period))
            try:
                simulation.check(target)
            except EventError as error:
                del self._twists[name]
                self._log.warn(f"twist {name}", f"'{name}' stops: {error}")
                continue
            events.append(target)
        return events

    def _rotation(self, gripper: str, frame_id: str, stamp: int) -> Any:
        """Return the rotation matrix (3, 3) from the axes of a TF or gripper frame to those of the cloth's frame."""
        if frame_id == f"{self._prefix}/{gripper}":
            grippers = self._simulation.grippers
            return rotation_matrix(grippers.poses()[grippers.names.index(gripper)][3:])
        _, orientation = self._frames.to_cloth(frame_id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)
        assert orientation is not None
        return rotation_matrix(normalized(orientation))

    def _limit(self, gripper: str, leaf: str, vector: list[float], limit: float, unit: str) -> list[float]:
        """Return a velocity shortened to a limit, and warn if it was longer."""
        length = math.hypot(*vector)
        if length <= limit:
            return vector
        self._log.warn(
            f"{leaf} {gripper}",
            f"twist of '{gripper}' has {length:.3g} {unit}; it is limited to {limit:g} {unit} (gripper.{leaf})",
        )
        return [component * (limit / length) for component in vector]


def _pose_after(
    pose: Sequence[float], linear: Sequence[float], angular: Sequence[float], duration: float
) -> tuple[list[float], list[float]]:
    """Return position [m] and orientation after velocities [m/s, rad/s] for a time [s]; it turns by 3 rad at most."""
    rotation = [rate * duration for rate in angular]
    shortening = min(_MAX_ROTATION / math.hypot(*rotation), 1.0) if any(rotation) else 1.0
    position = [p + v * duration for p, v in zip(pose[:3], linear, strict=True)]
    return position, rotated_by(pose[3:], [shortening * angle for angle in rotation])
