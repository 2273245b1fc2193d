# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes of circular specimens, with a ring of particles along the edge of the plate below.

Both patterns have edges near one length. In a regular one the particles lie on rings. An irregular one begins from
regular triangles at a random angle. Laplace's smoothing then fits them to both circles, which stay.
"""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.physics.model.forces.force import Array

PATTERNS = ("regular", "irregular")
#: Distance of rows of regular triangles over their edge length.
ROW = math.sqrt(0.75)
#: Iterations of Laplace's smoothing, and the fraction of the way that a particle moves in each.
_SMOOTHING_ITERATIONS, _SMOOTHING_FRACTION = 30, 0.7
#: Limit of the number of particles of a specimen.
_MAX_PARTICLES = 100_000


@attrs.frozen(eq=False, kw_only=True)
class DiscMesh:
    """Triangle mesh of a disc or an annulus in the x-y plane."""

    #: Particles [m], shape (n, 2).
    points: Array
    #: Particles of each triangle, counterclockwise, shape (m, 3).
    triangles: NDArray[np.int64]

    def obj(self) -> bytes:
        """Return the mesh as the bytes of an OBJ file, with every bit of its points, z = 0."""
        lines = [f"v {x!r} {y!r} 0" for x, y in self.points.tolist()]
        lines += [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in self.triangles.tolist()]
        return "\n".join([*lines, ""]).encode()

    def min_quality(self) -> float:
        """Return the smallest quality of a triangle: 4 sqrt(3) area / sum of squared edges, 1 if it is regular."""
        a, b, c = (self.points[corner] for corner in self.triangles.T)
        squares = sum((edge * edge).sum(axis=1) for edge in (b - a, c - b, a - c))
        return float((2.0 * math.sqrt(3.0) * _twice_areas(a, b, c) / squares).min())


def disc_mesh(
    radius: float, plate_radius: float, edge_length: float, *, pattern: str = "regular", seed: int = 0
) -> DiscMesh:
    """Build the mesh of a disc with a ring of particles along the plate's edge; raise LaboratoryError for unfit edges.

    Args:
        radius: radius of the disc [m].
        plate_radius: radius of the circle along which there is a ring of particles [m].
        edge_length: length of an edge [m].
        pattern: one of `PATTERNS`.
        seed: seed of the angle of the triangles.

    Raises:
        LaboratoryError: for an edge length that does not fit the disc.
    """
    if not 0.0 < 2.0 * edge_length <= min(plate_radius, radius - plate_radius):
        raise LaboratoryError(
            f"the mesh's edges are {edge_length:g} m long; they must be above 0 and at most half of "
            f"{plate_radius:g} m, the radius of the plate, and of {radius - plate_radius:g} m, the overhang"
        )
    count = 2.0 * math.pi / math.sqrt(3.0) * (radius / edge_length) ** 2
    if count > _MAX_PARTICLES:
        raise LaboratoryError(
            f"edges of {edge_length:g} m make some {count:.0f} particles; at most {_MAX_PARTICLES} are possible: "
            "lengthen them"
        )
    if pattern == "regular":
        return _triangulated(_ring_points(radius, plate_radius, edge_length, seed))
    angle = float(np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi))
    fixed = np.concatenate([_ring(plate_radius, edge_length, angle), _ring(radius, edge_length, angle)])
    points = _regular_points(radius, edge_length, angle)
    distance = np.hypot(*points.T)
    inside = (distance < radius - 0.6 * edge_length) & (np.abs(distance - plate_radius) > 0.5 * edge_length)
    points = np.concatenate([fixed, points[inside]])
    for _ in range(_SMOOTHING_ITERATIONS):
        mesh = _triangulated(points)
        corners = mesh.triangles
        ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        ends = np.concatenate([ends, ends[:, ::-1]])
        total, n_neighbours = np.zeros_like(points), np.bincount(ends[:, 0], minlength=len(points))
        np.add.at(total, ends[:, 0], points[ends[:, 1]])
        moved = points + _SMOOTHING_FRACTION * (total / n_neighbours[:, None] - points)
        points = np.concatenate([fixed, moved[len(fixed) :]])
    return _triangulated(points)


def annulus(mesh: DiscMesh, plate_radius: float) -> DiscMesh:
    """Return the mesh of a disc's overhang, from the row of triangles inside the plate's edge to the border.

    Args:
        mesh: the disc, with a ring of particles along the plate's edge.
        plate_radius: radius of the plate [m].
    """
    is_held = is_on_plate(mesh.points, plate_radius)
    touches_edge = np.hypot(*mesh.points.T) > plate_radius * (1.0 - 1e-9)
    overhang = mesh.triangles[(touches_edge[mesh.triangles]).any(axis=1)]
    particles = np.unique(overhang)
    numbers = np.full(len(is_held), -1)
    numbers[particles] = np.arange(len(particles))
    return DiscMesh(points=mesh.points[particles], triangles=numbers[overhang])


def is_on_plate(points: Array, plate_radius: float) -> NDArray[np.bool_]:
    """Return a mask, shape (n,), of the points (n, 2) that lie on a plate of a radius [m], its edge included."""
    return np.asarray(np.hypot(*points.T) < plate_radius * (1.0 + 1e-9))


def _ring(radius: float, edge_length: float, angle: float) -> Array:
    """Return points on a circle about the origin, an edge length apart, the first at an angle [rad], (k, 2)."""
    count = max(round(2.0 * math.pi * radius / edge_length), 1)
    angles = angle + 2.0 * math.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _ring_points(radius: float, plate_radius: float, edge_length: float, seed: int) -> Array:
    """Return points of a disc, (n, 2): its centre, and rings at random angles, two at plate's edge and border."""
    angles = np.random.default_rng(seed)
    height = edge_length * ROW
    n_inner, n_outer = round(plate_radius / height), round((radius - plate_radius) / height)
    radii = [plate_radius * k / n_inner for k in range(1, n_inner + 1)]
    radii += [plate_radius + (radius - plate_radius) * k / n_outer for k in range(1, n_outer + 1)]
    rings = [_ring(r, edge_length, float(angles.uniform(0.0, 2.0 * math.pi))) for r in radii]
    return np.concatenate([np.zeros((1, 2)), *rings])


def _regular_points(radius: float, edge_length: float, angle: float) -> Array:
    """Return points of a regular triangle lattice at an angle [rad] that covers the disc and more, shape (n, 2)."""
    n_rows = math.ceil(2.0 * radius / edge_length) + 2
    row, column = (index.ravel() for index in np.mgrid[-n_rows : n_rows + 1, -n_rows : n_rows + 1])
    x, y = (column + 0.5 * (row % 2)) * edge_length, row * edge_length * ROW
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def _triangulated(points: Array) -> DiscMesh:
    """Return the Delaunay mesh of points (n, 2), counterclockwise, without slivers along the border."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(points).simplices.astype(np.int64)
    areas = _twice_areas(*(points[corner] for corner in triangles.T))
    triangles = np.where((areas < 0.0)[:, None], triangles[:, ::-1], triangles)
    is_regular = np.abs(areas) > 0.05 * float(np.median(np.abs(areas)))
    return DiscMesh(points=points, triangles=triangles[is_regular])


def _twice_areas(a: Array, b: Array, c: Array) -> Array:
    """Return twice the signed areas of triangles of corners (m, 2), shape (m,)."""
    first, second = b - a, c - a
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
