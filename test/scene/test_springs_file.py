# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw springs as a scene: S1, S2 and S4 from a file."""

import io
import zipfile

import numpy as np
import pytest

from cloth_sim_ros.scene import springs_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

JOINT = """
positions: [[0, 0, 0], [0.3, 0, 0], [1.3, 0, 0]]
masses: 0.2
springs: [[0, 1], [1, 2]]
rest_lengths: [0, 1]
stiffness: [50, 20]
k_d0: [0.4, 0]
velocities: [[0, 0, 0], [0, 0, 0], [0, 2, 0]]
"""
BARE = {"bending.model": "none", "cloth.anchors": ["0"], "cloth.position": [0.0] * 3, "gravity": [0.0] * 3}
FLAT = {"cloth.orientation": [0.0, 0.0, 0.0, 1.0], "air.drag": 0.0, "grippers": [""]}


def scene(text=JOINT, **values):
    content = text.encode() if isinstance(text, str) else text
    return Scene.from_parameters({**BARE, **FLAT, "cloth.springs": "s.yaml", **values}, files={"s.yaml": content})


def test_springs_file_sets_masses_springs_joints_velocities():
    system = scene()
    model = system.model()
    assert [force.name for force in model.forces] == ["springs"]
    assert model.masses == pytest.approx([0.2, 0.2, 0.2])
    spring = model.forces[0]
    assert spring.rest_length == pytest.approx([0.0, 1.0])
    assert spring.stiffness == pytest.approx([50.0, 20.0])
    assert spring.damping == pytest.approx([0.4 * np.sqrt(0.2 * 50.0), 0.0])
    assert system.shape == (1, 3)
    assert system.starting_state().velocities[2] == pytest.approx([0, 2, 0])


def test_an_unanchored_system_keeps_its_momentum():
    simulation = Simulation(scene(**{"cloth.anchors": [""], "tolerance": 1e-5}))
    for _ in range(30):
        simulation.advance()
    assert simulation.velocities.sum(axis=0) == pytest.approx([0, 2, 0], abs=1e-12)


def test_npz_and_yaml_are_the_same_system():
    buffer = io.BytesIO()
    np.savez(
        buffer,
        positions=[[0, 0, 0], [0.3, 0, 0], [1.3, 0, 0]],
        masses=0.2,
        springs=[[0, 1], [1, 2]],
        rest_lengths=[0, 1],
        stiffness=[50, 20],
        k_d0=[0.4, 0],
        velocities=[[0, 0, 0], [0, 0, 0], [0, 2, 0]],
    )
    from_yaml, from_npz = Simulation(scene()), Simulation(scene(buffer.getvalue()))
    for _ in range(5):
        from_yaml.advance()
        from_npz.advance()
    assert from_yaml.state.digest() == from_npz.state.digest()


def test_the_content_is_kept_when_the_file_is_gone(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(JOINT)
    loaded = Scene.from_parameters({**BARE, **FLAT, "cloth.springs": "s.yaml"}, folder=tmp_path)
    path.unlink()
    assert loaded.changed({"gravity": [0.0, 0.0, -1.0]}).shape == (1, 3)
    with pytest.raises(ParameterError, match=r"cloth\.springs: cannot read .*s\.yaml.*No such file"):
        Scene.from_parameters({**BARE, **FLAT, "cloth.springs": "s.yaml"}, folder=tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("masses: 0.2", "masses: -0.2"), "mass of particle 0 is -0.2"),
        (("masses: 0.2", "weights: 0.2"), "unknown table 'weights'"),
        (("stiffness: [50, 20]", "stiffness: [50, 20, 3]"), "'stiffness' has 3 numbers; give one, or 2"),
        (("[1, 2]]", "[1, 3]]"), "names particle 3; there are 3"),
        (("[1, 2]]", "[1, -2]]"), "row 1 of table 'springs' names particle -2; there are 3"),
        (("masses: 0.2", f"masses: 1{'0' * 400}"), "table 'masses' is no table of numbers"),
        (("[1, 2]]", "[1, 1]]"), "joins particle 1 to itself"),
        (("[1, 2]]", "[1, 1.5]]"), "row 1 of table 'springs'"),
        (("[0, 2, 0]]", "[0, .nan, 0]]"), "row 2 of table 'velocities'"),
        (("rest_lengths: [0, 1]", "rest_lengths: [0, -1]"), r"rest_length of 'springs'[1] is -1.0"),
        (("k_d0: [0.4, 0]", "k_d0: 1\nk_d: 1"), "give one of them"),
        (("springs: [[0, 1], [1, 2]]", ""), "table 'springs' is missing"),
        (("positions:", "positions: ["), "no YAML"),
    ],
)
def test_tables_that_make_no_system_are_refused_by_name(change, words):
    assert change[0] in JOINT
    with pytest.raises(ParameterError, match=r"s\.yaml") as caught:
        scene(JOINT.replace(*change, 1)).model()
    assert words in str(caught.value)


def test_a_broken_archive_is_refused():
    with pytest.raises(ValueError, match=r"no \.npz"):
        springs_file.parse(b"PK\x03\x04 broken")


def archive(**tables):
    buffer = io.BytesIO()
    np.savez(buffer, **tables)
    return buffer.getvalue()


@pytest.mark.parametrize("header", [b"{'descr': '<f8', (((", b"{'descr': " + b"[" * 2000, b"\x00\xff", b"'"])
def test_an_archive_whose_array_header_is_broken_is_refused(header):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        file.writestr("positions.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(ValueError, match=r"no \.npz"):
        springs_file.parse(buffer.getvalue())


def test_damaged_archive_raises_value_error_or_is_harmless():
    whole = archive(positions=np.eye(3), masses=0.2, springs=[[0, 1], [1, 2]], stiffness=1.0)
    random = np.random.default_rng(5)
    refused = 0
    for _ in range(400):
        data = bytearray(whole)
        for offset in random.integers(len(data), size=3):
            data[offset] = random.integers(256)
        try:
            springs_file.parse(bytes(data))
        except ValueError:
            refused += 1
    assert refused > 100


def test_complex_tables_are_refused():
    tables = {"positions": np.eye(3), "masses": 0.2, "springs": [[0, 1]], "stiffness": 1.0}
    for name in tables:
        with pytest.raises(ValueError, match=f"table '{name}' is no table of numbers: they are complex"):
            springs_file.parse(archive(**{**tables, name: np.asarray(tables[name]) + 1j}))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"bending.model": "axial"}, "bending.model 'axial' is not for this cloth; choose none"),
        ({"cloth.anchors": ["top"]}, "only a grid has edges"),
        ({"cloth.mesh": "m.obj"}, "both cloth.mesh"),
    ],
)
def test_options_unsuitable_for_raw_springs_are_refused(values, words):
    with pytest.raises(ParameterError, match=words):
        Scene.from_parameters(
            {**BARE, **FLAT, "cloth.springs": "s.yaml", **values}, files={"s.yaml": JOINT.encode(), "m.obj": b""}
        )
