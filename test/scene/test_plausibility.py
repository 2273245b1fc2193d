# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes in the wrong unit, or far from the origin of their frame."""

from __future__ import annotations

import re
from typing import Any

import pytest

from cloth_sim_ros.scene.mesh_file import read
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.plausibility import cloth_size, implausible_sizes
from cloth_sim_ros.scene.scene import Scene

#: A square of 0.4 m in millimetres, and a box likewise.
SQUARE = b"v 0 0 0\nv 400 0 0\nv 400 400 0\nv 0 400 0\nf 1 2 3 4\n"
BOX = (
    b"v 0 0 0\nv 80 0 0\nv 80 80 0\nv 0 80 0\nv 0 0 80\nv 80 0 80\nv 80 80 80\nv 0 80 80\n"
    b"f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
)
MESH = {"cloth.mesh": "square.obj", "cloth.anchors": ["0"], "bending.model": "none"}
FILES = {"square.obj": SQUARE, "box.obj": BOX, "map.obj": SQUARE.replace(b"v ", b"v 400")}


def sentences(**values: Any) -> list[str]:
    scene = Scene.from_parameters(values, files=FILES)
    return implausible_sizes(scene, scene.starting_state().x, scene.model().masses)


def test_default_scene_is_plausible() -> None:
    scene = Scene.from_parameters({})
    assert cloth_size(scene, scene.starting_state().x, scene.model().masses) == (
        "extent 1.41 m, mass 0.2 kg, clouds resolve 1.2e-07 m"
    )
    assert sentences() == []


def test_mesh_in_millimetres_is_reported_with_remedy() -> None:
    (sentence,) = sentences(**MESH)
    assert sentence == (
        "the mesh 'square.obj' has an extent of 566 m and a mass of 3.2e+04 kg, beyond the usual 0.01 to 20 m: if its "
        "file is not in metres, set cloth.scale (0.001 for millimetres)"
    )
    assert sentences(**MESH, **{"cloth.scale": 0.001}) == []


def test_scale_is_a_factor_of_the_files_coordinates() -> None:
    scaled = Scene.from_parameters({**MESH, "cloth.scale": 0.001}, files=FILES).sheet.positions()
    assert scaled.tolist() == (0.001 * read(SQUARE, name="square.obj").positions).tolist()
    distant = SQUARE.replace(b"400", b"4e8")
    assert len(read(distant, name="square.obj", scale=1e-9).positions) == 4
    with pytest.raises(ValueError, match=r"positions are in metres, so scale the mesh \(cloth.scale\)"):
        read(distant, name="square.obj")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cloth.size": [50.0, 50.0]}, "the cloth has an extent of 70.7 m .*cloth.size, which is in metres"),
        ({"cloth.size": [0.001, 0.001]}, "the cloth has an extent of 0.00141 m"),
        ({"material.density": 200.0}, "the cloth has a mass of 200 kg, beyond the usual 1e-06 to 50 kg: .*density"),
        ({"material.density": 1e-8}, "the cloth has a mass of 1e-08 kg"),
        ({**MESH, "cloth.scale": 1e-6}, r"an extent of 0.000566 m .*set cloth.scale \(e.g. 1000\)"),
    ],
)
def test_implausible_extent_or_mass_is_reported(values: dict[str, Any], words: str) -> None:
    (sentence,) = sentences(**values)
    assert re.search(words, sentence)


def test_cloud_coarser_than_tolerance_is_reported() -> None:
    distant = {"cloth.position": [1e4, 0.0, 1.0], "tolerance": 1e-4}
    (sentence,) = sentences(**distant)
    assert sentence == (
        "clouds resolve 0.00098 m at 1e+04 m from the origin of 'world', coarser than the tolerance of 0.0001 m: "
        "choose a nearer frame (frame_id), or set points.double: true"
    )
    assert sentences(**distant, **{"points.double": True}) == []
    assert sentences(**{**distant, "tolerance": 0.01}) == []
    assert sentences(**{**distant, "tolerance": 0.0}) == []


def test_obstacle_in_millimetres_is_reported_with_remedy() -> None:
    box = {"obstacles": ["box"], "box.shape": "mesh", "box.mesh": "box.obj", "box.position": [0.0, 0.0, -200.0]}
    (sentence,) = sentences(**box)
    assert sentence == (
        "obstacle 'box' has an extent of 139 m, beyond the usual 0.001 to 20 m: if its file is not in metres, set "
        "box.scale (0.001 for millimetres)"
    )
    scaled = {**box, "box.scale": 0.001}
    assert sentences(**scaled) == []
    (solid,) = Scene.from_parameters(scaled, files=FILES).solids
    assert solid.vertices is not None
    assert solid.vertices.max() == 0.08


def test_scale_without_a_mesh_has_no_effect() -> None:
    values = {"cloth.scale": 0.001, "cloth.merge": False}
    assert ineffective_parameters(Scene.from_parameters(values), values) == [
        "cloth.merge is set and has no effect: cloth.mesh is not set",
        "cloth.scale is set and has no effect: cloth.mesh is not set",
    ]
    ball = {"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "ball.scale": 2.0}
    assert ineffective_parameters(Scene.from_parameters(ball), ball) == [
        "ball.scale is set and has no effect: a sphere has no mesh"
    ]
