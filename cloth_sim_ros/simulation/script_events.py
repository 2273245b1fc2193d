# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Events of scripted grasps, frame by frame, without node or clock."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from numpy.typing import ArrayLike

from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError


class ScriptEvents:
    """Events, frame by frame, of scripts that start together at time 0.

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
        """Return the events of the frame that starts at index `frame`, each once; call it for the frames in order.

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


def pose_scripts(
    names: Sequence[str], times: ArrayLike, poses: ArrayLike | Mapping[str, ArrayLike], closed: Any
) -> list[GripperScript]:
    """Build a script for each gripper from arrays, the arguments of `Simulation.play`; raise ScriptError.

    Args:
        names: names of the scene's grippers.
        times: as for `Simulation.play`, and so are the others.
        poses: of the only gripper, or by gripper.
        closed: for the only gripper, for all, or by gripper.

    Raises:
        ScriptError: as `GripperScript.from_poses`, and for a gripper that the scene does not have.
    """
    if not isinstance(poses, Mapping):
        if len(names) != 1:
            raise ScriptError(f"the scene has {len(names)} grippers; give poses by name: {{name: poses}}")
        poses = {names[0]: poses}
    if not poses:
        raise ScriptError("poses name no gripper; give the poses of at least one")
    by_name = closed if isinstance(closed, Mapping) else dict.fromkeys(poses, closed)
    for name in (*poses, *by_name):
        if name not in names:
            raise ScriptError(f"the scene has no gripper '{name}'; it has {', '.join(names) or 'none'}")
    for name in by_name:
        if name not in poses:
            raise ScriptError(f"closed names the gripper '{name}', which has no poses; give its poses too")
    return [
        GripperScript.from_poses(times, rows, gripper=name, closed=by_name.get(name)) for name, rows in poses.items()
    ]


def frame_events(scripts: Sequence[GripperScript], period: float) -> Iterator[list[Event]]:
    """Yield the events of each frame in which scripts move their grippers, from their first to their last poses.

    The first frame moves the grippers to their first poses. The scripts begin at its end.
    """
    yield [Target(script.gripper, *script.pose(0.0)) for script in scripts]
    events = ScriptEvents(scripts, period)
    # A grasp at the last pose takes one more frame.
    ends = [script.waypoints[-1].time for script in scripts]
    ends += [grasp.time + period for script in scripts for grasp in script.grasps]
    for frame in range(math.ceil(max(ends) / period - 1e-9)):
        yield events.at(frame)
