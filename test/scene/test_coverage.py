# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covered area of a plane: against exact areas, with overlaps, rectangles and bad input."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.scene.coverage import Coverage
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

UPRIGHT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
PLANE = {"table.shape": "plane", "coverage.obstacle": "table"}
BOX = {"table.shape": "box", "table.size": [0.4, 0.2, 0.7], "coverage.obstacle": "table"}


def scene(**values: object) -> Scene:
    return Scene.from_parameters({"cloth.resolution": [6, 8], **values})


def flat(cloth: Scene) -> np.ndarray:
    """Return the positions of the flat sheet in z = 0 [m], shape (3, n)."""
    return cloth.sheet.positions().T.copy()


def turned(x: np.ndarray, degrees: float) -> np.ndarray:
    """Return positions turned about z, and moved off the cells."""
    angle = np.radians(degrees)
    matrix = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return matrix @ x + np.array([[0.0123], [0.0457], [0.3]])


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 83.0])
@pytest.mark.parametrize("resolution", [0.002, 0.01])
def test_flat_sheet_covers_its_area(degrees: float, resolution: float) -> None:
    cloth = scene(**PLANE, **{"coverage.resolution": resolution})
    area = Coverage(cloth).area(turned(flat(cloth), degrees), UPRIGHT)
    # The boundary is 4 m long; its cells err to both sides.
    assert abs(area - 1.0) < 0.25 * 4.0 * resolution


def test_error_falls_with_the_resolution() -> None:
    errors = []
    for resolution in (0.016, 0.004, 0.001):
        cloth = scene(**PLANE, **{"coverage.resolution": resolution})
        areas = [Coverage(cloth).area(turned(flat(cloth), degrees), UPRIGHT) for degrees in range(3, 90, 6)]
        errors.append(np.abs(np.array(areas) - 1.0).mean())
    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2]


def test_overlapping_layers_count_once() -> None:
    cloth = scene(**PLANE)
    x = turned(flat(cloth), 0.0)
    middle = 0.0123
    x[0] = middle - np.abs(x[0] - middle)  # folded over
    x[2] += np.where(np.arange(x.shape[1]) % 8 < 4, 0.0, 0.01)
    # The cells of the sheet across the fold are edgewise: 1/7 of its width.
    assert Coverage(cloth).area(x, UPRIGHT) == pytest.approx(0.5 - 0.5 / 7.0, abs=0.003)


def test_no_gap_opens_between_triangles() -> None:
    cloth = scene(**PLANE, **{"cloth.resolution": [40, 40], "coverage.resolution": 0.003})
    rng = np.random.default_rng(1)
    x = flat(cloth)
    # Inner particles move by less than half a cell of the sheet; the outline stays.
    inner = (np.abs(x[:2]).max(axis=0) < 0.49)[None] * rng.uniform(-0.01, 0.01, (3, x.shape[1]))
    x[:2] += inner[:2]
    expected = np.count_nonzero(np.abs((np.arange(-400, 400) + 0.5) * 0.003) <= 0.5) ** 2 * 0.003**2
    assert Coverage(cloth).area(x, UPRIGHT) == pytest.approx(expected, rel=1e-12)


def test_cloth_on_edge_covers_nothing() -> None:
    cloth = scene(**PLANE)
    x = flat(cloth)[[0, 2, 1]]
    assert Coverage(cloth).area(x + 0.0003, UPRIGHT) == 0.0


def test_box_and_rectangle_bound_the_area() -> None:
    cloth = scene(**BOX)
    assert Coverage(cloth).area(flat(cloth), UPRIGHT) == pytest.approx(0.4 * 0.2, abs=1e-3)
    cloth = scene(**PLANE, **{"coverage.size": [0.5, 0.3]})
    assert Coverage(cloth).area(flat(cloth), UPRIGHT) == pytest.approx(0.5 * 0.3, abs=2e-3)
    cloth = scene(**BOX, **{"coverage.size": [0.1, 9.0]})
    assert Coverage(cloth).area(flat(cloth), UPRIGHT) == pytest.approx(0.1 * 0.2, abs=1e-3)
    outside = flat(cloth) + np.array([[2.0], [0.0], [0.0]])
    assert Coverage(cloth).area(outside, UPRIGHT) == 0.0


def test_area_belongs_to_the_pose_of_the_plane() -> None:
    cloth = scene(**BOX)
    pose = np.array([0.3, -2.0, 0.5, *(np.array([0.2, -0.5, 0.1, 0.8]) / np.sqrt(0.94))])
    x = rotation_matrix(pose[3:]) @ flat(cloth) + pose[:3, None]
    assert Coverage(cloth).area(x, pose) == pytest.approx(Coverage(cloth).area(flat(cloth), UPRIGHT), abs=1e-12)


def test_wide_cloth_is_counted_in_larger_cells() -> None:
    cloth = scene(**PLANE, **{"coverage.resolution": 1e-5})
    assert Coverage(cloth).area(20.0 * turned(flat(cloth), 30.0), UPRIGHT) == pytest.approx(400.0, rel=1e-3)


def test_crumpled_cloth_needs_bounded_memory() -> None:
    cloth = scene(**PLANE, **{"cloth.resolution": [40, 40], "coverage.resolution": 1e-5})
    x = np.random.default_rng(1).uniform(-0.02, 0.02, (3, 1600))
    tracemalloc.start()
    try:
        area = Coverage(cloth).area(x, UPRIGHT)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert area == pytest.approx(0.04**2, rel=0.1)
    assert peak < 400e6


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"coverage.obstacle": "table"}, "names 'table', and table.shape is not set; set it"),
        ({"coverage.obstacle": "ball", "ball.shape": "sphere", "ball.size": [0.1]}, "take a plane or a box"),
        ({**PLANE, "coverage.size": [0.0, 0.3]}, "give two positive numbers"),
        ({**PLANE, "coverage.size": [0.3]}, "it must have 2"),
        ({**PLANE, "coverage.resolution": 0.0}, "it must be at least 1e-05"),
        ({**PLANE, "coverage.resolution": float("nan")}, "must be finite"),
        ({"coverage.shape": "box"}, "unknown parameter 'coverage.shape'"),
    ],
)
def test_wrong_plane_is_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match="coverage") as error:
        scene(**values)
    assert message in str(error.value)


def test_springs_without_a_surface_are_refused(tmp_path: Path) -> None:
    springs = Path(__file__).resolve().parents[2] / "config" / "chain.springs.yaml"
    with pytest.raises(ParameterError, match=r"coverage\.obstacle needs a surface"):
        Scene.from_parameters({"cloth.springs": str(springs), "cloth.anchors": [""], "bending.model": "none", **PLANE})
