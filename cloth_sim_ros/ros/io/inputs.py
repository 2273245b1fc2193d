# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Input part of the node: commands, followed TF frames, services and parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from cloth_sim_ros.ros.check.feasibility import check_feasibility
from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.parameters import LiveParameters
from cloth_sim_ros.ros.io.services import Services
from cloth_sim_ros.ros.io.tf_frames import FrameTransformer, TfFollower
from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.recording.recording_control import RecordingControl
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.frame_timing import FrameTiming
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, SetParameters
from cloth_sim_ros.simulation.simulation import Frame

if TYPE_CHECKING:
    from cloth_sim_ros.ros.io.robot_follower import RobotFollower
    from cloth_sim_ros.ros.io.robot_start import RobotStart


class Inputs:
    """Inputs of one node: each valid one waits in the queue for its frame.

    Args:
        node: the node.
        timing: its stepper's queue receives the events.
        failure: refuses requests while the node is failed; its lock is held during each change.
        recording: records the commands, and serves requests to record.
        log: receives refusals.
        robot: the robot whose links are obstacles; None without one.
    """

    def __init__(
        self,
        node: Node,
        timing: FrameTiming,
        failure: FailureGuard,
        recording: RecordingControl,
        log: ThrottledLog,
        robot: RobotStart | None = None,
    ) -> None:
        simulation, queue = timing.stepper.simulation, timing.stepper.queue
        scene = simulation.scene
        self._node, self._simulation, self._queue = node, simulation, queue
        self._frames = FrameTransformer(node, scene.frame_id)
        sink, callback_lock = recording.session, failure.callback_lock
        self.commands = CommandSubscriptions(node, simulation, queue, self._frames, sink, log, callback_lock)
        self.tf_follower = TfFollower(simulation, self._frames, self.commands.last_target_time, log)
        self._robot: RobotFollower | None = None
        if robot is not None and robot.links is not None:
            from cloth_sim_ros.ros.io.robot_follower import RobotFollower

            self._robot = RobotFollower(
                node, simulation, robot.links, robot.states, self._frames, self.commands, sink, log, callback_lock
            )
        self.services = Services(node, timing, recording, failure)
        self.parameters = LiveParameters(node, scene, self._change_parameters, self._check_parameters, failure.lock)

    def start(self) -> None:
        """Subscribe to the commands of the grippers and to joint states, and create the services."""
        self.commands.subscribe()
        if self._robot is not None:
            self._robot.subscribe()
        self.services.serve()

    def events(self, stamp: int, now: int) -> list[Event]:
        """Return the events of a robot's links and of followed TF frames for the frame due at a ROS time [ns].

        Args:
            stamp: ROS time at which the frame is due [ns].
            now: present ROS time, or the stamp if it is later [ns].
        """
        of_links = [] if self._robot is None else self._robot.events(now)
        return [*of_links, *self.tf_follower.events(stamp)]

    def observe(self, frame: Frame) -> None:
        """Observe a frame: the command of a robot's links may have to be repeated."""
        if self._robot is not None:
            self._robot.observe(frame)

    def return_parameters(self, reason: str) -> None:
        """Set the parameters back to those in force, because accepted ones could not take effect."""
        self._node.get_logger().error(f"parameters are set back: {reason}")
        self.parameters.return_to(self._simulation.scene)

    def restart_time(self) -> None:
        """Accept any stamp next and forget dynamic transforms, because the clock was set back."""
        self.commands.reset_stamps()
        self._frames.clear()
        if self._robot is not None:
            self._robot.restart_time()

    def _change_parameters(self, values: dict[str, Any]) -> None:
        # `_check_parameters` has made room for it.
        self._queue.put(SetParameters(values), reserved=True)

    def _check_parameters(self, values: dict[str, Any], scene: Scene) -> None:
        check_feasibility(scene, self._simulation)
        self._simulation.check_scene(scene)
        self._queue.evict_target(SetParameters(values))
