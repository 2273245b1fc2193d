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
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import power
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, to_body_frame
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene import sections
from cloth_sim_ros.simulation.bodies.kinematic_bodies import (
    MAX_BODY_SPEED,
    KinematicBodies,
    clamp_motion,
    constant_paths,
)
from cloth_sim_ros.simulation.events import Move, MoveObstacles, Reset

#: Largest lever arm of rotation for the speed limit [m]; it applies to larger obstacles and planes.
_MAX_LEVER_ARM = 1.0
#: Fraction of the speed limit up to which the bound of a motion needs no exact travel.
_BOUND_MARGIN = 0.999
_KIND = "obstacle"


class Obstacles:
    """Obstacles of one simulation: their shapes, and poses and targets, which are kept in ``state.memory``.

    Args:
        solids: shapes of the obstacles; their order is that of every array.
        descriptions: parameters of the obstacles, by name; they give the initial poses.
        state: keeps the poses; missing entries are added.
    """

    #: Speed limit of surfaces, mean over a frame [m/s].
    speed = MAX_BODY_SPEED

    def __init__(
        self, solids: list[Obstacle], descriptions: Mapping[str, sections.ObstacleParameters], state: State
    ) -> None:
        self.solids = solids
        self.names = [solid.name for solid in solids]
        self._indices = {name: k for k, name in enumerate(self.names)}
        #: Lever arm of each obstacle's rotation for the speed limit [m].
        self._lever_arms = np.array([min(solid.bounding_radius, _MAX_LEVER_ARM) for solid in solids])
        #: True for each obstacle that is a link of a robot, and indices of the others.
        self._is_link = np.array([bool(descriptions[name].link) for name in self.names])
        self.unlinked_indices = np.flatnonzero(~self._is_link).tolist()
        self._radii = np.array([solid.bounding_radius for solid in solids])
        self._state = state
        self._bodies = KinematicBodies(_KIND, np.array([_start_pose(descriptions[name]) for name in self.names]), state)

    def poses(self) -> Array:
        """Return a copy of present poses: position [m] and quaternion x, y, z, w, shape (obstacle_count, 7)."""
        return self._bodies.array("pose").copy()

    @property
    def is_at_rest(self) -> bool:
        """True if every obstacle is at its target and was there for a whole frame."""
        return self._bodies.is_at_rest

    @property
    def lagging(self) -> list[str]:
        """Names of the obstacles that have not reached their target yet."""
        is_away = (self._bodies.array("pose") != self._bodies.array("target")).any(axis=1)
        return [self.names[k] for k in np.flatnonzero(is_away).tolist()]

    def set_target(self, event: Move) -> None:
        """Store the target pose of the obstacle that an event names; `move` follows it."""
        self._bodies.set_target(self.names.index(event.obstacle), event.position, event.orientation)

    def set_targets(self, event: MoveObstacles) -> None:
        """Store the target poses of the obstacles that an event names; `move` follows them."""
        self._bodies.set_targets([self._indices[name] for name in event.obstacles], event.poses)

    def set_poses(self, event: Reset) -> None:
        """Place the obstacles that a reset names at rest at its poses."""
        if event.obstacles:
            self._bodies.set_poses([self._indices[name] for name in event.obstacles], np.array(event.poses))

    def hold_position(self) -> list[str]:
        """Hold the present poses until the next targets; return the names of the obstacles that were moving."""
        return [self.names[k] for k in self._bodies.hold_position(range(len(self.names)))]

    def move(self, t: float, duration: float, thickness: float) -> tuple[Array, float, NDArray[np.bool_] | None]:
        """Move the obstacles over a frame; return paths, largest change of displacement [m], links out of reach.

        Args:
            t: time at which the frame starts [s].
            duration: length of the frame [s].
            thickness: of contact [m].

        Returns:
            Paths, shape (count, PATH_NUMBERS). The largest change of an obstacle's displacement from the frame before,
            along an axis [m]. True for each link of a robot that cannot touch the cloth in the frame, shape (count,);
            None without links.
        """
        end_pose = functools.partial(self._end_pose, duration) if self._may_be_too_fast(duration) else None
        paths, changes = self._bodies.move(t, duration, end_pose)
        if not self._is_link.any():
            return paths, max(changes), None
        is_away = self._is_link & self._are_away(paths, duration, 2.0 * thickness)
        near_changes = [change for change, away in zip(changes, is_away.tolist(), strict=True) if not away]
        return paths, max(near_changes, default=0.0), is_away

    def standing_paths(self, t: float) -> Array:
        """Return the paths of obstacles at rest at their poses from time t [s] on, shape (count, PATH_NUMBERS)."""
        return constant_paths(t, self._bodies.array("pose"))

    def nearest(self, name: str) -> tuple[float, int]:
        """Return the gap [m], negative inside, of an obstacle to its nearest particle, and that particle's index."""
        k = self.names.index(name)
        gap = gaps(self.solids[k], self._bodies.array("pose")[k], self._state.x)
        particle = int(np.argmin(gap))
        return float(gap[particle]), particle

    def check_outside(self, names: Iterable[str], anchored: Collection[int]) -> None:
        """Raise ValueError if a particle, other than the anchored ones, is inside one of the named obstacles.

        Raises:
            ValueError: naming the obstacle, the deepest particle and its depth; the end of a sentence.
        """
        anchored_indices = list(anchored)
        for name in names:
            k = self.names.index(name)
            gap = gaps(self.solids[k], self._bodies.array("pose")[k], self._state.x, max_distance=0.0)
            gap[anchored_indices] = math.inf
            particle = int(np.argmin(gap))
            if gap[particle] <= 0.0:
                position = self._state.x[:, particle].tolist()
                raise ValueError(
                    f"is inside obstacle '{name}': particle {particle} at {[round(c, 6) for c in position]} is "
                    f"{-gap[particle]:.4g} m deep; move one of them"
                )

    def _are_away(self, paths: Array, duration: float, distance: float) -> NDArray[np.bool_]:
        """Return a mask of the obstacles that stay further than a distance [m] from the box about the present cloth.

        An obstacle moves no further than its path is long.
        """
        x = self._state.x
        starts = paths[:, 1:4]
        outside = np.maximum(np.maximum(x.min(axis=1) - starts, starts - x.max(axis=1)), 0.0)
        lengths = np.zeros(len(paths))
        for order in (1, 2, 3):
            lengths += power(duration, order) * np.sqrt(_squares(paths[:, 1 + 3 * order : 4 + 3 * order]))
        is_away: NDArray[np.bool_] = np.sqrt(_squares(outside)) > self._radii + lengths + distance
        return is_away

    def _may_be_too_fast(self, duration: float) -> bool:
        """Return False if a bound shows that every obstacle reaches its target within the speed limit.

        Let c be the chord between two unit quaternions of one hemisphere. The angle of their rotation is 4 asin(c / 2).
        Therefore it is at most pi c.
        """
        poses, targets = self._bodies.array("pose"), self._bodies.array("target")
        if poses is targets:
            return False
        offsets, sums = targets - poses, targets[:, 3:] + poses[:, 3:]
        chords = np.sqrt(np.minimum(_squares(offsets[:, 3:]), _squares(sums)))
        bound = np.sqrt(_squares(offsets[:, :3])) + self._lever_arms * math.pi * chords
        return not bool((bound <= _BOUND_MARGIN * MAX_BODY_SPEED * duration).all())

    def _end_pose(self, duration: float, k: int, pose: Sequence[float], target: Sequence[float]) -> Sequence[float]:
        """Return an obstacle's pose at a frame's end: its target, or as close to it as the speed limit permits."""
        return clamp_motion(pose, target, float(self._lever_arms[k]), MAX_BODY_SPEED * duration)


def _squares(vectors: Array) -> Array:
    """Return the squared lengths of vectors (n, k), shape (n,)."""
    total: Array = vectors[:, 0] * vectors[:, 0]
    for k in range(1, vectors.shape[1]):
        total = total + vectors[:, k] * vectors[:, k]
    return total


def replace_obstacles(
    state: State,
    names_before: list[str],
    names_after: list[str],
    descriptions: Mapping[str, sections.ObstacleParameters],
) -> None:
    """Replace the obstacles in a state's memory by others; obstacles that remain keep pose and motion.

    Args:
        state: the state; without obstacles in memory it stays unchanged.
        names_before: names of the obstacles in memory.
        names_after: names of the new obstacles.
        descriptions: parameters of the obstacles, by name; they give the initial poses.
    """
    state.memory = dict(state.memory)
    names = [f"{_KIND}.{quantity}" for quantity in ("pose", "twist", "turn", "target")]
    arrays = {name: state.memory.pop(name) for name in names if name in state.memory}
    if not arrays or not names_after:
        return
    for name, array in arrays.items():
        rows = np.zeros((len(names_after), array.shape[1]))
        for k, obstacle in enumerate(names_after):
            if obstacle in names_before:
                rows[k] = array[names_before.index(obstacle)]
            elif array.shape[1] == 7:
                rows[k] = _start_pose(descriptions[obstacle])
        state.memory[name] = rows


def gaps(solid: Obstacle, pose: Array, x: Array, *, max_distance: float = math.inf) -> Array:
    """Return distances [m] of particles x (3, n) from an obstacle, negative inside; lower bounds above `max_distance`.

    Beyond `max_distance` [m] from the bounding sphere the distance from that sphere is returned, a lower bound.
    """
    offsets = x - pose[:3, None]
    squares = offsets[0] * offsets[0] + offsets[1] * offsets[1] + offsets[2] * offsets[2]
    distances: Array = np.sqrt(squares) - solid.bounding_radius
    nearby = np.flatnonzero(distances <= max_distance)
    distances[nearby] = solid.distance(to_body_frame(pose, x[:, nearby]))[0]
    return distances


def _start_pose(description: sections.ObstacleParameters) -> Array:
    """Return the initial pose of an obstacle, shape (7,): position [m] and unit quaternion x, y, z, w."""
    return np.concatenate([np.asarray(description.position, dtype=np.float64), normalized(description.orientation)])
