# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random triangle meshes as files' content: discs, outlines with a hole, irregular sheets."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.model.forces.force import Array

#: Particles of a mesh.
COUNTS = (40, 1500)


def drawn_alike(numbers: ArrayLike) -> Array:
    """Numbers to a thousand millionth: what sines, norms and products of matrices leave in the last bits differs from
    machine to machine, and a scene of a seed is to be the same on all of them.
    """
    return np.asarray(np.round(np.asarray(numbers, dtype=np.float64), 9))


def shuffled_mesh(particles: int) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) [m] in random order and triangles (m, 3) of an irregular square sheet of 1 m."""
    from scipy.spatial import Delaunay

    random = np.random.default_rng(5)
    edge = max(round(particles**0.5), 2)
    plane = np.stack(np.meshgrid(np.arange(edge), np.arange(edge)), axis=-1).reshape(-1, 2) / (edge - 1.0)
    inner = ((plane > 0.0) & (plane < 1.0)).all(axis=1)
    plane[inner] += random.uniform(-0.3, 0.3, (int(inner.sum()), 2)) / edge
    plane = plane[random.permutation(len(plane))]
    rest_positions = np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)
    return rest_positions, Delaunay(plane).simplices.astype(np.int64)


def random_mesh(rng: np.random.Generator) -> tuple[bytes, Array, str]:
    """A wavefront file, its vertices (n, 2) [m], and what it is."""
    kind = str(rng.choice(["disc", "hole", "irregular"]))
    count = round(float(np.exp(rng.uniform(*np.log(COUNTS)))))
    size = float(rng.uniform(0.3, 1.2))
    if kind == "hole":
        content, points = outline_with_a_hole(rng, count, size)
    else:
        content, points = _triangulated({"disc": _disc, "irregular": _irregular}[kind](rng, count), size)
    return content, points, f"{kind} of {len(points)}"


def outline_with_a_hole(rng: np.random.Generator, count: int, size: float) -> tuple[bytes, Array]:
    """A wavefront file of some particles, as wide as a size [m], and its vertices (n, 2) [m]."""
    return _triangulated(_hole(rng, count), size, hole=True)


def _triangulated(points: Array, size: float, *, hole: bool = False) -> tuple[bytes, Array]:
    from scipy.spatial import Delaunay

    points = drawn_alike(points)
    triangles = Delaunay(points).simplices
    corners = points[triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    double_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    has_enough_area = double_area > 0.02 * sides * sides
    if hole:
        middle = corners.mean(axis=1)
        has_enough_area &= ~((np.abs(middle[:, 0]) < 0.2) & (np.abs(middle[:, 1]) < 0.15))
    triangles = triangles[has_enough_area]
    used = np.unique(triangles)
    points, triangles = size * points[used], np.searchsorted(used, triangles)
    lines = [f"v {x:.9f} {y:.9f} 0" for x, y in points.tolist()]
    lines += [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in triangles.tolist()]
    return "\n".join(lines).encode(), points


def _disc(rng: np.random.Generator, count: int) -> Array:
    """Rings about a middle, within a radius of a half."""
    rings = max(2, round((count / 3.0) ** 0.5))
    points = [np.zeros((1, 2))]
    for ring in range(1, rings + 1):
        angle = 2.0 * np.pi * np.arange(6 * ring) / (6 * ring) + 0.1 * ring
        points.append(0.5 * ring / rings * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points)


def _hole(rng: np.random.Generator, count: int) -> Array:
    """A lattice of 1 by 0.7, with the middle left out by whoever triangulates it."""
    columns = max(8, round((count / 0.7) ** 0.5))
    return _shaken(rng, columns, max(6, round(0.7 * columns)), 0.15) * (1.0, 0.7)


def _irregular(rng: np.random.Generator, count: int) -> Array:
    columns = max(5, round((count * 0.8) ** 0.5))
    return _shaken(rng, columns, max(4, round(count / columns)), 0.3)


def _shaken(rng: np.random.Generator, columns: int, rows: int, share: float) -> Array:
    """A lattice in a unit square whose inner points are moved by up to a share of their distance."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns), np.linspace(-0.5, 0.5, rows))
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    inner = (np.abs(points) < 0.5 - 1e-9).all(axis=1)
    points[inner] += rng.uniform(-share, share, (int(inner.sum()), 2)) / (columns - 1, rows - 1)
    return np.asarray(points)
