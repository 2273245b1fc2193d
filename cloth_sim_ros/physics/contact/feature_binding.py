# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of obstacle features against the cloth's surface.

Features are points and edges of obstacles; they touch triangles and edges of the cloth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import address, check, float64_address, library
from cloth_sim_ros.physics.contact.obstacle_features import is_covered_by_particles, obstacle_features
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import ContactSurface
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable


class FeatureBinding(Uncopyable):
    """Engine binding of obstacle features (corners, edges): uploads them and finds hits with the cloth's surface.

    Args:
        engine_plan: handle of the engine's plan.
        faces: surface of the cloth.
        particle_count: number of particles of the model.
    """

    def __init__(self, engine_plan: PlanHandle, faces: ContactSurface, particle_count: int) -> None:
        self._engine_plan, self._library, self._handle = engine_plan, library(), engine_plan.pointer
        self._shape, self._max_edge = (3, particle_count), faces.max_edge
        triangles = faces.triangles
        check(self._library.cloth_plan_faces(self._handle, len(triangles), triangles.ctypes.data, faces.search_length))

    def upload(self, obstacles: Sequence[Obstacle], thickness: float) -> None:
        """Upload points and edges of obstacles, except of round ones that contact of particles alone keeps out."""
        for k, obstacle in enumerate(obstacles):
            feature_set = obstacle_features(obstacle, thickness)
            if feature_set.radius > 0.0 and is_covered_by_particles(feature_set.radius, self._max_edge, thickness):
                continue
            points = np.ascontiguousarray(feature_set.points)
            edges = np.ascontiguousarray(feature_set.edges, dtype=np.int64)
            arrays = len(points), points.ctypes.data, len(edges), edges.ctypes.data
            check(self._library.cloth_plan_features(self._handle, k, *arrays, feature_set.radius))

    def is_out_of_reach(self, t: float, duration: float, x: Array, v: Array) -> bool:
        """Return true if no obstacle feature can reach the cloth within a duration [s] from time t [s] on."""
        out = np.empty(1, dtype=np.int64)
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape), address(out)
        check(self._library.cloth_features_culled(self._handle, t, duration, *addresses))
        return bool(out[0])

    def ccd_hits(self, t: float, duration: float, start: Array, end: Array) -> bool:
        """Return true if straight paths from t to t + duration [s] lead the cloth through an obstacle feature."""
        out = np.empty(1, dtype=np.int64)
        addresses = float64_address("start", start, self._shape), float64_address("end", end, self._shape), address(out)
        check(self._library.cloth_ccd_features(self._handle, t, duration, *addresses))
        return bool(out[0])

    def ccd_jaw_hits(self, t: float, x: Array, half_openings: Array) -> NDArray[np.bool_]:
        """Return a mask (pinches,): true if a jaw crosses the cloth on a straight path to its present half opening.

        Args:
            t: time [s].
            x: positions of the cloth [m], shape (3, n).
            half_openings: half openings at the start of the motion [m], shape (pinches,).
        """
        out = np.empty(len(half_openings), dtype=np.int64)
        addresses = (
            float64_address("x", x, self._shape),
            float64_address("ways", half_openings, half_openings.shape),
            address(out),
        )
        check(self._library.cloth_ccd_jaws(self._handle, t, *addresses))
        return out != 0

    def find_penetration(self, t: float, x: Array) -> tuple[int, int, int]:
        """Return the index of the first obstacle that penetrates the cloth at t, or -1, and two particles near it."""
        out = np.empty(3, dtype=np.int64)
        check(
            self._library.cloth_feature_intersection(
                self._handle, t, float64_address("x", x, self._shape), address(out)
            )
        )
        obstacle, a, b = out.tolist()
        return obstacle, a, b

    def check_initial_penetration(self, t: float, x: Array, names: Sequence[str]) -> None:
        """Raise ValueError if a corner or edge of an obstacle comes through the cloth at time t [s].

        Raises:
            ValueError: for such a cloth, naming the obstacle, the particles and the position.
        """
        k, a, b = self.find_penetration(t, x)
        if k < 0:
            return
        position = [round(0.5 * sum(pair), 6) for pair in zip(x[:, a].tolist(), x[:, b].tolist(), strict=True)]
        raise ValueError(
            f"obstacle '{names[k]}' comes through the cloth between particles {a} and {b}, near {position}; move the "
            "cloth or the obstacle"
        )


def upload_meshes(handle: int, obstacles: Sequence[Obstacle]) -> None:
    """Upload to a plan in the engine the meshes of those obstacles that have one."""
    for k, obstacle in enumerate(obstacles):
        vertices, triangles = obstacle.vertices, obstacle.triangles
        if vertices is not None and triangles is not None:
            arrays = len(vertices), vertices.ctypes.data, len(triangles), triangles.ctypes.data
            check(library().cloth_plan_mesh(handle, k, *arrays))
