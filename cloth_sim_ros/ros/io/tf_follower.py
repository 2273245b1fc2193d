# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TF following and command timeout of grippers and obstacles."""

from __future__ import annotations

from collections.abc import Callable

from cloth_sim_ros.ros.io.tf_frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: Period of the warnings of a frame that can't be followed [ns].
_WARNING_PERIOD = 60_000_000_000


class TfFollower:
    """Makes grippers and obstacles follow TF frames, and opens grippers without commands after `gripper.timeout`.

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
        self._last_stamps: dict[str, int] = {}
        #: ROS time of the last new transform of a followed frame [ns], by gripper or obstacle.
        self._last_motion: dict[str, int] = {}
        #: ROS time of the last warning of a frame that can't be followed [ns], by gripper or obstacle.
        self._last_warnings: dict[str, int] = {}

    def events(self, now: int) -> list[Event]:
        """Return the events for the simulation frame due at a ROS time [ns]."""
        scene = self._simulation.scene
        events: list[Event] = []
        for name in scene.obstacle_names:
            events += self._follow_frame(Move, name, scene.described[name].frame, now)
        if not scene.gripper.timeout and not scene.gripper.frame and not scene.individual:
            return events
        for index, name in enumerate(scene.gripper_names):
            events += self._follow_frame(Target, name, scene.of_gripper(name, "frame").replace("{gripper}", name), now)
            events += self._release_if_silent(scene, index, name, now)
        return events

    def _follow_frame(self, kind: type[Target | Move], name: str, frame: str, now: int) -> list[Event]:
        if not frame:
            return []
        try:
            position, orientation, stamp = self._frames.newest(frame)
            if stamp == self._last_stamps.get(name):
                return []
            target = kind(name, position, orientation)
            self._simulation.check(target)
        except (FrameError, EventError) as error:
            self._warn(name, f"'{name}' can't follow frame '{frame}': {error}", now)
            return []
        if self._last_warnings.pop(name, None) is not None:
            self._log.info(f"found {name}", f"'{name}' follows frame '{frame}'")
        self._last_stamps[name] = stamp
        self._last_motion[name] = now
        return [target]

    def _warn(self, name: str, text: str, now: int) -> None:
        """Warn when a frame is lost, and once a minute while it is."""
        last = self._last_warnings.get(name)
        # The clock may have been set back since.
        if last is None or not 0 <= now - last < _WARNING_PERIOD:
            self._last_warnings[name] = now
            self._log.warn(f"follow {name}", text)

    def _release_if_silent(self, scene: Scene, index: int, name: str, now: int) -> list[Event]:
        if name in self._last_motion:
            # The clock may have been set back since.
            self._last_motion[name] = min(self._last_motion[name], now)
        times = (self._last_target_time(name), self._last_motion.get(name))
        latest = max((time for time in times if time is not None), default=None)
        if not scene.gripper.timeout or latest is None or not self._simulation.grippers.is_closed(index):
            return []
        silence = (now - latest) * 1e-9
        if silence <= scene.gripper.timeout:
            return []
        self._log.warn(f"silent {name}", f"'{name}' lets go: no target has come for {silence:.2f} s (gripper.timeout)")
        return [Grasp(name, False)]
