# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Input part of the node: commands, followed TF frames, services and parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from cloth_sim_ros.ros.check.feasibility import check_feasibility
from cloth_sim_ros.ros.check.node_refusals import refuse_long_names
from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.parameters import LiveParameters, SceneNode
from cloth_sim_ros.ros.io.services import Services
from cloth_sim_ros.ros.io.tf_frames import FrameTransformer, TfFollower, coming_obstacles
from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.recording.recording_control import RecordingControl
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.frame_timing import FrameTiming
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Reset, SetParameters
from cloth_sim_ros.simulation.frame import Frame

if TYPE_CHECKING:
    from cloth_sim_ros.ros.io.gripper_actions import GripperActions
    from cloth_sim_ros.ros.io.robot_follower import RobotFollower
    from cloth_sim_ros.ros.io.robot_start import RobotStart
    from cloth_sim_ros.ros.io.simulation_interfaces import SimulationInterfaces


class Inputs:
    """Inputs of the node: commands, TF frames, requests and parameter changes, as events that wait for their frame.

    Args:
        node: the node.
        timing: its stepper's queue receives the events.
        failure: refuses requests while the node is failed; its lock is held during each change.
        recording: records the commands, and serves requests to record.
        log: receives refusals.
        robot: the robot whose links are obstacles; None without one.
        frames: TF, if the start needed it, so that its buffer is filled; None makes one.
    """

    def __init__(
        self,
        node: Node,
        timing: FrameTiming,
        failure: FailureGuard,
        recording: RecordingControl,
        log: ThrottledLog,
        robot: RobotStart | None = None,
        frames: FrameTransformer | None = None,
    ) -> None:
        simulation, queue = timing.stepper.simulation, timing.stepper.queue
        scene = simulation.scene
        self._node, self._simulation, self._queue = node, simulation, queue
        self._frames = FrameTransformer(node, scene.frame_id) if frames is None else frames
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
        if isinstance(node, SceneNode):
            node.complete = self._start_poses

        self._log, self._failure = log, failure
        #: Action servers of the grippers; None if no gripper has one.
        self.actions: GripperActions | None = None
        #: Servers of simulation_interfaces; None if they are not requested.
        self.interfaces: SimulationInterfaces | None = None

    def start(self) -> None:
        """Subscribe to commands of grippers and to joint states; create services, and actions if they are set."""
        self.commands.subscribe()
        if self._robot is not None:
            self._robot.subscribe()
        self.services.serve()
        if self._simulation.scene.has_actions:
            from cloth_sim_ros.ros.io.gripper_actions import GripperActions

            self.actions = GripperActions(self._node, self._simulation, self._queue, self._failure, self._log)
            self.actions.serve()

        if self._simulation.scene.simulation_interfaces:
            from cloth_sim_ros.ros.io.simulation_interfaces import SimulationInterfaces

            self.interfaces = SimulationInterfaces(self._node, self.services)
            self.interfaces.serve()

    def answer(self, frame: Frame) -> None:
        """Answer the service requests and action goals whose grasps ended in a frame."""
        self.services.answer_grasps(frame)
        if self.actions is not None:
            self.actions.answer(frame)

    def expire(self) -> None:
        """Answer service requests and canceled goals that have waited too long. Call it periodically."""
        self.services.expire_requests()
        if self.actions is not None:
            self.actions.expire()

    def fail(self, reason: str, stamp: int) -> None:
        """Answer service requests and action goals that wait for pads, because a frame failed."""
        self.services.fail(reason, stamp)
        if self.actions is not None:
            self.actions.fail(reason, stamp)

    def close(self) -> None:
        """Destroy the action servers, which rclpy's node would keep."""
        for servers in (self.actions, self.interfaces):
            if servers is not None:
                servers.close()

    def events(self, stamp: int, now: int) -> list[Event]:
        """Return the events that the node itself adds to a frame: of robot links, followed TF frames and velocities.

        Args:
            stamp: ROS time at which the frame is due [ns].
            now: present ROS time, or the stamp if it is later [ns].
        """
        of_links = [] if self._robot is None else self._robot.events(now)
        twists = self.commands.twists
        return [*of_links, *self.tf_follower.events(stamp), *([] if twists is None else twists.events(stamp))]

    def observe(self, frame: Frame) -> None:
        """Let the followers of TF frames and of a robot examine a frame, because they may have to repeat a command."""
        self.tf_follower.observe(frame)
        if self._robot is not None:
            self._robot.observe(frame)

    def return_parameters(self, reason: str) -> None:
        """Set the ROS parameters back to values in force, and log it: accepted ones could not take effect."""
        names = self.parameters.return_to(self._simulation.scene)
        self._node.get_logger().error(f"parameters are set back ({', '.join(names) or 'none'}): {reason}")

    def limit_times(self, now: int) -> None:
        """Limit remembered times to the present ROS time [ns], and drop later targets, because wall time was set back.

        Timeouts count from there. Targets with later stamps are dropped: they would come after newer ones.
        """
        self.commands.limit_times(now)
        self._queue.drop_later(now)
        if self._robot is not None:
            self._robot.limit_times(now)

    def restart_time(self) -> None:
        """Forget stamps and dynamic transforms because the clock was set back: any stamp is accepted next."""
        self.commands.reset_stamps()
        self._frames.clear()
        self.tf_follower.restart_time()
        if self._robot is not None:
            self._robot.restart_time()

    def build_reset(self, scene: Scene, is_required: bool) -> Reset:
        """Return a reset that starts a robot's links and followers of TF frames at their newest poses.

        Obstacles that joints hold to the cloth start with it, where the scene has them.

        Args:
            scene: the scene at the reset.
            is_required: true if the reset must succeed: with an obstacle in the cloth it has no poses then. It has
                none either while the node is failed.
        """
        poses = self.tf_follower.obstacle_poses(scene) | ({} if self._robot is None else self._robot.poses())
        event = _reset_at(scene, poses)
        if is_required or self._failure.refusal:
            try:
                self._simulation.check(event)
            except EventError as error:
                self._log.warn("reset", f"the reset starts links and followers of TF where the scene has them: {error}")
                return Reset()
        return event

    def _change_parameters(self, values: dict[str, Any]) -> None:
        # `_check_parameters` has made room for it.
        self._queue.put(SetParameters(values), reserved=True)
        self.tf_follower.listen(self.parameters.accepted)

    def _start_poses(self, values: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
        """Return poses of coming obstacles that follow TF frames or a robot, by full name, to be set with values."""
        with self._failure.lock:
            scene = self.parameters.accepted
            poses = self.tf_follower.start_poses(values, scene)
            links = {} if self._robot is None else self._robot.poses()
            for name in coming_obstacles(values, scene):
                if name in links:
                    poses |= {f"{name}.position": links[name][:3], f"{name}.orientation": links[name][3:]}
        return poses

    def _check_parameters(self, values: dict[str, Any], scene: Scene) -> None:
        refuse_long_names(scene, node=self._node.get_fully_qualified_name())
        check_feasibility(scene, self._simulation)
        affects_no_motion = all(entry.observes for entry in scene.entries if entry.name in values)
        if scene.ensemble.file and not affects_no_motion:
            options = scene.ensemble
            scene.distribution().check_members(scene, options.members, options.seed, extremes_alone=True)
        self._simulation.check_scene(scene)
        self._queue.evict_target(SetParameters(values))


def start_reset(scene: Scene, names: Iterable[str]) -> Reset:
    """Return a reset that starts named obstacles where a scene has them, whatever `initial_state` says."""
    obstacles = {name: scene.described[name] for name in names}
    return _reset_at(scene, {name: (*start.position, *start.orientation) for name, start in obstacles.items()})


def _reset_at(scene: Scene, poses: Mapping[str, tuple[float, ...]]) -> Reset:
    """Return a reset that starts named obstacles at poses, without those that joints hold to the cloth."""
    joined = scene.joined_obstacles if poses else ()
    names = [name for name in scene.obstacle_names if name in poses and name not in joined]
    return Reset(names, [poses[name] for name in names])
