# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A T-shirt's outline as an irregular mesh, and two grippers at its shoulders that swing it."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The right half from the middle of the collar to the middle of the hem [m]: across and up; the left half mirrors it.
HALF = (
    (0.0, 0.63),
    (0.05, 0.645),
    (0.085, 0.69),
    (0.23, 0.66),
    (0.41, 0.49),
    (0.32, 0.40),
    (0.24, 0.48),
    (0.25, 0.0),
    (0.0, 0.0),
)
#: Where grippers take hold: the outer ends of the shoulders, across and up [m].
SHOULDERS = {"left": (-0.21, 0.655), "right": (0.21, 0.655)}
#: Particles inside lie off a square lattice by at most so much of its spacing each way.
_JITTER = 0.35
#: Least distance of a particle inside from the outline, as a share of the spacing.
_CLEAR = 0.45
_SEED = 12
#: Triangles lower than this over their longest side lie on a straight piece of the outline [1].
FLAT = 0.02
#: The swing: how far [m] and how often a second.
_REACH, _FREQUENCY = 0.15, 0.8

Floats = NDArray[np.float64]


def outline() -> Floats:
    """Corners of the outline in order, shape (k, 2) [m]."""
    right = np.array(HALF)
    left = right[-2:0:-1] * (-1.0, 1.0)
    return np.concatenate([right, left])


@lru_cache(maxsize=4)
def mesh(vertices: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return particles (n, 3) [m] in the x-z plane and triangles (m, 3): Delaunay's, of about so many random points.

    Raises:
        ValueError: for fewer vertices than make a shirt.
    """
    if vertices < 100:
        raise ValueError(f"a garment of {vertices} vertices; at least 100 are needed to show its outline")
    low, high = 0.002, 0.1
    best = _points(high)
    for _ in range(30):
        middle = 0.5 * (low + high)
        points = _points(middle)
        if abs(len(points) - vertices) < abs(len(best) - vertices):
            best = points
        low, high = (middle, high) if len(points) > vertices else (low, middle)
    from scipy.spatial import Delaunay

    triangles = Delaunay(best).simplices.astype(np.int64)
    triangles = triangles[_inside(best[triangles].mean(axis=1)) & (_heights(best[triangles]) > FLAT)]
    used, numbers = np.unique(triangles, return_inverse=True)
    places = np.zeros((len(used), 3))
    places[:, [0, 2]] = best[used]
    return places, numbers.reshape(triangles.shape)


def obj_file(vertices: int) -> bytes:
    """The mesh as an OBJ file."""
    places, triangles = mesh(vertices)
    return as_obj(places, triangles)


def as_obj(places: Floats, triangles: NDArray[np.int64]) -> bytes:
    """Vertices (n, 3) and triangles (m, 3) as an OBJ file."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in places.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


def parameters(*, bending: str, tolerance: float) -> dict[str, Any]:
    """The scene's parameters; its mesh is the file `garment.obj`."""
    values: dict[str, Any] = {
        "cloth.mesh": "garment.obj",
        "cloth.position": [0.0, 0.0, 1.0],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": [""],
        "wind.normal_drag": 0.0,
        "bending.model": bending,
        "grippers": list(SHOULDERS),
        "gripper.radius": 0.04,
        "tolerance": tolerance,
    }
    if bending in ("crossed", "altitude"):
        values["material.bending_modulus"] = 1e-5
    return values


def target(name: str, t: float) -> Floats:
    """Return a gripper's position (3,) [m] at time t [s]: it swings from the shoulder across and vertically."""
    across, up = SHOULDERS[name]
    phase = 2.0 * math.pi * _FREQUENCY * t
    away = np.array([0.0, math.sin(phase), 0.3 * math.sin(2.0 * phase)])
    return np.array([across, 0.0, 1.0 + up]) + _REACH * min(t, 1.0) * away


def _points(spacing: float) -> Floats:
    """Points on the outline and inside it, about so far apart [m], in random order."""
    random = np.random.default_rng(_SEED)
    corners = outline()
    edges = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    border = np.concatenate([_along(begin, end, spacing) for begin, end in edges])
    low, high = corners.min(axis=0), corners.max(axis=0)
    across, up = (np.arange(low[i] + 0.5 * spacing, high[i], spacing) for i in range(2))
    inner = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    inner = inner + random.uniform(-_JITTER, _JITTER, inner.shape) * spacing
    inner = inner[_inside(inner)]
    distance = np.sqrt(((inner[:, None] - border[None]) ** 2).sum(axis=-1)).min(axis=1, initial=np.inf)
    points = np.concatenate([border, inner[distance > _CLEAR * spacing]])
    return points[random.permutation(len(points))]


def _along(begin: Floats, end: Floats, spacing: float) -> Floats:
    """Points from a corner to the next, which is left out."""
    count = max(round(float(np.sqrt(((end - begin) ** 2).sum())) / spacing), 1)
    return begin + (end - begin) * (np.arange(count) / count)[:, None]


def _heights(corners: Floats) -> Floats:
    """Height of triangles over their longest side, relative to it, of corners (m, 3, 2)."""
    sides = np.roll(corners, -1, axis=1) - corners
    longest = (sides**2).sum(axis=-1).max(axis=1)
    double = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    return np.asarray(np.abs(double) / longest)


def _inside(points: Floats) -> NDArray[np.bool_]:
    """Return (m,) true for points (m, 2) inside the outline: a ray to the right crosses it an odd number of times."""
    inside = np.zeros(len(points), dtype=np.bool_)
    corners = outline()
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        between = (points[:, 1] < y0) != (points[:, 1] < y1)
        if y0 != y1:
            inside ^= between & (points[:, 0] < x0 + (points[:, 1] - y0) / (y1 - y0) * (x1 - x0))
    return inside
