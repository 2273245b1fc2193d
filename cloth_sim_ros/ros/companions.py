# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What grippers and obstacles do by themselves: follow a TF frame; a gripper lets go when its commands fall silent."""

from __future__ import annotations

from collections.abc import Callable

from cloth_sim_ros.ros.frames import FrameError, FrameTransformer
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: A frame that can't be followed is told of again after so long [ns].
_LOST_PERIOD = 60_000_000_000


class Companions:
    """Adds events of its own before a frame.

    Args:
        simulation: the cloth.
        frames: looks frames up.
        heard: when a gripper's newest target came, ROS time [ns], or None.
        log: says what happened.
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
        #: When the frame that a gripper follows was last seen to move on, ROS time [ns].
        self._moved: dict[str, int] = {}
        #: When it was last told that what follows a frame can't, ROS time [ns].
        self._lost: dict[str, int] = {}

    def events(self, now: int) -> list[Event]:
        """Return the events of a frame that is due at a ROS time [ns]."""
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
        """Warn when a frame gets lost, and now and then while it is."""
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
