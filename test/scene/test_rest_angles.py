# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rest angles of hinges: flat for a curved mesh, and by edge from a file."""

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from support.raw_nets import net_tables, springs_scene

from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.ros.check import check
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.parameter_file import dump
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: A gutter: three strips of two triangles each, whose long edges 2-3 and 4-5 are folded by 0.5 rad.
CORNERS = [
    (-0.1 - 0.1 * math.cos(0.5), 0.1 * math.sin(0.5)),
    (-0.1, 0.0),
    (0.0, 0.0),
    (0.1 * math.cos(0.5), 0.1 * math.sin(0.5)),
]
GUTTER = "\n".join(
    [f"v {x!r} {y} {z!r}" for x, z in CORNERS for y in (0.0, 0.1)]
    + [f"f {2 * k + 1} {2 * k + 3} {2 * k + 4}\nf {2 * k + 1} {2 * k + 4} {2 * k + 2}" for k in range(3)]
).encode()
MESH = {
    "cloth.mesh": "m.obj", "cloth.anchors": [""], "grippers": [""], "bending.model": "altitude",
    "material.bending_modulus": 1e-4, "material.stretch_modulus": 100.0, "material.damping": 0.5,
    "gravity": [0.0] * 3, "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
}  # fmt: skip


def gutter_scene(angles=None, **values):
    files = {"m.obj": GUTTER}
    if angles is not None:
        files["a.yaml"] = angles if isinstance(angles, bytes) else json.dumps(angles).encode()
        values = {"bending.rest_angles": "a.yaml", **values}
    return Scene.from_parameters({**MESH, **values}, files=files)


def folds(scene, x):
    """Return the folds of the hinges of a mesh [rad], by edge."""
    hinges = scene.sheet.surface.hinges
    shape = HingeShape.of(hinges, x)
    edges = (tuple(sorted(edge)) for edge in hinges[:, :2].tolist())
    return dict(zip(edges, np.arctan2(shape.sine, shape.cosine).tolist(), strict=True))


def settled(scene, frames=400):
    """Return the folds after some frames, by edge."""
    simulation = Simulation(scene)
    for _ in range(frames):
        simulation.advance()
    return folds(scene, simulation.positions)


def test_curved_mesh_keeps_its_curvature_or_becomes_flat():
    scene = gutter_scene()
    assert folds(scene, scene.sheet.positions())[2, 3] == pytest.approx(0.5, abs=1e-9)
    assert settled(scene, 10)[2, 3] == pytest.approx(0.5, abs=1e-9)
    flat = gutter_scene(**{"bending.flat": True})
    assert not flat.model().force("altitude").rest_length.any()
    assert max(map(abs, settled(flat).values())) < 0.01


def test_edges_of_a_file_have_their_own_rest_angles():
    tables = {"edges": [[3, 2], [4, 5]], "angles": [-0.4, 0.9]}
    expected = {(2, 3): -0.4, (4, 5): 0.9, (0, 3): 0.0, (2, 5): 0.0, (4, 7): 0.0}
    assert settled(gutter_scene(tables)) == pytest.approx(expected, abs=0.02)
    # The other hinges take those of the rest shape, or are flat.
    for flat, angle in ((False, 0.5), (True, 0.0)):
        final = settled(gutter_scene({"edges": [[4, 5]], "angles": 0.9}, **{"bending.flat": flat}))
        assert final == pytest.approx({**expected, (2, 3): angle}, abs=0.02)


def test_yaml_and_npz_are_the_same_angles():
    buffer = io.BytesIO()
    np.savez(buffer, edges=[[2, 3]], angles=[0.7])
    forces = [
        gutter_scene(content).model().force("altitude")
        for content in (buffer.getvalue(), {"edges": [[2, 3]], "angles": 0.7})
    ]
    assert forces[0].rest_length.tolist() == forces[1].rest_length.tolist()


def test_edge_of_a_grid_has_hinges_of_both_triangulations():
    values = {"cloth.resolution": [4, 4], "bending.model": "crossed", "material.bending_modulus": 1e-4}
    files = {"a.yaml": b"edges: [[5, 6]]\nangles: 0.5\n"}
    force = Scene.from_parameters({**values, "bending.rest_angles": "a.yaml"}, files=files).model().force("crossed")
    folded = force.hinges[force.rest_length != 0.0]
    assert np.sort(folded[:, :2], axis=1).tolist() == [[5, 6], [5, 6]]


def test_raw_springs_take_rest_angles():
    values = {"bending.model": "altitude", "material.bending_modulus": 1e-4, "bending.rest_angles": "a.yaml"}
    scene = springs_scene(net_tables(3), **{"bending.model": "none"})
    files = {**scene.files, "a.yaml": b"edges: [[1, 4]]\nangles: 0.5\n"}
    force = Scene.from_parameters({**scene.parameters(), **values}, files=files).model().force("altitude")
    assert np.sort(force.hinges[force.rest_length != 0.0][:, :2], axis=1).tolist() == [[1, 4]]


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        (
            {"edges": [[0, 1]], "angles": 0.0},
            "row 0 of table 'edges' is [0, 1], which is no edge between two triangles",
        ),
        ({"edges": [[2, 3], [3, 2]], "angles": 0.0}, "rows 0 and 1 of table 'edges' are one edge"),
        ({"edges": [[2, 3]], "angles": [3.2]}, "row 0 of table 'angles' is 3.2 rad; it must lie between -π and π"),
        ({"edges": [[2, 3]], "angles": [0.1, 0.2]}, "table 'angles' has 2 numbers; give one, or 1"),
        ({"edges": [[2, 3]]}, "table 'angles' is missing"),
        ({"edges": [[2, 3]], "angles": 0.0, "folds": 1}, "unknown table 'folds'; there are edges, angles"),
        (b"[1, 2]", "it has no tables; it needs edges and angles"),
    ],
)
def test_invalid_rest_angles_are_refused(angles, words):
    with pytest.raises(ParameterError, match=r"bending\.rest_angles 'a\.yaml': ") as caught:
        gutter_scene(angles)
    assert words in str(caught.value)


def test_flat_and_an_angle_are_refused():
    with pytest.raises(ParameterError, match=r"bending\.flat is true and bending\.rest_angle 0\.5 rad; set one"):
        gutter_scene(**{"bending.flat": True, "bending.rest_angle": 0.5})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"bending.flat": True}, "hinges rest flat\n"),
        ({"bending.rest_angle": 0.5}, "hinges rest at 0.5 rad\n"),
        ({"bending.rest_angles": "a.yaml"}, "hinges rest as in the rest shape, single edges by a.yaml\n"),
        ({}, ""),
    ],
)
def test_check_reports_the_rest_angles(values, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("m.obj").write_bytes(GUTTER)
    Path("a.yaml").write_text("edges: [[2, 3]]\nangles: 0.5\n")
    Path("scene.yaml").write_text(dump({**MESH, **values}))
    assert check.check("scene.yaml", node="cloth_sim") == 0
    report = capsys.readouterr().out
    assert words in report if words else "hinges rest" not in report


def test_flat_grid_is_reported_as_without_effect():
    values = {"bending.flat": True, "bending.model": "crossed", "material.bending_modulus": 1e-4}
    (sentence,) = ineffective_parameters(Scene.from_parameters(values), values)
    assert sentence == "bending.flat is set and has no effect: a grid is flat at rest"
