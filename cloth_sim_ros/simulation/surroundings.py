# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The obstacles of a scene and a state, where there are any: a cloth without obstacles loads nothing of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

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
    """Let the obstacles in states be those of another scene."""
    if before.obstacles == scene.obstacles:
        return
    from cloth_sim_ros.simulation.obstacles import rearrange

    for state in states:
        rearrange(state, before.obstacle_names, scene.obstacle_names, scene.described)
