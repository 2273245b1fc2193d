# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles of a simulation: their poses and targets, kept as named arrays of the state, and where they touch at once.

A target is followed as fast as `MOST_SPEED` lets: an obstacle never jumps, so that none jumps through the cloth.
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

#: Of an obstacle that is larger, or a plane, the speed of turning counts at this distance from its origin [m].
_MOST_ARM = 1.0
_KIND = "obstacle"


class Obstacles:
    """The obstacles of one simulation; all that changes lies in ``state.memory``.

    Args:
        solids: their shapes; the order is that of every array.
        described: where they start, by name.
        state: the state that keeps their poses; entries that it lacks are added.
    """

    #: Fastest that a surface follows its target, mean over a frame [m/s].
    speed = MOST_SPEED

    def __init__(self, solids: list[Obstacle], described: Mapping[str, sections.Obstacle], state: State) -> None:
        self.solids = solids
        self.names = [solid.name for solid in solids]
        self._state = state
        self._movers = Movers(_KIND, np.array([_start(described[name]) for name in self.names]), state)

    def poses(self) -> Array:
        """Present poses: position [m] and quaternion x, y, z, w, shape (obstacle_count, 7)."""
        return self._movers.array("pose").copy()

    @property
    def settled(self) -> bool:
        """Whether every obstacle stands at its target, and stood there for a frame."""
        return self._movers.settled

    @property
    def behind(self) -> list[str]:
        """Names of the obstacles that are not where they were commanded to be: they follow at MOST_SPEED."""
        away = (self._movers.array("pose") != self._movers.array("target")).any(axis=1)
        return [name for name, far in zip(self.names, away.tolist(), strict=True) if far]

    def set_target(self, event: Move) -> None:
        """Take note of a target."""
        self._movers.aim(self.names.index(event.obstacle), event.position, event.orientation)

    def halt(self) -> list[str]:
        """Let all stand still where they are, until they are commanded anew; return the names of those that moved."""
        return [self.names[k] for k in self._movers.halt(range(len(self.names)))]

    def plan_frame(self, t: float, duration: float) -> tuple[Array, float]:
        """Return each obstacle's path over a frame that starts at time t [s], shape (count, PATH_NUMBERS), and by how
        much the way of one over it differs from that over the frame before [m], at most, along an axis.
        """
        paths, changes = self._movers.paths(t, duration, functools.partial(self._within, duration))
        return paths, max(changes)

    def standing(self, t: float) -> Array:
        """Return the paths of obstacles that stand where they are, from time t [s] on, shape (count, PATH_NUMBERS)."""
        return standing(t, self._movers.array("pose"))

    def nearest(self, name: str) -> tuple[float, int]:
        """Return the gap [m], negative inside, between an obstacle and the nearest particle, and its number."""
        k = self.names.index(name)
        gap = gaps(self.solids[k], self._movers.array("pose")[k], self._state.x)
        particle = int(np.argmin(gap))
        return float(gap[particle]), particle

    def check_outside(self, names: Iterable[str], anchored: Collection[int]) -> None:
        """Refuse a cloth that is inside obstacles; anchored particles, which nothing pushes, may be.

        Raises:
            ValueError: naming the obstacle, the particle that is deepest inside, and how deep; the end of a sentence.
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
                    f"{-gap[particle]:.4g} m deep; move the one or the other"
                )

    def _within(self, duration: float, k: int, pose: Sequence[float], target: Sequence[float]) -> Sequence[float]:
        """Where an obstacle is at a frame's end: at its target, or as near to it as its speed lets."""
        return within(pose, target, min(self.solids[k].reach, _MOST_ARM), MOST_SPEED * duration)


def rearrange(state: State, before: list[str], now: list[str], described: Mapping[str, sections.Obstacle]) -> None:
    """Let a state's memory be that of other obstacles: those that stay keep pose and motion.

    Args:
        state: whose memory; one that knows no obstacles is left as it is.
        before: names of those that it knows.
        now: names of those that are to be there.
        described: where new ones start, by name.
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
    """Return how far particles at x [m], (3, n), are outside an obstacle at a pose, shape (n,).

    Those further than `within` [m] from its bounding sphere are told the distance from that, which is no more.
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
    """Pose with which an obstacle starts, shape (7,)."""
    return np.concatenate([np.asarray(description.position, dtype=np.float64), normalised(description.orientation)])
