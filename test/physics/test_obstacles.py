# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles: refusals, and distances that do not depend on the method."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.physics.contact.obstacles import Obstacle

#: A cube of half edge 1 as a mesh: vertices by the bits of their number, outward triangles.
CORNERS = np.array([[2.0 * (k >> axis & 1) - 1.0 for axis in range(3)] for k in range(8)])
FACES = np.array(
    [
        *([0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]),
        *([2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]),
    ]
)

SOLIDS = {
    "plane": Obstacle(name="o", shape="plane"),
    "box": Obstacle(name="o", shape="box", size=(2.0, 1.0, 0.5)),
    "sphere": Obstacle(name="o", shape="sphere", size=(0.7,)),
    "capsule": Obstacle(name="o", shape="capsule", size=(0.3, 1.2)),
    "cylinder": Obstacle(name="o", shape="cylinder", size=(0.5, 1.0)),
    "mesh": Obstacle(name="o", shape="mesh", vertices=CORNERS, triangles=FACES),
}


@pytest.mark.parametrize("shape", SOLIDS)
def test_nearest_surface_point_lies_one_gap_along_the_normal(shape: str) -> None:
    obstacle = SOLIDS[shape]
    points = np.random.default_rng(1).uniform(-1.6, 1.6, (4000, 3))
    gap, normal = obstacle.distance(points)
    assert np.abs((normal * normal).sum(axis=1) - 1.0).max() < 1e-12
    on_it = points - gap[:, None] * normal
    assert np.abs(obstacle.distance(on_it)[0]).max() < 1e-12
    # No surface point is nearer: the gap changes by no more than the displacement, like any distance.
    permutation = np.random.default_rng(2).permutation(len(points))
    away = np.sqrt(((points - points[permutation]) ** 2).sum(axis=1))
    assert (np.abs(gap - gap[permutation]) <= away + 1e-12).all()
    assert (gap < 0.0).any()
    assert (gap > 0.0).any()


@pytest.mark.parametrize(
    ("shape", "point", "gap", "normal"),
    [
        ("plane", (3.0, 4.0, -0.2), -0.2, (0.0, 0.0, 1.0)),
        ("box", (1.3, 0.9, 0.0), 0.5, (0.6, 0.8, 0.0)),
        ("box", (0.0, -0.4, 0.0), -0.1, (0.0, -1.0, 0.0)),
        ("sphere", (0.0, 0.0, -1.0), 0.3, (0.0, 0.0, -1.0)),
        ("capsule", (0.0, 0.5, 0.1), 0.2, (0.0, 1.0, 0.0)),
        ("capsule", (0.0, 0.0, 1.0), 0.1, (0.0, 0.0, 1.0)),
        ("cylinder", (0.8, 0.0, 0.9), 0.5, (0.6, 0.0, 0.8)),
        ("cylinder", (0.0, 0.1, -0.45), -0.05, (0.0, 0.0, -1.0)),
        ("mesh", (0.2, 0.1, 1.5), 0.5, (0.0, 0.0, 1.0)),
        ("mesh", (0.2, 0.9, 0.0), -0.1, (0.0, 1.0, 0.0)),
    ],
)
def test_distances_known_by_hand(shape: str, point: tuple[float, ...], gap: float, normal: tuple[float, ...]) -> None:
    gaps, direction = SOLIDS[shape].distance([point])
    assert gaps[0] == pytest.approx(gap, abs=1e-14)
    assert direction[0] == pytest.approx(normal, abs=1e-14)


def test_mesh_of_a_box_has_the_distances_of_the_box() -> None:
    box = Obstacle(name="o", shape="box", size=(2.0, 2.0, 2.0))
    points = np.random.default_rng(3).uniform(-1.5, 1.5, (3000, 3))
    gap, normal = box.distance(points)
    other_gap, other_normal = SOLIDS["mesh"].distance(points)
    assert np.abs(gap - other_gap).max() < 1e-13
    assert np.abs(normal - other_normal).max() < 1e-12


def test_bounding_radius_encloses_the_obstacle() -> None:
    points = np.random.default_rng(4).uniform(-1.8, 1.8, (20000, 3))
    away = np.sqrt((points * points).sum(axis=1))
    for obstacle in SOLIDS.values():
        inside = obstacle.distance(points)[0] <= 0.0
        assert away[inside].max() <= obstacle.bounding_radius
        assert obstacle.bounding_radius == math.inf or away[inside].max() > 0.85 * obstacle.bounding_radius


def _mesh(vertices: Any = CORNERS, triangles: Any = FACES) -> dict[str, Any]:
    return {"shape": "mesh", "vertices": vertices, "triangles": triangles}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shape": "cone", "size": (1.0,)}, "'cone'; it must be one of plane, box"),
        ({"shape": "sphere", "size": (-0.1,)}, "radius -0.1 m; it must be above 0"),
        ({"shape": "sphere", "size": (0.0,)}, "radius 0.0 m"),
        ({"shape": "box", "size": (1.0, math.nan, 1.0)}, "y nan m"),
        ({"shape": "cylinder", "size": (1.0, math.inf)}, "length inf m"),
        ({"shape": "box", "size": (1.0,)}, "1 sizes, .*; a box has 3: x, y, z"),
        ({"shape": "plane", "size": (1.0,)}, "a plane has 0"),
        ({"shape": "sphere", "size": (1.0,), "friction": (0.1, 0.2)}, "friction 0.1 at rest and 0.2 in motion"),
        ({"shape": "sphere", "size": (1.0,), "friction": (math.inf, 0.2)}, "must be finite"),
        ({"shape": "sphere", "size": (1.0,), "friction": (0.2, -0.1)}, "at least 0"),
        ({"shape": "sphere", "size": (1.0,), "friction": (0.2,)}, "1 coefficients"),
        ({"shape": "mesh"}, "has vertices and triangles"),
        ({"shape": "sphere", "size": (1.0,), "vertices": CORNERS, "triangles": FACES}, "has vertices and triangles"),
        (_mesh(triangles=FACES[:-1]), "the mesh is open: the edge from vertex 3 to 5"),
        (_mesh(triangles=FACES[:, ::-1]), "it is inside out"),
        (_mesh(triangles=[*FACES[:-1], FACES[-1][::-1]]), "runs the same way in 2 triangles"),
        (_mesh(triangles=[*FACES, [0, 1, 8]]), r"triangle 12 is \[0, 1, 8\]; vertices are 0 to 7"),
        (_mesh(vertices=np.where(np.arange(8)[:, None] == 2, CORNERS[0], CORNERS)), "triangle 0, .*, has no area"),
        (_mesh(vertices=np.where(np.arange(8)[:, None] == 2, np.nan, CORNERS)), r"vertex 2 is \[nan"),
        (_mesh(triangles=FACES.astype(float)), "must be whole numbers"),
        (
            _mesh(np.concatenate([CORNERS, 0.5 * CORNERS]), np.concatenate([FACES, FACES[:, ::-1] + 8])),
            "piece 1 of the mesh, with triangle 12, has the volume -1 m",
        ),
    ],
)
def test_invalid_obstacle_is_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Obstacle(name="o", **options)
