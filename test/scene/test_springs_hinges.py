# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hinges (S7, S8, S9) of raw springs with triangles."""

import numpy as np
import pytest
from support.raw_nets import chain_tables, net_tables, springs_scene

from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

MODULUS = {"material.bending_modulus": 1e-4}
MODELS = ["opposite", "crossed", "altitude"]


def mesh_of(tables):
    """Return the OBJ file of the triangles of a springs file."""
    lines = ["v " + " ".join(map(str, p)) for p in tables["positions"]]
    lines += ["f " + " ".join(str(i + 1) for i in t) for t in tables["triangles"]]
    return "\n".join(lines).encode()


def values_of(model):
    return {"bending.model": model, **(MODULUS if model != "opposite" else {})}


@pytest.mark.parametrize("model", MODELS)
def test_hinges_of_raw_springs_are_those_of_the_mesh(model):
    tables = net_tables(4)
    raw = springs_scene(tables, **values_of(model)).model()
    mesh = {"cloth.mesh": "m.obj", "cloth.anchors": [""], **values_of(model)}
    sheet = Scene.from_parameters({**mesh, "material.damping": 0.0}, files={"m.obj": mesh_of(tables)}).model()
    for force in raw.forces:
        if force.name not in ("opposite", "crossed", "altitude"):
            continue
        expected = sheet.force(force.name)
        assert force.stiffness == pytest.approx(expected.stiffness, rel=1e-9)
        assert force.rest_length == pytest.approx(expected.rest_length, rel=1e-9)
        assert force.damped
    assert {force.name for force in raw.forces} >= ({model, "opposite"})


@pytest.mark.parametrize("model", MODELS)
def test_rest_lengths_make_the_hinges_not_a_stretched_start(model):
    tables = net_tables(3)
    lengths = np.linalg.norm(np.diff(np.array(tables["positions"])[tables["springs"]], axis=1)[:, 0], axis=1).tolist()
    stretched = (1.3 * np.array(tables["positions"])).tolist()
    natural = springs_scene(tables, **values_of(model)).model().forces
    pulled = (
        springs_scene({**tables, "positions": stretched, "rest_lengths": lengths}, **values_of(model)).model().forces
    )
    for reference, force in zip(natural[:3], pulled[:3], strict=True):
        if hasattr(reference, "rest_length"):
            assert force.rest_length == pytest.approx(reference.rest_length, rel=1e-9, abs=1e-15)
            assert force.stiffness == pytest.approx(reference.stiffness, rel=1e-9)


def test_folded_net_unfolds_to_its_rest_angle():
    tables = net_tables(2)
    tables["positions"] = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.05], [0.0, 0.1, 0.05], [0.1, 0.1, 0.0]]
    calm = {"gravity": [0.0] * 3, "air.drag": 2.0, "material.damping": 0.5}
    for angle in (0.0, 0.6):
        angles = {"bending.rest_angle": angle} if angle else {}
        simulation = Simulation(springs_scene(tables, **values_of("altitude"), **angles, **calm))
        for _ in range(300):
            simulation.advance()
        hinges = simulation.scene.sheet.surface.hinges
        shape, start = (HingeShape.of(hinges, x) for x in (simulation.positions, tables["positions"]))
        fold = np.arctan2(shape.sine, shape.cosine)
        expected = angle or np.arctan2(start.sine, start.cosine)
        assert fold == pytest.approx(expected, abs=0.02)


def test_pair_with_a_spring_gets_no_opposite_spring():
    tables = net_tables(2)
    both = {**tables, "springs": [*tables["springs"], [1, 2]]}
    models = [springs_scene(t, **values_of("crossed")).model() for t in (tables, both)]
    assert [len(model.force("opposite").pairs) for model in models] == [1, 0]


@pytest.mark.parametrize(
    ("tables", "values", "words"),
    [
        (chain_tables(), values_of("crossed"), "choose none, or give the springs file triangles"),
        (net_tables(3), {"bending.model": "axial"}, "choose none, opposite, crossed, altitude or quadratic"),
        (net_tables(3), {"bending.model": "crossed"}, "needs material.bending_modulus above 0 N m"),
        (
            {**net_tables(3), "triangles": [[0, 1, 4], [0, 1, 3]]},
            values_of("crossed"),
            "table 'triangles': triangles 0 and",
        ),
        ({**net_tables(3), "rest_lengths": [0.2] + [0.05] * 15}, values_of("altitude"), "m of a triangle at hinge"),
        ({**net_tables(3), "rest_lengths": 0.0}, values_of("altitude"), "the sides 0, 0, 0 m of a triangle at hinge 0"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_unsuitable_hinges_are_refused(tables, values, words):
    with pytest.raises(ParameterError) as caught:
        springs_scene(tables, **values)
    assert words in str(caught.value)


def test_bending_parameters_have_an_effect_with_hinges():
    parameters = {**values_of("crossed"), "bending.rest_angle": 0.3, "material.damping": 0.3}
    assert ineffective_parameters(springs_scene(net_tables(3), **parameters), parameters) == []
    plain = {**parameters, "bending.model": "none"}
    sentences = ineffective_parameters(springs_scene(net_tables(3), **plain), plain)
    assert len(sentences) == 3
    assert all(sentence.endswith("of its own, and bending.model is none") for sentence in sentences)
