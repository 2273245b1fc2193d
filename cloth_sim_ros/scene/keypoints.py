# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints of a cloth: particles that a scene names, and their poses."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.normals import vertex_normals
from cloth_sim_ros.scene.build import named_particles
from cloth_sim_ros.scene.parameters.declare import NAME, ParameterError
from cloth_sim_ros.scene.physics_scene import Sheet

_CORNERS = "corners"
#: Corners of a grid, along its boundary.
_CORNER_NAMES = ("top_left", "top_right", "bottom_right", "bottom_left")


class KeypointScene(Protocol):
    """Protocol of a `Scene` for keypoints: their parameter, and the sheet."""

    @property
    def keypoints(self) -> tuple[str, ...]: ...

    @property
    def sheet(self) -> Sheet: ...


def keypoint_particles(scene: KeypointScene) -> dict[str, int]:
    """Return the particle of each keypoint by name, in the parameter's order; raise ParameterError for invalid entries.

    Raises:
        ParameterError: for an unknown corner or particle, a name that is no ROS name, or one that occurs twice.
    """
    entries = [entry for entry in scene.keypoints if entry]
    if not entries:
        return {}
    sheet, result = scene.sheet, dict[str, int]()
    count = len(sheet.positions())
    names = [name for entry in entries for name in (_CORNER_NAMES if entry == _CORNERS else (entry,))]
    for entry in names:
        name, _, particle = entry.partition("=") if "=" in entry else (entry, "", entry)
        if not (NAME.fullmatch(name) or name == particle):
            raise ParameterError(f"keypoints has '{entry}'; a name has letters, digits and _, a letter first")
        if name in result:
            raise ParameterError(f"keypoints names '{name}' twice; give each its own name")
        particles = named_particles("keypoints", particle, sheet, count)
        if len(particles) != 1:
            raise ParameterError(f"keypoints has '{entry}', which is {len(particles)} particles; name a corner or one")
        (result[name],) = particles
    return result


class KeypointPoses:
    """Calculation of keypoints' poses from positions: z along the surface's normal, x along the cloth.

    x follows a grid's row, or the first edge of a mesh's first triangle at the particle. Without a normal the
    orientation is that of the frame.

    Args:
        scene: with keypoints.
    """

    def __init__(self, scene: KeypointScene) -> None:
        sheet = scene.sheet
        #: Particle of each keypoint by name.
        self.particles = keypoint_particles(scene)
        indices = np.array(list(self.particles.values()), dtype=np.int64)
        triangles = sheet.triangles()
        self._indices, self._triangles = indices, triangles[np.isin(triangles, indices).any(axis=1)]
        #: Start and end of an edge at each keypoint.
        self._edges = np.array([_edge(sheet, self._triangles, int(index)) for index in indices])

    def compute(self, x: Array) -> Array:
        """Return position [m] and quaternion x, y, z, w of each keypoint, shape (k, 7), at positions (3, n) [m]."""
        normals = vertex_normals(x, self._triangles)[:, self._indices]
        along = x[:, self._edges[:, 1]] - x[:, self._edges[:, 0]]
        poses = np.zeros((len(self._indices), 7))
        poses[:, :3] = x[:, self._indices].T
        for pose, normal, edge in zip(poses, normals.T, along.T, strict=True):
            pose[3:] = _orientation(normal, edge)
        return poses


def _edge(sheet: Sheet, triangles: NDArray[np.int64], particle: int) -> tuple[int, int]:
    """Return start and end of an edge at a particle: in a grid's row, or of a triangle; equal without a triangle."""
    if isinstance(sheet, GridSheet):
        is_last = particle % sheet.columns == sheet.columns - 1
        return (particle - 1, particle) if is_last else (particle, particle + 1)
    rows, corners = np.nonzero(triangles == particle)
    return (particle, int(triangles[rows[0], (corners[0] + 1) % 3])) if len(rows) else (particle, particle)


def _orientation(normal: Array, edge: Array) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of axes z = unit normal, x = edge's part across it; the identity if one is 0."""
    across = edge - (edge * normal).sum() * normal
    length = math.sqrt((across * across).sum())
    if not (normal.any() and length > 0.0):
        return (0.0, 0.0, 0.0, 1.0)
    x = across / length
    matrix = np.stack([x, np.cross(normal, x), normal], axis=1)
    # The symmetric matrix has the quaternion's products: its largest row divides by no small number (Shepperd 1978).
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    products = np.array(
        [
            [1.0 + a - e - i, b + d, c + g, h - f],
            [b + d, 1.0 - a + e - i, f + h, c - g],
            [c + g, f + h, 1.0 - a - e + i, d - b],
            [h - f, c - g, d - b, 1.0 + a + e + i],
        ]
    )
    row = products[int(np.argmax(products.diagonal()))]
    qx, qy, qz, qw = (row / math.sqrt((row * row).sum())).tolist()
    return (qx, qy, qz, qw) if qw >= 0.0 else (-qx, -qy, -qz, -qw)
