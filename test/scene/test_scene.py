# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters, parameter files, scenes."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene

CONFIG = Path(__file__).parents[2] / "config"


def test_every_parameter_is_described_and_its_default_is_valid():
    entries = Scene.declared()
    assert len({entry.name for entry in entries}) == len(entries) > 20
    for entry in entries:
        assert len(entry.description) > 10, entry.name
        assert entry.check(entry.default) == entry.default, entry.name


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"rate": 60}, "rate is the whole number 60; it is a double: write 60.0"),
        ({"rate": "fast"}, "rate is 'fast', of type str; it must be double"),
        ({"rate": float("inf")}, "rate is inf; it must be finite"),
        ({"cloth.size": [1.0, -2.0]}, "cloth.size is -2.0 m; it must be at least 1e-06 m"),
        ({"cloth.size": [1e-7, 1.0]}, "cloth.size is 1e-07 m; it must be at least 1e-06 m"),
        ({"cloth.size": [1.0]}, "cloth.size has 1 entries"),
        ({"cloth.size": 1.0}, "it must be an array of double"),
        ({"cloth.size": np.float64(1.0)}, "it must be an array of double"),
        ({"cloth.size": np.array(1.0)}, "it must be an array of double"),
        ({"cloth.size": np.ones((2, 2))}, "it must be an array of double"),
        ({"cloth.size": np.ones((2, 1))}, "it must be an array of double"),
        ({"cloth.size": [np.ones(2), np.ones(2)]}, "of type ndarray; it must be double[]"),
        ({"cloth.resolution": b"ab"}, "it must be an array of int"),
        ({"cloth.resolution": [10**5000, 2]}, "cloth.resolution is a whole number of 16610 bits"),
        ({"rate": 10**400}, "rate is a whole number of 1329 bits"),
        ({"cloth.mesh": "a\0b.obj"}, "cloth.mesh 'a\\x00b.obj' is no file name"),
        ({"material.density": 1e-10}, "material.density is 1e-10 kg/m^2; it must be at least 1e-09 kg/m^2"),
        ({"cloth.resolution": [1, 1]}, "cloth.resolution is 1; it must be at least 2"),
        ({"cloth.resolution": [4096, 4096]}, "makes 16777216 particles; at most 4000000"),
        ({"cloth.resolution": [True, 3]}, "of type bool"),
        ({"cloth.anchors": ["middle"]}, "'middle' is no edge or corner"),
        ({"cloth.anchors": ["900"]}, "names particle 900; there are 900, counted from 0"),
        ({"cloth.anchors": ["9" * 5000]}, "names particle 99999999999999999999... (5000 digits); there are 900"),
        ({"cloth.orientation": [0.0, 0.0, 0.0, 0.0]}, "cloth.orientation: orientation"),
        ({"cloth.shear_layout": "up"}, "must be one of left, right, alternating, both"),
        ({"material.stretch_modulus": 1.0, "material.shear_modulus": 1.0, "bending.stiffness": 5.0}, "no edge springs"),
        ({"grippers": ["a", "a"]}, "two grippers are named 'a'"),
        ({"grippers": ["2 hands"]}, "is no ROS name"),
        ({"bending.model": "opposite", "material.bending_modulus": 1e-4}, "'opposite' has no bending modulus"),
        ({"bending.model": "axial", "material.bending_modulus": 1e-4}, "'axial' has no bending modulus"),
        ({"bending.model": "crossed"}, "'crossed' needs material.bending_modulus above 0"),
        ({"bending.rest_angle": 4.0}, "bending.rest_angle is 4.0 rad; it must be at most 3.14 rad"),
        ({"frame_id": ""}, "frame_id is empty"),
        ({"gravty": [0.0, 0.0, 0.0]}, "unknown parameter 'gravty'; did you mean 'gravity'"),
    ],
)
def test_invalid_scene_is_refused_with_value_limit_and_remedy(values, words):
    with pytest.raises(ParameterError) as caught:
        Scene.from_parameters(values)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"rate": 0.0}, "rate is 0.0 Hz; it must be at least 0.1 Hz"),
        (
            {"membrane": sections.MembraneParameters(model="triangle")},
            "membrane.model is 'triangle'; it must be one of",
        ),
        ({"gripper": sections.GripperParameters(radius=-1.0)}, "gripper.radius is -1.0 m; it must be at least"),
        ({"bending": sections.BendingParameters(model="Crossed")}, "bending.model is 'Crossed'; it must be one of"),
    ],
)
def test_constructor_refuses_what_parameters_may_not_be(fields, words):
    with pytest.raises(ParameterError) as caught:
        Scene(**fields)
    assert words in str(caught.value)


@given(
    st.fixed_dictionaries(
        {
            "material.density": st.floats(0.01, 100),
            "material.stretch_modulus": st.floats(1, 1e6),
            "cloth.position": st.lists(st.floats(-10, 10), min_size=3, max_size=3),
            "cloth.anchors": st.lists(st.sampled_from(["top", "left", "bottom_right", "7"]), min_size=1, max_size=3),
            "bending.stiffness": st.just(0.0),
            "material.shear_modulus": st.just(0.25),
        }
    )
)
def test_a_scene_survives_its_parameter_file_to_the_last_bit(values):
    scene = Scene.from_parameters(values)
    text = parameter_file.dump(scene.parameters())
    assert Scene.from_parameters(parameter_file.parse(text)) == scene


def test_node_section_overrides_wildcard_section():
    text = "/**:\n  ros__parameters: {rate: 30.0, air: {drag: 1.0}}\ncloth_sim:\n  ros__parameters: {rate: 20.0}\n"
    assert parameter_file.parse(text) == {"rate": 20.0, "air.drag": 1.0}
    assert parameter_file.parse(text, node="other")["rate"] == 30.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("/**: {ros__parameters: {a: [", "is not YAML"),
        ("just words", "is no parameter file"),
        ("/n*/cloth_sim:\n  ros__parameters: {}", "wildcard"),
        ("cloth_sim:\n  rate: 3.0", "no 'ros__parameters:'"),
    ],
)
def test_a_broken_parameter_file_is_refused(text, words):
    with pytest.raises(ParameterError, match=words):
        parameter_file.parse(text)


def test_a_missing_parameter_file_is_named(tmp_path):
    with pytest.raises(ParameterError, match="cannot read parameter file"):
        parameter_file.read(tmp_path / "none.yaml")


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.name)
def test_shipped_parameter_files_make_scenes(path):
    if "ros__parameters" in path.read_text():
        Scene.from_file(path).model()


def test_unused_forces_are_not_in_the_model():
    bare = Scene.from_parameters(
        {
            "gravity": [0.0, 0.0, 0.0],
            "air.drag": 0.0,
            "wind.normal_drag": 0.0,
            "grippers": [""],
            "bending.model": "none",
            "material.shear_modulus": 0.0,
            "material.damping": 0.0,
        }
    ).model()
    assert [force.name for force in bare.forces] == ["structural"]
    assert not bare.forces[0].damped


def test_mass_is_density_times_area_and_top_edge_is_anchored():
    scene = Scene.from_parameters({"cloth.size": [0.7, 1.3], "cloth.resolution": [5, 11]})
    assert scene.model().masses.sum() == pytest.approx(0.2 * 0.7 * 1.3)
    positions = scene.initial_positions()
    top = positions[scene.anchored_particles()]
    assert top[:, 2] == pytest.approx(1.0 + 0.35)
    assert np.ptp(positions, axis=0) == pytest.approx([1.3, 0.0, 0.7], abs=1e-12)


@pytest.mark.parametrize(
    ("model", "names"),
    [
        ("none", []),
        ("axial", ["bend"]),
        ("opposite", ["opposite"]),
        ("crossed", ["opposite", "crossed"]),
        ("altitude", ["opposite", "altitude"]),
        ("quadratic", ["quadratic"]),
        ("shape_operator", ["shape_operator"]),
    ],
)
def test_bending_model_adds_only_its_forces(model, names):
    modulus = 1e-4 if model in sections.MODULUS_MODELS else 0.0
    values = {"bending.model": model, "material.bending_modulus": modulus, "cloth.resolution": [5, 6]}
    forces = [force.name for force in Scene.from_parameters(values).model().forces]
    assert forces == ["structural", "shear", *names, "gravity", "drag", "air", "grips"]


def test_viscosity_replaces_damping_and_converges():
    def damping(rows):
        values = {"material.viscosity": 0.5, "cloth.resolution": [rows, rows]}
        return Scene.from_parameters(values).model().force("structural").pair_springs.damping.max()

    # k_d = (k_s / l0) viscosity / Y does not change with the resolution; constant k_d0 would halve it.
    assert damping(9) == pytest.approx(damping(5), rel=1e-12)


def test_resulting_poisson_ratio_is_reported():
    assert Scene().poisson_ratio == Scene().threads().poisson_ratio == pytest.approx(0.099, abs=1e-3)
    assert Scene.from_parameters({"cloth.shear_layout": "left"}).poisson_ratio == 0.0


def test_axial_bending_of_a_mesh_is_refused_with_its_models():
    content = {"a.obj": b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"}
    with pytest.raises(ParameterError, match="choose none, opposite, crossed, altitude, shape_operator or quadratic"):
        Scene.from_parameters({"cloth.mesh": "a.obj", "bending.model": "axial"}, files=content)
