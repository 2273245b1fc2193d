# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TF frames as inputs: transformed commands, followed frames and the command timeout."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.time import Time

from cloth_sim_ros.physics.plan.gripper_path import normalized, quaternion_product, rotation_matrix
from cloth_sim_ros.ros.io.messages import read_stamp
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.frame_ids import fault
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Largest age of the newest transform relative to a command's stamp [ns]: a command comes before its transform.
MAX_TRANSFORM_AGE = 100_000_000
#: Period of the warnings of a frame that can't be followed, and silence of TF after which the log says so [ns].
_WARNING_PERIOD, _SILENCE = 60_000_000_000, 1_000_000_000

Pose = tuple[tuple[float, ...], tuple[float, ...] | None]


class FrameError(ValueError):
    """Error: a pose can't be transformed into the cloth's frame; the message says why."""


class Tf2MissingError(FrameError):
    """Error: a pose can't be transformed because tf2_ros is not installed; the message names the remedy."""


class FrameTransformer:
    """Transformer of poses into the cloth's frame, by tf2 or by the links of a robot.

    The first pose in another frame imports tf2 and subscribes to /tf.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        self._node, self._frame_id = node, frame_id
        self._tf2: Any = None
        self._buffer: Any = None
        self._listener: Any = None
        self._transform_stamp = 0
        #: Newest time of `advance_time` [ns].
        self._time = 0
        #: Returns the pose and stamp of a robot's link by name, without tf2; None for other frames.
        self.link_pose: Callable[[str], tuple[tuple[float, ...], tuple[float, ...], int] | None] = lambda _name: None
        #: True if tf2 could not be imported. A second import would cost time in each frame of a following gripper.
        self._is_tf2_missing = False

    def to_cloth(
        self,
        frame_id: str,
        position: tuple[float, ...],
        orientation: tuple[float, ...] | None,
        stamp: int,
        *,
        max_age: int = MAX_TRANSFORM_AGE,
    ) -> Pose:
        """Transform a pose into the cloth's frame; return position [m] and orientation (or None), or raise FrameError.

        Args:
            frame_id: frame of the command; empty means the cloth's.
            position: 3 numbers [m].
            orientation: quaternion x, y, z, w, or None.
            stamp: ROS time of the command [ns]; zero for the newest transform. If the transform at the stamp is not
                known yet, the newest one is used if it is at most `max_age` older.
            max_age: time [ns].

        Raises:
            FrameError: if the name is invalid in tf2, or no transform connects the frames.
        """
        if frame_id in ("", self._frame_id):
            return position, orientation
        if words := fault(frame_id):
            raise FrameError(f"its frame_id is {frame_id!r}; {words}")
        try:
            translation, rotation = self._lookup(frame_id, stamp)
        except FrameError:
            if not stamp:
                raise
            translation, rotation = self._lookup(frame_id, 0)
            if not 0 < stamp - self._transform_stamp <= max_age:
                raise
        new_position = rotation_matrix(rotation) @ np.asarray(position) + translation
        new_orientation = (
            None if orientation is None else quaternion_product(rotation.tolist(), normalized(orientation).tolist())
        )
        return tuple(new_position.tolist()), new_orientation

    def newest(self, frame_id: str) -> tuple[tuple[float, ...], tuple[float, ...], int]:
        """Return a frame's newest position [m], orientation x, y, z, w and stamp [ns] in the cloth's, or FrameError.

        Raises:
            FrameError: if no transform connects the frames.
        """
        if (pose := self.link_pose(frame_id)) is not None:
            return pose
        translation, rotation = self._lookup(frame_id, 0)
        return tuple(translation.tolist()), tuple(rotation.tolist()), self._transform_stamp

    def listen(self, frame_id: str) -> None:
        """Subscribe to /tf, unless a frame is a robot's link; without tf2_ros it has no effect."""
        if self.link_pose(frame_id) is None:
            with suppress(Tf2MissingError):
                self._start_listener(frame_id)

    def advance_time(self, now: int) -> None:
        """Clear the dynamic transforms if a ROS time [ns] is before that of the previous call."""
        if now < self._time:
            self.clear()
        self._time = now

    def clear(self) -> None:
        """Clear the dynamic transforms, because the clock was set back; static ones stay."""
        if self._buffer is not None:
            self._buffer.clear()

    def _lookup(self, frame_id: str, stamp: int) -> tuple[np.ndarray, np.ndarray]:
        self._start_listener(frame_id)
        try:
            answer = self._buffer.lookup_transform(self._frame_id, frame_id, Time(nanoseconds=stamp))
        except self._tf2.TransformException as error:
            raise FrameError(
                f"no transform from '{frame_id}' to the cloth's frame '{self._frame_id}': {error}"
            ) from error
        self._transform_stamp = read_stamp(answer.header.stamp)
        t, r = answer.transform.translation, answer.transform.rotation
        translation = np.array([t.x, t.y, t.z])
        try:
            rotation = normalized([r.x, r.y, r.z, r.w])
        except ValueError as error:
            raise FrameError(f"the transform from '{frame_id}' is invalid: {error}") from error
        if not np.isfinite(translation).all():
            raise FrameError(f"the transform from '{frame_id}' is invalid: {translation.tolist()} m must be finite")
        return translation, rotation

    def _start_listener(self, frame_id: str) -> None:
        if self._buffer is not None:
            return
        if not self._is_tf2_missing:
            try:
                import tf2_ros
            except ImportError:
                self._is_tf2_missing = True
        if self._is_tf2_missing:
            raise Tf2MissingError(
                f"'{frame_id}' is not the cloth's frame '{self._frame_id}', and tf2_ros, which would transform it, is "
                f"not installed: sudo apt install ros-jazzy-tf2-ros-py, or give poses in '{self._frame_id}'"
            )
        self._tf2, self._buffer = tf2_ros, tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, self._node)


def coming_obstacles(values: Mapping[str, Any], scene: Scene) -> list[str]:
    """Return the obstacles that a scene does not have, in the parameter `obstacles` among values to be set."""
    obstacles = values.get("obstacles")
    # Other types are refused later.
    return [name for name in obstacles if name not in scene.obstacles] if isinstance(obstacles, list) else []


class TfFollower:
    """Source of targets at followed TF frames; also opens grippers without commands after `gripper.timeout`.

    Args:
        simulation: the cloth.
        frames: looks up TF frames.
        last_target_time: returns the ROS time of a gripper's newest target [ns], or None.
        log: receives losses, recoveries and timeouts.
    """

    def __init__(
        self,
        simulation: Simulation,
        frames: FrameTransformer,
        last_target_time: Callable[[str], int | None],
        log: ThrottledLog,
    ) -> None:
        self._simulation, self._frames, self._last_target_time, self._log = simulation, frames, last_target_time, log
        #: Newest followed frame and its position, orientation and stamp, by gripper or obstacle.
        self._last_transforms: dict[str, tuple[Any, ...]] = {}
        #: Grippers and obstacles whose target was sent since the last reset or change of parameters.
        self._sent: set[str] = set()
        #: ROS time of the last new transform of a followed frame [ns], by gripper or obstacle.
        self._last_motion: dict[str, int] = {}
        #: Obstacles that follow a TF frame, and their frames, in the newest scene.
        self._obstacle_frames: list[tuple[str, str]] = []
        self._scene: Scene | None = None
        #: ROS time of the last warning of a frame that can't be followed [ns], by gripper or obstacle.
        self._last_warnings: dict[str, int] = {}
        #: ROS time of the last frame in which the cloth was paused [ns]; 0 before the first.
        self._pause_end = 0

    def events(self, now: int) -> list[Event]:
        """Return targets at followed TF frames that moved, and openings of silent grippers, at a ROS time [ns]."""
        scene = self._simulation.scene
        events: list[Event] = []
        self._update_obstacle_frames()
        for name, frame in self._obstacle_frames:
            events += self._follow_frame(Move, name, frame, now)
        if not scene.gripper.timeout and not scene.gripper.frame and not scene.individual:
            return events
        for index, name in enumerate(scene.gripper_names):
            events += self._follow_frame(Target, name, scene.of_gripper(name, "frame").replace("{gripper}", name), now)
            events += self._release_if_silent(scene, index, name, now)
        return events

    def observe(self, frame: Frame) -> None:
        """Let `events` send all targets again after a reset or changed parameters: static transforms have one stamp."""
        if frame.events and any(isinstance(event, Reset | SetParameters) for event in frame.events):
            self._sent.clear()

    def obstacle_poses(self, scene: Scene) -> dict[str, tuple[float, ...]]:
        """Return the newest pose of each obstacle of a scene that follows a TF frame by name, 7 numbers.

        A frame that TF has lost has its last pose since the clock was set back. Without one its obstacle is missing.
        """
        poses = dict[str, tuple[float, ...]]()
        for name in scene.obstacle_names:
            frame, last = scene.described[name].frame, self._last_transforms.get(name)
            if not frame:
                continue
            try:
                position, orientation, _ = self._frames.newest(frame)
                poses[name] = (*position, *orientation)
            except FrameError:
                if last is not None and last[0] == frame:
                    poses[name] = (*last[1], *last[2])
        return poses

    def listen(self, scene: Scene) -> None:
        """Subscribe to TF if a described obstacle follows a frame: `start_poses` needs it once the obstacle comes."""
        for frame in [scene.described[name].frame for name in scene.unlinked_names]:
            if frame:
                self._frames.listen(frame)

    def start_poses(self, values: Mapping[str, Any], scene: Scene) -> dict[str, tuple[float, ...]]:
        """Return `<obstacle>.position` and `.orientation` of coming obstacles that follow TF frames: the frames' poses.

        Without tf2_ros the result is empty; `events` logs the reason.

        Args:
            values: parameters to be set, by full name.
            scene: the scene before.

        Raises:
            FrameError: if a frame is not known.
        """
        poses = dict[str, tuple[float, ...]]()
        for name in coming_obstacles(values, scene):
            present = scene.described[name].frame if name in scene.described else ""
            frame = values.get(f"{name}.frame", present)
            # Invalid names of frames are refused later.
            if not isinstance(frame, str) or not frame or fault(frame):
                continue
            try:
                position, orientation, _ = self._frames.newest(frame)
            except Tf2MissingError:
                return {}
            except FrameError as error:
                raise FrameError(
                    f"obstacle '{name}' starts at TF frame '{frame}' ({name}.frame), which is not known: {error}; "
                    "start its publisher, then set obstacles again"
                ) from error
            poses |= {f"{name}.position": position, f"{name}.orientation": orientation}
        return poses

    def restart_time(self) -> None:
        """Forget the newest transforms and the last pause, because the clock was set back."""
        self._last_transforms.clear()
        self._pause_end = 0

    def _update_obstacle_frames(self) -> None:
        scene = self._simulation.scene
        if scene is not self._scene:
            self._scene = scene
            frames = [(name, scene.described[name].frame) for name in scene.obstacle_names]
            self._obstacle_frames = [(name, frame) for name, frame in frames if frame]

    def _follow_frame(self, kind: type[Target | Move], name: str, frame: str, now: int) -> list[Event]:
        if not frame:
            return []
        try:
            position, orientation, stamp = self._frames.newest(frame)
            transform = frame, position, orientation, stamp
            is_new = transform != self._last_transforms.get(name)
            if not is_new:
                self._report_silence(name, frame, stamp, now)
            if not is_new and name in self._sent:
                return []
            target = kind(name, position, orientation)
            self._simulation.check(target)
        except (FrameError, EventError) as error:
            self._warn(name, f"'{name}' can't follow frame '{frame}': {error}", now)
            return []
        if self._last_warnings.pop(name, None) is not None:
            self._log.info(f"found {name}", f"'{name}' follows frame '{frame}'")
        self._sent.add(name)
        if is_new:
            self._last_transforms[name] = transform
            self._last_motion[name] = now
        return [target]

    def _report_silence(self, name: str, frame: str, stamp: int, now: int) -> None:
        """Log once a minute that a moving frame has no new transform for a second; static ones have the stamp 0."""
        # A robot's follower reports the silence of joint states.
        if not stamp or now - self._last_motion.get(name, now) <= _SILENCE or self._frames.link_pose(frame) is not None:
            return
        if self._should_warn(f"silent {name}", now):
            self._log.warn(f"stands {name}", f"no new transform of frame '{frame}' has come for 1 s: '{name}' stands")

    def _warn(self, name: str, text: str, now: int) -> None:
        """Log a warning that a followed frame is lost: at once, then once a minute."""
        if self._should_warn(name, now):
            self._log.warn(f"follow {name}", text)

    def _should_warn(self, key: str, now: int) -> bool:
        """Return True, and remember it, if no warning with a key came within a minute."""
        last = self._last_warnings.get(key)
        # The clock may have been set back since.
        should_warn = last is None or not 0 <= now - last < _WARNING_PERIOD
        if should_warn:
            self._last_warnings[key] = now
        return should_warn

    def _release_if_silent(self, scene: Scene, index: int, name: str, now: int) -> list[Event]:
        if name in self._last_motion:
            # The clock may have been set back since.
            self._last_motion[name] = min(self._last_motion[name], now)
        times = (self._last_target_time(name), self._last_motion.get(name))
        latest = max((time for time in times if time is not None), default=None)
        # Clients of a paused cloth may wait until time passes again: silence counts from then on.
        self._pause_end = now if self._simulation.paused else min(self._pause_end, now)
        if not scene.gripper.timeout or latest is None or not self._simulation.grippers.is_closed(index):
            return []
        silence = (now - max(latest, self._pause_end)) * 1e-9
        if silence <= scene.gripper.timeout:
            return []
        self._log.warn(f"silent {name}", f"'{name}' lets go: no target has come for {silence:.2f} s (gripper.timeout)")
        return [Grasp(name, False)]
