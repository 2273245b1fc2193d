# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fabrics by name and from files, and parameters of warp and weft."""

import numpy as np
import pytest

from cloth_sim_ros.physics.model.sheets.material import grid_threads
from cloth_sim_ros.physics.model.sheets.surface import grid_triangles
from cloth_sim_ros.scene import sheet_checks
from cloth_sim_ros.scene.fabrics import fabrics, read_fabric, with_changes
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: A mesh in the x-y plane: 6 x 6 particles, cut as a checkerboard.
_CORNERS = grid_triangles(6, 6, "alternating")[:, ::-1] + 1
MESH = "\n".join(
    [f"v {0.1 * (k % 6)} {-0.1 * (k // 6)} 0" for k in range(36)] + [f"f {a} {b} {c}" for a, b, c in _CORNERS]
).encode()
FILE = b"""
title: my cotton
source: own measurement
licence: CC0-1.0
drape_coefficient: [0.6, 0.7]
thickness: 4.0e-4
parameters:
  material.density: 0.15
  material.stretch_modulus: 800.0
  material.bending_modulus: 5.0e-6
  bending.model: crossed
"""


def test_every_fabric_has_a_source_and_makes_a_cloth():
    assert len(fabrics()) == 10
    for name, fabric in fabrics().items():
        assert fabric.title and fabric.source and fabric.licence, name
        scene = Scene.from_parameters({"material.fabric": name, "cloth.resolution": [8, 8]})
        assert scene.material.density == fabric.parameters["material.density"]
        assert scene.membrane.model == "triangles"
        simulation = Simulation(scene)
        simulation.advance([])
        assert np.isfinite(simulation.positions).all()


def test_fabric_makes_a_mesh_too():
    for name in ("denim", "polyester_twill"):
        values = {"material.fabric": name, "cloth.mesh": "sheet.obj", "cloth.anchors": ["0"]}
        names = [f.name for f in Scene.from_parameters(values, files={"sheet.obj": MESH}).model().forces]
        assert {"membrane", "crossed"} <= set(names)


def test_every_fabric_takes_a_shape_operator():
    oblique = {"bending.model": "shape_operator", "material.warp_direction": [1.0, 2.0, 0.0]}
    for name in fabrics():
        grid = Scene.from_parameters({"material.fabric": name, "cloth.resolution": [8, 8], **oblique})
        mesh = {"cloth.mesh": "sheet.obj", "cloth.anchors": ["0"]}
        scenes = [grid, Scene.from_parameters({"material.fabric": name, **oblique, **mesh}, files={"sheet.obj": MESH})]
        for scene in scenes:
            assert "shape_operator" in [force.name for force in scene.model().forces], name


@pytest.mark.parametrize(
    ("values", "remedy"),
    [
        ({}, "or choose bending.model 'shape_operator'"),
        ({"membrane.model": "springs", "bending.model": "shape_operator"}, "or choose membrane.model 'triangles'"),
    ],
)
def test_oblique_threads_of_a_grid_name_a_model(values, remedy):
    with pytest.raises(ParameterError, match=remedy):
        Scene.from_parameters({"material.fabric": "denim", "material.warp_direction": [1.0, 1.0, 0.0], **values})


def test_set_parameters_override_the_fabric():
    scene = Scene.from_parameters({"material.fabric": "denim", "material.density": 0.5, "membrane.model": "springs"})
    assert (scene.material.density, scene.membrane.model) == (0.5, "springs")
    assert scene.material.bending_modulus == fabrics()["denim"].parameters["material.bending_modulus"]
    changed = scene.changed({"material.stretch_modulus": 123.0})
    assert (changed.material.stretch_modulus, changed.material.density) == (123.0, 0.5)


def test_fabric_of_a_file_is_part_of_the_scene(tmp_path):
    (tmp_path / "cotton.yaml").write_bytes(FILE)
    scene = Scene.from_parameters({"material.fabric": "cotton.yaml"}, folder=tmp_path)
    assert scene.material.stretch_modulus == 800.0
    assert scene.files == {"cotton.yaml": FILE}
    # A recorded scene needs no file on disk.
    assert Scene.from_parameters(scene.parameters(), files=scene.files).material == scene.material
    fabric = read_fabric("cotton.yaml", FILE)
    assert (fabric.drape_coefficient, fabric.thickness, fabric.licence) == ((0.6, 0.7), 4e-4, "CC0-1.0")


def test_unknown_fabric_is_refused_with_the_list():
    with pytest.raises(ParameterError, match=r"material\.fabric is 'silk'; it must be one of .*denim.*path of a file"):
        Scene.from_parameters({"material.fabric": "silk"})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"parameters: {material.stretch_modulus: -5.0}", r"material\.stretch_modulus is -5\.0 N/m; it must be above"),
        (b"parameters: {material.densty: 1.0}", r"unknown parameter 'material\.densty'; did you mean"),
        (b"parameters: {cloth.size: [1.0, 1.0]}", r"unknown parameter 'cloth\.size'"),
        (b"parameters: {material.fabric: denim}", r"unknown parameter 'material\.fabric'"),
        (b"parameters: {material.density: 1}", "is the whole number 1"),
        (b"title: x", "it has no parameters"),
        (b"parameters: {}\ncolour: red", "unknown field 'colour'"),
        (b"parameters: {}\ntitle: 3", "title is 3; it must be a text"),
        (b"parameters: {}\nthickness: 0.0", r"thickness is 0\.0"),
        (b"parameters: {}\ndrape_coefficient: [0.9, 0.1]", "smallest and the largest"),
        (b"[1, 2", "is no YAML"),
        (b"\xff\xfe", "is no text in UTF-8"),
    ],
)
def test_faults_of_a_fabric_file_name_the_file(content, words):
    with pytest.raises(ParameterError, match=rf"^material\.fabric 'f\.yaml'.*{words}"):
        Scene.from_parameters({"material.fabric": "f.yaml"}, files={"f.yaml": content})


def test_missing_fabric_file_is_named(tmp_path):
    with pytest.raises(ParameterError, match=r"material\.fabric: cannot read '.*none\.yaml'"):
        Scene.from_parameters({"material.fabric": "./none.yaml"}, folder=tmp_path)


@pytest.mark.parametrize("layout", ["both", "alternating", "left"])
def test_springs_of_a_grid_have_both_moduli(layout):
    """Compliance of the network: C11, C22 from edge and diagonal threads, C12 = G."""
    hx, hy, g = 0.03, 0.05, 40.0
    threads = grid_threads(stretch_modulus=(500.0, 200.0), shear_modulus=g, spacing=(hx, hy), layout=layout)
    length = np.hypot(hx, hy)
    families = 2.0 if layout == "both" else 1.0
    diagonal = threads.diagonal / (hx * hy / length) * families
    c, s = hx / length, hy / length
    tensor = diagonal * np.array([[c**4, c**2 * s**2, 0], [c**2 * s**2, s**4, 0], [0, 0, c**2 * s**2]])
    if layout == "left":
        tensor[0, 2] = tensor[2, 0] = -diagonal * c**3 * s
        tensor[1, 2] = tensor[2, 1] = -diagonal * c * s**3
    tensor[0, 0] += threads.along_rows / hy
    tensor[1, 1] += threads.along_columns / hx
    compliance = np.linalg.inv(tensor)
    assert (1 / compliance[0, 0], 1 / compliance[1, 1]) == pytest.approx((500.0, 200.0), rel=1e-9)
    assert -compliance[0, 1] / compliance[0, 0] == pytest.approx(threads.poisson_ratio, abs=1e-9)


def test_warp_along_rows_exchanges_the_threads():
    weft = {"material.stretch_modulus_weft": 300.0, "bending.stiffness_weft": 1.0}
    down = Scene.from_parameters(weft).threads()
    across = Scene.from_parameters({**weft, "material.warp_direction": [-2.0, 0.0, 0.5]}).threads()
    exchanged = across.along_columns, across.bend_along_columns
    assert (down.along_rows, down.bend_along_rows) == pytest.approx(exchanged, rel=1e-12)
    assert down.along_columns > 3.0 * down.along_rows


OBLIQUE = {"material.warp_direction": [1.0, 1.0, 0.0]}
ACROSS = {"material.warp_direction": [0.0, 0.0, 1.0]}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({**OBLIQUE, "material.stretch_modulus_weft": 300.0}, "a grid's springs follow its rows and columns"),
        ({**OBLIQUE, "bending.stiffness_weft": 1.0}, r"bending\.stiffness is 2\.0 along the warp"),
        ({**OBLIQUE, "membrane.model": "triangles"}, r"bending\.model axial follows the grid's rows"),
        ({"material.warp_direction": [0.0, 0.0, 0.0]}, "give a direction"),
        ({"material.warp_direction": [0.0, 0.0, 1.0], "membrane.model": "triangles"}, "in its plane"),
        ({**ACROSS, "material.stretch_modulus_weft": 300.0}, "perpendicular to the grid, and material.stretch_modulus"),
        ({**ACROSS, "bending.stiffness_weft": 1.0}, "perpendicular to the grid, and bending.stiffness is 2.0 along"),
        (
            {"membrane.model": "triangles", "material.poisson_ratio": 0.9, "material.stretch_modulus_weft": 4000.0},
            r"material\.poisson_ratio is 0\.9; it must be between -0\.49999975 and",
        ),
        (
            {"membrane.model": "triangles", "material.poisson_ratio": -1.0 + 2e-16},
            r"material\.poisson_ratio is -0\.9999999999999998; it must be between -0\.9999995 and 0\.9999995",
        ),
        (
            {"material.bending_modulus_weft": 1e-5},
            r"material\.bending_modulus_weft is 1e-05 N m: bending model 'axial'",
        ),
        (
            {"material.fabric": "denim", "bending.model": "axial"},
            "of the fabric 'denim': .*; or set material.bending_modulus and material.bending_modulus_weft to 0.0",
        ),
        (
            {"bending.model": "crossed", "material.bending_modulus": 1e-5, "material.bending_modulus_weft": 2e-5}
            | OBLIQUE,
            r"material\.bending_modulus is 1e-05 along the warp",
        ),
    ],
)
def test_threads_that_a_grid_lacks_are_refused(values, words):
    with pytest.raises(ParameterError, match=words):
        Scene.from_parameters(values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"material.stretch_modulus_weft": 300.0}, "springs of a mesh are alike in all directions"),
        (
            {"bending.model": "crossed", "material.bending_modulus": 1e-5, "material.bending_modulus_weft": 1e-10},
            r"material\.bending_modulus_weft is 1e-10 N m .* the hinges of this mesh reach",
        ),
    ],
)
def test_threads_that_a_mesh_lacks_are_refused(values, words):
    common = {"cloth.mesh": "sheet.obj", "cloth.anchors": ["0"], "bending.model": "none"}
    with pytest.raises(ParameterError, match=words):
        Scene.from_parameters({**common, **values}, files={"sheet.obj": MESH})


def test_triangles_of_raw_springs_are_refused():
    springs = (
        b"positions: [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]\nmasses: [1.0, 1.0]\nsprings: [[0, 1]]\nstiffness: [1.0]\n"
    )
    values = {"cloth.springs": "s.yaml", "bending.model": "none", "cloth.anchors": ["0"], "membrane.model": "triangles"}
    with pytest.raises(ParameterError, match=r"'triangles' is not for cloth\.springs"):
        Scene.from_parameters(values, files={"s.yaml": springs})


def test_poisson_ratio_of_springs_has_no_effect():
    scene = Scene.from_parameters({"material.poisson_ratio": 0.2, "material.warp_direction": [1.0, 1.0, 0.0]})
    sentences = ineffective_parameters(scene, ["material.poisson_ratio", "material.warp_direction"])
    assert [sentence.partition(" ")[0] for sentence in sentences] == [
        "material.poisson_ratio",
        "material.warp_direction",
    ]


def test_axial_bending_keeps_the_moduli_of_triangles():
    """The springs two apart add 2 B along each axis, which the triangles leave out."""
    moduli = []
    for model in ("none", "axial"):
        scene = Scene.from_parameters({"membrane.model": "triangles", "bending.model": model})
        moduli.append(scene.model().force("membrane").moduli)
    assert moduli[0] - moduli[1] == pytest.approx([4.0, 0.0, 4.0, 0.0])


def test_changed_fabric_replaces_the_former_one():
    before = Scene.from_parameters({"material.fabric": "denim", "material.damping": 0.2}).parameters()
    values = with_changes(before, {"material.fabric": "wool_twill", "air.drag": 0.5}, {})
    scene = Scene.from_parameters(values)
    expected = Scene.from_parameters({"material.fabric": "wool_twill", "material.damping": 0.2, "air.drag": 0.5})
    assert scene == expected, "denim's Poisson's ratio is gone"
    assert with_changes(before, {"air.drag": 0.5}, {}) == {**before, "air.drag": 0.5}


def test_unchanged_threads_are_checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene.from_parameters({"material.fabric": "denim", "material.density": 0.3071})
    checks: list[float] = []
    monkeypatch.setattr(sheet_checks, "membrane_forces", lambda scene, _: checks.append(scene.material.density))
    scene.changed({"gravity": [0.0, 0.0, -5.0]})
    assert not checks
    scene.changed({"material.density": 0.3072})
    assert checks == [0.3072]
