# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points and edges of obstacles that could pass between a cloth's particles."""

from __future__ import annotations

import math
from itertools import product

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.angles import sine_and_cosine
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array

#: Largest distance of a cylinder's polygonal rim from the circle, as a fraction of the thickness.
_MAX_CYLINDER_INSET = 0.05
#: A sphere or capsule may be left to particles alone. Assumptions: largest growth of an edge, least gap of a particle
#: over the thickness. Limit: penetration depth of a triangle as a fraction of the radius.
_MAX_EDGE_STRETCH, _MIN_PARTICLE_GAP, _MAX_DEPTH = 1.1, 0.75, 0.1
#: Sine of the angle between two triangles of a mesh below which they count as one flat face.
_FLATNESS_SINE = 1e-6


@attrs.frozen(eq=False)
class ObstacleFeatures:
    """Points and edges of one obstacle in its own frame, rounded by a radius, for contact with the cloth's surface."""

    #: Positions [m], shape (points, 3).
    points: Array
    #: Indices of the two end points, shape (edges, 2).
    edges: NDArray[np.int64]
    #: Radius around points and edges [m].
    radius: float = 0.0


def obstacle_features(obstacle: Obstacle, thickness: float) -> ObstacleFeatures:
    """Return the points and edges of an obstacle that could pass between a cloth's particles; a plane has none.

    A sphere is its centre with the sphere's radius, a capsule its axis, a box its corners and edges. A cylinder is an
    inscribed prism, at most a twentieth of the thickness inside it. A mesh has its convex edges and their ends. The
    point nearest to a straight edge or a flat triangle is never in a hollow.

    Args:
        obstacle: the obstacle.
        thickness: contact thickness [m].
    """
    match obstacle.shape:
        case "box":
            return _box(obstacle.size)
        case "sphere":
            return ObstacleFeatures(np.zeros((1, 3)), _NO_EDGES, obstacle.size[0])
        case "capsule":
            radius, length = obstacle.size
            ends = np.array([[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]])
            return ObstacleFeatures(ends, np.array([[0, 1]]), radius)
        case "cylinder":
            radius, length = obstacle.size
            return _cylinder(radius, length, thickness)
        case "mesh":
            assert obstacle.vertices is not None
            assert obstacle.triangles is not None
            return _mesh(obstacle.vertices, obstacle.triangles)
    return ObstacleFeatures(np.zeros((0, 3)), _NO_EDGES)


def is_covered_by_particles(radius: float, max_edge: float, thickness: float) -> bool:
    """Return true if contact of particles alone keeps triangles of the cloth off a sphere or capsule.

    Particles have friction, features none. The condition is that no triangle penetrates deeper than a tenth of the
    radius.

    Let q = sum w x be a point of a triangle, and c any point. Then ``|c-q|^2 = sum w |c-x|^2 - sum w w |x-y|^2``. Take
    corners at a distance R from c and edges of at most l. The triangle is no nearer than sqrt(R^2 - l^2 / 3).

    Args:
        radius: radius of the sphere or capsule [m].
        max_edge: longest edge of the cloth at rest [m].
        thickness: contact thickness [m].
    """
    distance, min_distance = radius + _MIN_PARTICLE_GAP * thickness, (1.0 - _MAX_DEPTH) * radius
    edge = _MAX_EDGE_STRETCH * max_edge
    return distance * distance - edge * edge / 3.0 >= min_distance * min_distance


_NO_EDGES = np.zeros((0, 2), dtype=np.int64)


def _box(size: tuple[float, ...]) -> ObstacleFeatures:
    corners = list(product((-0.5, 0.5), repeat=3))
    edges = [(a, a + step) for step in (4, 2, 1) for a in range(8) if not a & step]
    return ObstacleFeatures(np.array(corners) * np.array(size), np.array(edges, dtype=np.int64))


def _cylinder(radius: float, length: float, thickness: float) -> ObstacleFeatures:
    # An arc of angle 2 x lies within radius x^2 / 2 of its chord.
    count = max(8, math.ceil(math.pi * math.sqrt(radius / (2.0 * _MAX_CYLINDER_INSET * thickness))))
    circle_points = [sine_and_cosine(math.pi * (2.0 * k / count - 1.0)) for k in range(count)]
    points = [(radius * c, radius * s, rim * length) for rim in (-0.5, 0.5) for s, c in circle_points]
    edges = [(k + rim * count, (k + 1) % count + rim * count) for rim in (0, 1) for k in range(count)]
    edges += [(k, k + count) for k in range(count)]
    return ObstacleFeatures(np.array(points), np.array(edges, dtype=np.int64))


def _mesh(vertices: Array, triangles: NDArray[np.int64]) -> ObstacleFeatures:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = _unit(_cross(b - a, c - a))
    # Each edge occurs twice, once in either direction. Sorted by its ends, the two are neighbours.
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    apexes, face = triangles[:, [2, 0, 1]].ravel(), np.arange(len(ends)) // 3
    order = np.lexsort((ends.max(axis=1), ends.min(axis=1)))
    first, second = order[0::2], order[1::2]
    direction = _unit(vertices[apexes[second]] - vertices[ends[first, 0]])
    n = normal[face[first]]
    is_convex = n[:, 0] * direction[:, 0] + n[:, 1] * direction[:, 1] + n[:, 2] * direction[:, 2] < -_FLATNESS_SINE
    edges = ends[first[is_convex]]
    vertex_indices, new_indices = np.unique(edges, return_inverse=True)
    new_edges = np.ascontiguousarray(new_indices.reshape(-1, 2), dtype=np.int64)
    return ObstacleFeatures(np.ascontiguousarray(vertices[vertex_indices]), new_edges)


def _cross(a: Array, b: Array) -> Array:
    rows = [a[:, j] * b[:, k] - a[:, k] * b[:, j] for j, k in ((1, 2), (2, 0), (0, 1))]
    return np.stack(rows, axis=1)


def _unit(a: Array) -> Array:
    length: Array = np.sqrt(a[:, 0] * a[:, 0] + a[:, 1] * a[:, 1] + a[:, 2] * a[:, 2])
    unit: Array = a / length[:, None]
    return unit
