# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The obstacles of a scene and a state, where there are any: a cloth without obstacles loads nothing of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.remembered import ANCHORS
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.obstacles import Obstacles


def obstacles_of(scene: Scene, state: State) -> Obstacles | None:
    """Return the obstacles of a scene with a state's poses; None where there are none.

    Raises:
        ValueError: for a state of another number of obstacles.
    """
    if not scene.obstacle_names:
        return None
    from cloth_sim_ros.simulation.obstacles import Obstacles

    obstacles = Obstacles(scene.solids, scene.described, state)
    known = len(state.memory["obstacle.pose"])
    if known != len(obstacles.names):
        raise ValueError(
            f"the state has {known} obstacles, the scene {len(obstacles.names)} ({', '.join(obstacles.names)})"
        )
    return obstacles


def change_obstacles(before: Scene, scene: Scene, states: Iterable[State]) -> None:
    """Let the obstacles in states, and the anchors of their friction, be those of another scene."""
    for state in states:
        if before.obstacles != scene.obstacles:
            from cloth_sim_ros.simulation.obstacles import rearrange

            rearrange(state, before.obstacle_names, scene.obstacle_names, scene.described)
        if ANCHORS in state.memory:
            memory = dict(state.memory)
            anchors = kept_anchors(memory.pop(ANCHORS), before, scene)
            state.memory = memory if anchors is None else {**memory, ANCHORS: anchors}


def kept_anchors(anchors: Array, before: Scene, scene: Scene) -> Array | None:
    """Return what anchors of friction become when another scene's obstacles take the place of a scene's.

    Obstacles that stay keep theirs; those that come have touched nothing yet. None where no obstacle has friction:
    nothing is held then, and where there is friction again it begins anew.
    """
    if not any(solid.friction[0] > 0.0 for solid in scene.solids):
        return None
    names, now = before.obstacle_names, scene.obstacle_names
    kept = np.zeros((len(now), *anchors.shape[1:]))
    for k, name in enumerate(now):
        if name in names:
            kept[k] = anchors[names.index(name)]
    return kept
