# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Events of scripted grasps, frame by frame, without node or clock."""

from __future__ import annotations

from collections.abc import Sequence

from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.gripper_script import GripperScript


class ScriptEvents:
    """Events of scripts that start together at time 0.

    A frame's target is the script's pose at the frame's end. A grasp takes effect in the first frame that starts at its
    time or later.

    Args:
        scripts: one for each gripper.
        period: simulated time of one frame [s].
    """

    def __init__(self, scripts: Sequence[GripperScript], period: float) -> None:
        self._scripts = scripts
        self._period = period
        self._pending = [list(script.grasps) for script in scripts]
        self._last_targets: list[Event | None] = [None] * len(scripts)

    def at(self, frame: int) -> list[Event]:
        """Return the events of the frame that ends with index `frame` + 1. Call it for the frames in order.

        A target equal to the last one is left out, so that a cloth can fall asleep.
        """
        events: list[Event] = []
        for index, script in enumerate(self._scripts):
            target = Target(script.gripper, *script.pose((frame + 1) * self._period))
            if target != self._last_targets[index]:
                self._last_targets[index] = target
                events.append(target)
            pending = self._pending[index]
            while pending and pending[0].time <= frame * self._period + 1e-9:
                events.append(Grasp(script.gripper, pending.pop(0).closed))
        return events
