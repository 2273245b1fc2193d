# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""TF following and command timeout of grippers and obstacles."""

from __future__ import annotations

from collections.abc import Callable

from cloth_sim_ros.ros.frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: Period of the warnings of a frame that can't be followed [ns].
_LOST_PERIOD = 60_000_000_000


class Companions:
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
        heard: Callable[[str], int | None],
        log: ThrottledLog,
    ) -> None:
        self._simulation = simulation
        self._frames = frames
        self._heard = heard
        self._log = log
        self._followed: dict[str, int] = {}
        #: ROS time of the last new transform of a followed frame [ns], by gripper or obstacle.
        self._moved: dict[str, int] = {}
        #: ROS time of the last warning of a frame that can't be followed [ns], by gripper or obstacle.
        self._lost: dict[str, int] = {}

    def events(self, now: int) -> list[Event]:
        """Return the events for the simulation frame due at a ROS time [ns]."""
        scene = self._simulation.scene
        found: list[Event] = []
        for name in scene.obstacle_names:
            found += self._follow(Move, name, scene.described[name].frame, now)
        if not scene.gripper.timeout and not scene.gripper.frame and not scene.individual:
            return found
        for index, name in enumerate(scene.gripper_names):
            found += self._follow(Target, name, scene.of_gripper(name, "frame").replace("{gripper}", name), now)
            found += self._let_go(scene, index, name, now)
        return found

    def _follow(self, kind: type[Target | Move], name: str, frame: str, now: int) -> list[Event]:
        if not frame:
            return []
        try:
            position, orientation, stamp = self._frames.newest(frame)
            if stamp == self._followed.get(name):
                return []
            target = kind(name, position, orientation)
            self._simulation.check(target)
        except (FrameError, EventError) as error:
            self._tell_lost(name, f"'{name}' can't follow frame '{frame}': {error}", now)
            return []
        if self._lost.pop(name, None) is not None:
            self._log.info(f"found {name}", f"'{name}' follows frame '{frame}'")
        self._followed[name] = stamp
        self._moved[name] = now
        return [target]

    def _tell_lost(self, name: str, words: str, now: int) -> None:
        """Warn when a frame is lost, and once a minute while it is."""
        told = self._lost.get(name)
        # The clock may have been set back since.
        if told is None or not 0 <= now - told < _LOST_PERIOD:
            self._lost[name] = now
            self._log.warn(f"follow {name}", words)

    def _let_go(self, scene: Scene, index: int, name: str, now: int) -> list[Event]:
        if name in self._moved:
            # The clock may have been set back since.
            self._moved[name] = min(self._moved[name], now)
        heard = max((time for time in (self._heard(name), self._moved.get(name)) if time is not None), default=None)
        if not scene.gripper.timeout or heard is None or not self._simulation.grippers.is_closed(index):
            return []
        silent = (now - heard) * 1e-9
        if silent <= scene.gripper.timeout:
            return []
        self._log.warn(f"silent {name}", f"'{name}' lets go: no target has come for {silent:.2f} s (gripper.timeout)")
        return [Grasp(name, False)]
