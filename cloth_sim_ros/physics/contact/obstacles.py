# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid obstacles in their own frame, with exact numpy distances.

The engine has its own, fast distances. Those here are an independent reference; the check of a start uses them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.contact.obstacle_mesh import check_closed, mesh_distance
from cloth_sim_ros.physics.contact.obstacle_shapes import MAX_SIZE, SHAPES
from cloth_sim_ros.physics.model.forces.force import Array


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in np.asarray(values, dtype=np.float64).ravel())


def _points(values: Any) -> Array | None:
    return None if values is None else np.array(values, dtype=np.float64, order="C")


def _faces(values: Any) -> NDArray[np.int64] | None:
    if values is None:
        return None
    faces = np.array(values, order="C")
    return faces.astype(np.int64) if faces.dtype.kind in "iu" else faces


@attrs.frozen(kw_only=True, eq=False)
class Obstacle:
    """Rigid obstacle in its own frame: shape, sizes, friction coefficients, and vertices of a mesh.

    - plane: the half space z <= 0 is solid and z is its normal; no size.
    - box: edge lengths x, y, z [m] along the axes.
    - sphere: radius [m].
    - capsule: radius and length [m] along z; the length is that of the cylinder between the two half spheres.
    - cylinder: radius and length [m] along z, with flat ends.
    - mesh: closed, no size; seen from outside, each triangle runs counterclockwise.

    Raises:
        ValueError: for an unknown shape, sizes that do not fit it, invalid friction, or a mesh that is open, inside out
            or has triangles without area.
    """

    name: str
    shape: str
    #: Sizes [m] in the order of the list above.
    size: tuple[float, ...] = attrs.field(default=(), converter=_floats)
    #: Coefficients of static and kinetic friction.
    friction: tuple[float, ...] = attrs.field(default=(0.0, 0.0), converter=_floats)
    #: Vertices of a mesh [m], shape (m, 3).
    vertices: Array | None = attrs.field(default=None, converter=_points, repr=False)
    #: Vertex indices of a mesh's triangles, shape (t, 3).
    triangles: NDArray[np.int64] | None = attrs.field(default=None, converter=_faces, repr=False)

    def __attrs_post_init__(self) -> None:
        """Raise ValueError for an invalid obstacle."""
        if self.shape not in SHAPES:
            raise ValueError(f"{self._label} is a '{self.shape}'; it must be one of {', '.join(SHAPES)}")
        self._check_size()
        if len(self.friction) != 2:
            raise ValueError(
                f"{self._label} has {len(self.friction)} coefficients of friction; give static and kinetic"
            )
        static, kinetic = self.friction
        if not (math.isfinite(static) and 0.0 <= kinetic <= static):
            raise ValueError(
                f"{self._label} has friction {static} at rest and {kinetic} in motion; both must be finite and at "
                "least 0, and the one in motion at most the one at rest"
            )
        if (self.shape == "mesh") != (self.vertices is not None and self.triangles is not None):
            raise ValueError(f"{self._label} is a {self.shape}; a mesh, and nothing else, has vertices and triangles")
        if self.vertices is not None and self.triangles is not None:
            try:
                check_closed(self.vertices, self.triangles, MAX_SIZE)
            except ValueError as error:
                raise ValueError(f"{self._label}: {error}") from error

    @property
    def _label(self) -> str:
        return f"obstacle '{self.name}'"

    def _check_size(self) -> None:
        names = SHAPES[self.shape]
        if len(self.size) != len(names):
            raise ValueError(
                f"{self._label} has {len(self.size)} sizes, {list(self.size)}; a {self.shape} has {len(names)}"
                + (f": {', '.join(names)}" if names else "")
            )
        for name, value in zip(names, self.size, strict=True):
            if not 0.0 < value <= MAX_SIZE:
                raise ValueError(f"{self._label} has {name} {value} m; it must be above 0 and at most {MAX_SIZE:g} m")

    @cached_property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the frame's origin that contains the whole obstacle [m]; infinite for a plane."""
        match self.shape:
            case "plane":
                return math.inf
            case "box":
                x, y, z = self.size
                return 0.5 * math.sqrt(x * x + y * y + z * z)
            case "sphere":
                return self.size[0]
            case "capsule":
                return self.size[0] + 0.5 * self.size[1]
            case "cylinder":
                radius, half = self.size[0], 0.5 * self.size[1]
                return math.sqrt(radius * radius + half * half)
        assert self.vertices is not None
        return math.sqrt(float(_squares(self.vertices).max()))

    def distance(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return signed distances [m] of points in the obstacle's frame, negative inside, and outward unit normals.

        Args:
            points: positions in the obstacle's frame [m], shape (m, 3).

        Returns:
            Gaps [m], shape (m,), negative inside, and outward unit normals, shape (m, 3). If several directions are
            equally good, as at the centre of a sphere, the normal is one of them.
        """
        p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if self.shape == "mesh":
            assert self.vertices is not None
            assert self.triangles is not None
            return mesh_distance(p, self.vertices, self.triangles)
        return _DISTANCES[self.shape](p, self.size)


def _squares(vectors: Array) -> Array:
    """Return squared lengths of vectors (m, k), summed from the first component on."""
    total = vectors[:, 0] * vectors[:, 0]
    for k in range(1, vectors.shape[1]):
        total = total + vectors[:, k] * vectors[:, k]
    return total


def _offset_from(points: Array, nearest: Array, fallback: Array) -> tuple[Array, Array]:
    """Return distances of points (m, k) from their nearest points, and unit vectors away from these.

    Points that coincide get the vector `fallback`.
    """
    offset = points - nearest
    distance = np.sqrt(_squares(offset))
    is_apart = distance > 0.0
    return distance, np.where(is_apart[:, None], offset / np.where(is_apart, distance, 1.0)[:, None], fallback)


def _plane_distance(p: Array, size: tuple[float, ...]) -> tuple[Array, Array]:
    return p[:, 2].copy(), np.broadcast_to([0.0, 0.0, 1.0], p.shape).copy()


def _sphere_distance(p: Array, size: tuple[float, ...]) -> tuple[Array, Array]:
    distance, normal = _offset_from(p, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return distance - size[0], normal


def _capsule_distance(p: Array, size: tuple[float, ...]) -> tuple[Array, Array]:
    radius, half = size[0], 0.5 * size[1]
    nearest = np.zeros_like(p)
    nearest[:, 2] = np.clip(p[:, 2], -half, half)
    distance, normal = _offset_from(p, nearest, np.array([1.0, 0.0, 0.0]))
    return distance - radius, normal


def _box_distance(q: Array, half: Array) -> tuple[Array, Array]:
    """Return signed distances and normals of points (m, k) from a box of k axes with half lengths (k,)."""
    excess = np.abs(q) - half
    outside, outward = _offset_from(q, np.clip(q, -half, half), np.zeros(q.shape[1]))
    axis = np.argmax(excess, axis=1)
    inward = excess[np.arange(len(q)), axis]
    face = np.zeros_like(q)
    face[np.arange(len(q)), axis] = np.where(q[np.arange(len(q)), axis] < 0.0, -1.0, 1.0)
    is_outside = inward > 0.0
    return np.where(is_outside, outside, inward), np.where(is_outside[:, None], outward, face)


def _solid_box_distance(p: Array, size: tuple[float, ...]) -> tuple[Array, Array]:
    return _box_distance(p, 0.5 * np.array(size))


def _cylinder_distance(p: Array, size: tuple[float, ...]) -> tuple[Array, Array]:
    # In the half plane of axial distance and height the cylinder is a box.
    across, outward = _offset_from(p[:, :2], np.zeros(2), np.array([1.0, 0.0]))
    gap, flat = _box_distance(np.stack([across, p[:, 2]], axis=1), np.array([size[0], 0.5 * size[1]]))
    return gap, np.concatenate([outward * flat[:, :1], flat[:, 1:]], axis=1)


_DISTANCES: dict[str, Callable[[Array, tuple[float, ...]], tuple[Array, Array]]] = {
    "plane": _plane_distance,
    "box": _solid_box_distance,
    "sphere": _sphere_distance,
    "capsule": _capsule_distance,
    "cylinder": _cylinder_distance,
}
