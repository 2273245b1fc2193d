# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""State files: exact round trips, and refusals that name the fault."""

import io
import re

import numpy as np
import pytest

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Move, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation

SMALL = {"cloth.resolution": [4, 5], "gripper.radius": 0.6}


def saved(grippers=("left", "right")):
    """A state whose first gripper, if any, holds some particles."""
    simulation = Simulation(Scene.from_parameters({**SMALL, "grippers": list(grippers) or [""]}))
    held = [Target(grippers[0], (0.0, 0.0, 0.5)), Grasp(grippers[0], True)] if grippers else []
    simulation.advance(held)
    if grippers:
        assert simulation.grippers.grasped_particles(0).size > 1
    return simulation.state


def archive(arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def test_saved_state_round_trip_is_exact():
    state = saved()
    back = State.from_bytes(state.to_bytes())
    assert back.digest() == state.digest()
    assert back.frame == 1
    bare = State(np.eye(3))
    assert State.from_bytes(bare.to_bytes()).digest() == bare.digest()


def test_a_single_array_is_no_state():
    buffer = io.BytesIO()
    np.save(buffer, np.eye(3))
    for data in (buffer.getvalue(), b"", b"PK", b"PK\x05\x06" + bytes(18)):
        with pytest.raises(ValueError, match="not a state file"):
            State.from_bytes(data)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("frame", lambda a: np.array([1, 2]), "shape (2,); it must be a single int64"),
        ("frame", lambda a: np.array([1]), "shape (1,); it must be a single int64"),
        ("frame", lambda a: np.array(1.0), "of type float64"),
        ("frame", lambda a: np.array(-1), "is -1; it must be at least 0"),
        ("position", lambda a: a.astype(np.float32), "of type float32; it must be float64"),
        ("position", lambda a: a.astype(str), "it must be float64"),
        ("position", lambda a: a.T.copy(), "has shape (20, 3); it must be (3, particle_count)"),
        ("position", lambda a: np.array(1.0), "has shape ()"),
        ("velocity", lambda a: a + 0j, "of type complex128"),
        ("velocity", lambda a: a[:, 1:], "has shape (3, 19)"),
        ("velocity", lambda a: a * np.nan, "velocity of particle 0"),
        ("memory.further", lambda a: np.array(["text"]), "it must be float64, int64 or bool"),
        ("memory.paused", lambda a: np.zeros(2, bool), "has shape (2,); it must be (1,)"),
        ("memory.paused", lambda a: np.zeros(1), "of type float64; it must be bool"),
        ("memory.gripper.placed", lambda a: a[:1], "has shape (1,); it must be (2,)"),
        ("memory.gripper.closed", lambda a: a.astype(np.int64), "it must be bool"),
        ("memory.gripper.pose", lambda a: np.full_like(a, np.inf), "it must be finite"),
        ("memory.gripper.pose", lambda a: a[:, :6], "has shape (2, 6); it must be (2, 7)"),
        ("memory.gripper.pose", lambda a: np.array(1.0), "has shape ()"),
        ("memory.gripper.twist", lambda a: a[:, :5], "it must be (2, 6)"),
        ("memory.gripper.turn", lambda a: a[0], "it must be (2, 6)"),
        ("memory.gripper.target", lambda a: a[:1], "it must be (2, 7)"),
        ("memory.grip.starts", lambda a: a[:-1], "it must be (3,)"),
        ("memory.grip.starts", lambda a: a + 1, "it must ascend from 0"),
        ("memory.grip.starts", lambda a: a[::-1].copy(), "it must ascend from 0"),
        ("memory.grip.starts", lambda a: np.array([0, a[-1] + 5, a[-1]]), "it must ascend from 0"),
        ("memory.grip.particles", lambda a: a * 0 + 20, "names particle 20; there are 20"),
        ("memory.grip.particles", lambda a: a * 0 - 1, "names particle -1; there are 20"),
        ("memory.grip.particles", lambda a: a * 1.0, "it must be int64"),
        ("memory.grip.offsets", lambda a: a[1:], "memory 'grip.offsets' has shape"),
        ("memory.grip.offsets", lambda a: a * np.nan, "it must be finite"),
        ("elsewhere", lambda a: np.zeros(1), "does not belong to a state"),
        ("obstacles", lambda a: np.zeros(1), "it must be names"),
    ],
)
def test_an_array_that_does_not_fit_is_refused_by_name(name, change, words):
    arrays = saved().arrays()
    arrays[name] = change(arrays.get(name))
    with pytest.raises(ValueError, match="not a state file") as caught:
        State.from_bytes(archive(arrays))
    assert words in str(caught.value)
    assert name.removeprefix("memory.") in str(caught.value)


@pytest.mark.parametrize("name", ["frame", "position", "velocity", "memory.gripper.pose", "memory.grip.particles"])
def test_a_missing_array_is_named(name):
    arrays = saved().arrays()
    del arrays[name]
    with pytest.raises(ValueError, match=f"'{name.removeprefix('memory.')}' is missing"):
        State.from_bytes(archive(arrays))


@pytest.mark.parametrize(("had", "has"), [((), ("left",)), (("left",), ()), (("left", "right"), ("left",))])
def test_a_state_with_other_grippers_than_the_scene_is_refused(had, has):
    values = {**SMALL, "grippers": list(has) or [""], "initial_state": "s.npz"}
    with pytest.raises(ParameterError, match=f"initial_state 's.npz' has {len(had)} grippers, the cloth {len(has)}"):
        Scene.from_parameters(values, files={"s.npz": saved(had).to_bytes()})


@pytest.mark.parametrize("names", [(), ("left",), ("left", "right")])
def test_a_state_with_the_scenes_grippers_is_taken(names):
    state = saved(names)
    values = {**SMALL, "grippers": list(names) or [""], "initial_state": "s.npz"}
    loaded = Simulation(Scene.from_parameters(values, files={"s.npz": state.to_bytes()}))
    assert loaded.frame == 0
    np.testing.assert_array_equal(loaded.positions, state.positions)
    loaded.advance()


BALLS = {f"{name}.{leaf}": value for name in "ab" for leaf, value in (("shape", "sphere"), ("size", [0.05]))}


@pytest.mark.parametrize(
    ("kind", "had", "has"),
    [
        ("grippers", ["left", "right"], ["right", "left"]),
        ("grippers", ["left"], ["right"]),
        ("obstacles", ["a", "b"], ["b", "a"]),
        ("obstacles", ["b"], ["a"]),
    ],
)
def test_a_state_with_other_names_of_bodies_is_refused(kind, had, has):
    values = {**SMALL, **BALLS, "a.position": [0.0, 3.0, 0.0], "b.position": [0.0, 4.0, 0.0]}
    values["grippers"] = had if kind == "grippers" else [""]
    simulation = Simulation(Scene.from_parameters(values))
    if kind == "obstacles":
        simulation.advance([SetParameters({"obstacles": had})])
    saved_state = simulation.state.to_bytes()
    values = {**values, kind: has, "initial_state": "s.npz"}
    message = f"initial_state 's.npz' has {kind} {', '.join(had)}, the scene {', '.join(has)}; give them the same names"
    with pytest.raises(ValueError, match=message):
        Simulation(Scene.from_parameters(values, files={"s.npz": saved_state}))
    del values["initial_state"]
    with pytest.raises(ValueError, match=f"the state has {kind}"):
        Simulation(Scene.from_parameters(values), State.from_bytes(saved_state))


@pytest.mark.parametrize("names", [["a", "b"], ["b"], [""]])
def test_reset_follows_obstacles_changed_since_the_initial_state(names):
    values = {**SMALL, **BALLS, "a.position": [0.0, 3.0, 0.0], "b.position": [0.0, 4.0, 0.0], "obstacles": ["a"]}
    before = Simulation(Scene.from_parameters(values))
    before.advance([Move("a", (0.0, 2.9, 0.0))])
    files = {"s.npz": before.state.to_bytes()}
    live = Simulation(Scene.from_parameters({**values, "initial_state": "s.npz"}, files=files))
    live.advance([SetParameters({"obstacles": names})])
    again = Simulation(live.scene, State.from_bytes(live.state.to_bytes()))
    for simulation in (live, again):
        simulation.advance([Reset()])
    assert live.state.digest() == again.state.digest()
    assert (again.obstacles is None) == (names == [""])


QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf {} {} {}\nf {} {} {}\n"
SPRINGS = "positions: [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]\nmasses: 0.1\nsprings: {}\nstiffness: 10.0\n"
#: Cloths of four particles each, by name: parameters, and the file that they name.
CLOTHS = {
    "2 x 2": ({"cloth.resolution": [2, 2]}, {}),
    "mesh": ({"cloth.mesh": "a.obj"}, {"a.obj": QUAD.format(1, 2, 3, 1, 3, 4)}),
    "mesh of the other diagonal": ({"cloth.mesh": "b.obj"}, {"b.obj": QUAD.format(1, 2, 4, 2, 3, 4)}),
    "springs": ({"cloth.springs": "a.yaml"}, {"a.yaml": SPRINGS.format("[[0, 1], [1, 2]]")}),
    "other springs": ({"cloth.springs": "b.yaml"}, {"b.yaml": SPRINGS.format("[[0, 1], [2, 3]]")}),
}


def scene_of(name, state=None, **values):
    parameters, files = CLOTHS[name]
    plain = {"bending.model": "none", "cloth.anchors": ["0"], **parameters, **values}
    files = {path: text.encode() for path, text in files.items()}
    if state is not None:
        plain["initial_state"], files["s.npz"] = "s.npz", state.to_bytes()
    return Scene.from_parameters(plain, files=files)


@pytest.mark.parametrize("had", CLOTHS)
@pytest.mark.parametrize("has", CLOTHS)
def test_state_of_another_cloth_of_equal_size_is_refused(had, has):
    first = Simulation(scene_of(had))
    first.advance()
    if had == has:
        np.testing.assert_array_equal(Simulation(scene_of(has, first.state)).positions, first.positions)
        return
    with pytest.raises(ParameterError, match=r"initial_state 's.npz' is of a (grid|mesh)"):
        scene_of(has, first.state)
    with pytest.raises(ValueError, match="a state only continues the cloth that it was saved from"):
        Simulation(scene_of(has), State.from_bytes(first.state.to_bytes()))


def test_a_state_of_a_turned_grid_is_refused_with_the_reason():
    state = saved()
    values = {**SMALL, "cloth.resolution": [5, 4], "grippers": ["left", "right"], "initial_state": "s.npz"}
    with pytest.raises(ParameterError, match=r"'s\.npz' is of a grid of 4 x 5 particles, the cloth has 5 x 4"):
        Scene.from_parameters(values, files={"s.npz": state.to_bytes()})


def test_state_may_continue_with_other_material_and_layout():
    state = saved()
    values = {**SMALL, "grippers": ["left", "right"], "initial_state": "s.npz"}
    values |= {"cloth.shear_layout": "left", "material.stretch_modulus": 5000.0, "cloth.size": [1.1, 1.1]}
    loaded = Simulation(Scene.from_parameters(values, files={"s.npz": state.to_bytes()}))
    np.testing.assert_array_equal(loaded.positions, state.positions)
    loaded.advance()


def test_state_without_cloth_id_is_matched_by_particle_count():
    state = saved()
    values = {**SMALL, "cloth.resolution": [5, 4], "grippers": ["left", "right"], "initial_state": "s.npz"}
    loaded = Simulation(Scene.from_parameters(values, files={"s.npz": archive(state.arrays())}))
    assert loaded.state.cloth == (5, 4, 0), "from now on it is this one's"


@pytest.mark.parametrize(
    ("cloth", "words"),
    [
        (np.array([4, 5, 0], dtype=np.int32), "of type int32"),
        (np.array([4, 5]), r"shape \(2,\)"),
        (np.array([4, 6, 0]), "4 rows and 6 columns; there are 20"),
        (np.array([-4, -5, 0]), "-4 rows"),
    ],
)
def test_state_file_with_invalid_cloth_id_is_refused(cloth, words):
    with pytest.raises(ValueError, match=f"array 'cloth' .*{words}"):
        State.from_bytes(archive({**saved().arrays(), "cloth": cloth}))


def test_error_estimate_of_an_earlier_version_is_accepted() -> None:
    arrays = saved().arrays()
    name = "memory.control.error_estimate"
    arrays[name] = np.zeros(16)
    arrays[name][[0, 1, 10]] = 1.0
    arrays[name] = arrays[name][:13]
    State.from_bytes(archive(arrays))
    arrays[name] = arrays[name][:12]
    with pytest.raises(ValueError, match=r"shape \(12,\); it must be float64 and \(17,\)"):
        State.from_bytes(archive(arrays))


@pytest.mark.parametrize("name", ["control.stability", "control.error_estimate", "control.choice"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a[:1], "shape"),
        (lambda a: np.append(a, 1.0), "shape"),
        (lambda a: a.reshape(1, -1), "shape"),
        (lambda a: a.astype(np.int64), "it must be float64"),
        (lambda a: np.full_like(a, np.nan), "it must be finite"),
    ],
)
def test_invalid_step_control_memory_is_refused(name, change, words):
    arrays = stepped()
    arrays[f"memory.{name}"] = change(arrays[f"memory.{name}"])
    with pytest.raises(ValueError, match=f"memory '{name}'.*{words}"):
        State.from_bytes(archive(arrays))


@pytest.mark.parametrize(("key", "value"), [(0, 0.0), (1, 0.5), (2, -1.0), (3, -1.0), (10, 0.9)])
def test_invalid_step_control_values_are_refused(key, value):
    arrays = stepped()
    arrays["memory.control.error_estimate"][key] = value
    with pytest.raises(
        ValueError, match=rf"memory 'control.error_estimate': \w+ is {value}; it must be finite and at least"
    ):
        State.from_bytes(archive(arrays))


def test_unknown_controller_memory_is_dropped_and_named():
    arrays = {**saved().arrays(), "memory.stepper": np.ones(16), "memory.sleep": np.array([31, 1])}
    state = State.from_bytes(archive(arrays))
    assert state.dropped_memory == ("stepper", "sleep")
    assert not {"stepper", "sleep"} & state.memory.keys()


def stepped():
    """Arrays of a state with a controller state."""
    simulation = Simulation(Scene.from_parameters(SMALL))
    for _ in range(3):
        simulation.advance()
    arrays = {name: array.copy() for name, array in simulation.state.arrays().items()}
    assert {"memory.control.error_estimate", "memory.control.choice"} <= arrays.keys()
    return arrays


def test_no_flipped_bit_of_a_directory_hides_arrays() -> None:
    simulation = Simulation(Scene.from_parameters({**SMALL, "grippers": ["left"]}))
    simulation.advance([Target("left", (0.0, 0.0, 0.0))])
    data = simulation.state.to_bytes()
    names = set(State.from_bytes(data).memory)
    # The directory is at the end. A flip of a length in an entry hides the entries that follow, or is refused.
    entries = [match.start() for match in re.finditer(b"PK\x01\x02", data)]
    lengths = [entry + offset for entry in entries for offset in range(28, 34)]
    for position in [*lengths, *range(len(data) - 22, len(data))]:
        for bit in range(8):
            flipped = bytearray(data)
            flipped[position] ^= 1 << bit
            try:
                state = State.from_bytes(bytes(flipped))
            except ValueError:
                continue
            assert set(state.memory) == names, (position, bit)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"positions": np.zeros((1, 3)) + 1j}, "positions have complex entries"),
        ({"positions": np.ma.masked_array(np.zeros((1, 3)), mask=[[1, 0, 0]])}, "positions have masked entries"),
        ({"positions": [["a", 0, 0]]}, "positions are"),
        ({"velocities": np.zeros((1, 3)) + 1j}, "velocities have complex entries"),
        ({"frame": 1.5}, "frame is 1.5; it must be a whole number of frames"),
        ({"frame": 2**70}, "it must be a whole number of frames, from 0 to 9223372036854775807"),
        ({"frame": -1}, "frame is -1"),
        ({"memory": {"a": [1, 2]}}, "memory 'a' is of type list"),
        ({"memory": {"a": np.zeros(2, np.float32)}}, "memory 'a' is of type float32"),
        ({"memory": {"a": np.array([object()])}}, "memory 'a' is of type object"),
        ({"memory": {"a": np.array([1.0, np.nan])}}, "memory 'a' holds nan; it must be finite"),
    ],
)
def test_what_is_no_state_is_refused(options, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        State(**{"positions": np.zeros((1, 3)), **options})
    assert State([[1, 2, 3]], frame=np.int64(3), memory={"a": np.array([True])}).frame == 3
