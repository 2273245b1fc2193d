# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles of a simulation: poses, targets and gaps to particles.

An obstacle follows its target at `MAX_BODY_SPEED` at most. Therefore it never jumps through the cloth.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import normalised, rotation_matrix
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene import sections
from cloth_sim_ros.simulation.events import Move
from cloth_sim_ros.simulation.movers import MOST_SPEED, Movers, standing, within

#: Largest lever arm of rotation for the speed limit [m]; it applies to larger obstacles and planes.
_MOST_ARM = 1.0
_KIND = "obstacle"


class Obstacles:
    """Obstacles of one simulation. Everything that changes is in ``state.memory``.

    Args:
        solids: shapes of the obstacles; their order is that of every array.
        descriptions: parameters of the obstacles, by name; they give the initial poses.
        state: keeps the poses; missing entries are added.
    """

    #: Speed limit of surfaces, mean over a frame [m/s].
    speed = MOST_SPEED

    def __init__(self, solids: list[Obstacle], described: Mapping[str, sections.Obstacle], state: State) -> None:
        self.solids = solids
        self.names = [solid.name for solid in solids]
        self._state = state
        self._movers = Movers(_KIND, np.array([_start(described[name]) for name in self.names]), state)

    def poses(self) -> Array:
        """Return present poses: position [m] and quaternion x, y, z, w, shape (obstacle_count, 7)."""
        return self._movers.array("pose").copy()

    @property
    def settled(self) -> bool:
        """True if every obstacle is at its target and was there for a whole frame."""
        return self._movers.settled

    @property
    def behind(self) -> list[str]:
        """Names of the obstacles that have not reached their target yet."""
        away = (self._movers.array("pose") != self._movers.array("target")).any(axis=1)
        return [name for name, far in zip(self.names, away.tolist(), strict=True) if far]

    def set_target(self, event: Move) -> None:
        """Store a target."""
        self._movers.aim(self.names.index(event.obstacle), event.position, event.orientation)

    def halt(self) -> list[str]:
        """Hold the present poses until the next targets; return the names of the obstacles that moved."""
        return [self.names[k] for k in self._movers.halt(range(len(self.names)))]

    def plan_frame(self, t: float, duration: float) -> tuple[Array, float]:
        """Return the paths over a frame that starts at time t [s], and the largest change of displacement.

        Args:
            t: time at which the frame starts [s].
            duration: length of the frame [s].

        Returns:
            Paths, shape (count, PATH_NUMBERS), and the largest change of an obstacle's displacement from the frame
            before, along an axis [m].
        """
        paths, changes = self._movers.paths(t, duration, functools.partial(self._within, duration))
        return paths, max(changes)

    def standing(self, t: float) -> Array:
        """Return the paths of obstacles at rest at their poses from time t [s] on, shape (count, PATH_NUMBERS)."""
        return standing(t, self._movers.array("pose"))

    def nearest(self, name: str) -> tuple[float, int]:
        """Return the gap [m], negative inside, of an obstacle to its nearest particle, and that particle's index."""
        k = self.names.index(name)
        gap = gaps(self.solids[k], self._movers.array("pose")[k], self._state.x)
        particle = int(np.argmin(gap))
        return float(gap[particle]), particle

    def check_outside(self, names: Iterable[str], anchored: Collection[int]) -> None:
        """Refuse a cloth with a free particle inside named obstacles. Anchored particles may be inside.

        Raises:
            ValueError: naming the obstacle, the deepest particle and its depth; the end of a sentence.
        """
        held = list(anchored)
        for name in names:
            k = self.names.index(name)
            gap = gaps(self.solids[k], self._movers.array("pose")[k], self._state.x, within=0.0)
            gap[held] = math.inf
            particle = int(np.argmin(gap))
            if gap[particle] <= 0.0:
                where = self._state.x[:, particle].tolist()
                raise ValueError(
                    f"is inside obstacle '{name}': particle {particle} at {[round(c, 6) for c in where]} is "
                    f"{-gap[particle]:.4g} m deep; move one of them"
                )

    def _within(self, duration: float, k: int, pose: Sequence[float], target: Sequence[float]) -> Sequence[float]:
        """Return an obstacle's pose at a frame's end: its target, or as close to it as the speed limit permits."""
        return within(pose, target, min(self.solids[k].reach, _MOST_ARM), MOST_SPEED * duration)


def rearrange(state: State, before: list[str], now: list[str], described: Mapping[str, sections.Obstacle]) -> None:
    """Replace the obstacles in a state's memory. Obstacles that remain keep pose and motion.

    Args:
        state: the state; without obstacles in memory it stays unchanged.
        names_before: names of the obstacles in memory.
        names_after: names of the new obstacles.
        descriptions: parameters of the obstacles, by name; they give the initial poses.
    """
    state.memory = dict(state.memory)
    names = [f"{_KIND}.{what}" for what in ("pose", "twist", "turn", "target")]
    known = {name: state.memory.pop(name) for name in names if name in state.memory}
    if not known or not now:
        return
    for name, array in known.items():
        rows = np.zeros((len(now), array.shape[1]))
        for k, obstacle in enumerate(now):
            if obstacle in before:
                rows[k] = array[before.index(obstacle)]
            elif array.shape[1] == 7:
                rows[k] = _start(described[obstacle])
        state.memory[name] = rows


def gaps(solid: Obstacle, pose: Array, x: Array, *, within: float = math.inf) -> Array:
    """Return the distances [m] of particles at x [m], (3, n), from an obstacle's surface, shape (n,); negative inside.

    Beyond `max_distance` [m] from the bounding sphere the distance from that sphere is returned, a lower bound.
    """
    away = x - pose[:3, None]
    found: Array = np.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2]) - solid.reach
    near = np.flatnonzero(found <= within)
    turn = rotation_matrix(pose[3:])
    x_, y_, z_ = away[:, near]
    own = np.stack([turn[0, i] * x_ + turn[1, i] * y_ + turn[2, i] * z_ for i in range(3)], axis=1)
    found[near] = solid.distance(own)[0]
    return found


def _start(description: sections.Obstacle) -> Array:
    """Return the initial pose of an obstacle, shape (7,)."""
    return np.concatenate([np.asarray(description.position, dtype=np.float64), normalised(description.orientation)])
