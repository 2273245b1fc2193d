# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of a cloth that is thrown away: they compile, or load, what live ones will need."""

from __future__ import annotations

from cloth_sim_ros.events import Grasp, Target
from cloth_sim_ros.physics.integrators.base import StepLimitError, UnstableError
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation


def rehearse(scene: Scene) -> None:
    """Run what has code of its own: frames without a gripper, with one that holds, with one that turns meanwhile.

    Grasping restarts the error control: each time it tries all that it may choose from later.

    Raises:
        StepLimitError: if the scene's fixed step is above its limit.
    """
    trial = Simulation(scene)
    names = scene.gripper_names[:1]
    place = tuple(trial.positions[-1].tolist())
    try:
        trial.advance()
        for orientation in (None, (0.0, 0.0, 0.01, 1.0)):
            trial.advance([event for name in names for event in (Target(name, place, orientation), Grasp(name, True))])
        trial.rests()
    except StepLimitError:
        raise
    except UnstableError:
        # It is told when it comes to its frame: there it stops time, not the node.
        return
    trial.state.digest()
