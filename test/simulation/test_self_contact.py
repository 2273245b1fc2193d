# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact of a cloth with itself in scenes: `contact.self`."""

import numpy as np
import pytest
from support.self_scenes import alone, folded, intersections, sheets

from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import IntegratorChoiceState
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

BASE_VALUES = {
    "cloth.resolution": [12, 12],
    "cloth.size": [0.3, 0.3],
    "cloth.anchors": [""],
    "contact.self": True,
    "contact.thickness": 0.004,
    "obstacles": ["table"],
    "table.shape": "plane",
    "table.position": [0.0, 0.0, -0.003],
}


def scene(**values):
    return Scene.from_parameters({**BASE_VALUES, **{name.replace("__", "."): value for name, value in values.items()}})


def fold(scene):
    """Simulation of a scene whose sheet starts folded and falls on itself."""
    _, places, velocities = folded(12)
    state = Simulation(scene).state.copy()
    state.x, state.v = State(places, velocities).x, State(places, velocities).v
    return Simulation(scene, state)


@pytest.mark.parametrize("self_contact", [True, False])
def test_sheet_intersects_itself_only_without_self_contact(self_contact):
    simulation, watch = fold(scene(contact__self=self_contact)), fold(scene())
    met = passed = 0
    for _ in range(30):
        before = simulation.state.x
        simulation.advance()
        met += simulation.plan.contact.self_gaps(simulation.state.x)[0]
        passed += watch.plan.contact.ccd_surface_hits(
            0.0, 0.0, before, simulation.state.x, memory=simulation.state.memory
        )
    assert bool(met) == self_contact
    assert bool(passed) != self_contact


def test_a_run_goes_on_from_a_saved_state_with_the_same_bits():
    simulation = fold(scene())
    for _ in range(8):
        simulation.advance()
    again = Simulation(simulation.scene, State.from_bytes(simulation.state.to_bytes()))
    for _ in range(6):
        simulation.advance()
        again.advance()
    assert simulation.state.digest() == again.state.digest()


def test_self_contact_without_obstacles_reports_no_wrench():
    alone = scene(obstacles=[""])
    simulation = fold(alone)
    frame = simulation.advance()
    assert frame.obstacle_wrenches.shape == (0, 6)
    assert len(simulation.gaps()) == 0
    assert not any(
        "contact" in sentence for sentence in ineffective_parameters(alone, ["contact.thickness", "contact.self"])
    )
    off = scene(obstacles=[""], contact__self=False)
    assert any("contact.self is false" in sentence for sentence in ineffective_parameters(off, ["contact.thickness"]))


def test_invalid_self_contact_is_refused():
    with pytest.raises(ParameterError, match=r"contact\.thickness is 0\.02 m, more than half .* shortest edge"):
        scene(obstacles=[""], contact__thickness=0.02)
    with pytest.raises(ParameterError, match=r"contact\.self is 1, of type int; it must be bool"):
        scene(contact__self=1)
    with pytest.raises(ParameterError, match=r"contact\.self can't change"):
        fold(scene()).scene.changed({"contact.self": False})


def test_self_contact_combines_with_other_parameters():
    values = scene().parameters()
    assert values["contact.self"] is True
    assert Scene.from_parameters(values).contact.self_
    assert not np.isnan(values["contact.thickness"])


def test_self_intersecting_start_is_refused_with_location(tmp_path):
    places = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (2, 0.5, 1), (0.3, 0.5, -0.5)]
    lines = [f"v {x} {y} {z}" for x, y, z in places] + ["f 1 2 3", "f 2 4 3", "f 2 5 4", "f 2 6 5"]
    path = tmp_path / "through.obj"
    path.write_text("\n".join(lines) + "\n")
    values = {
        "cloth.mesh": str(path),
        "bending.model": "none",
        "cloth.anchors": [""],
        "cloth.position": [0.0, 0.0, 0.0],
    }
    with pytest.raises(
        ValueError, match=r"the cloth passes through itself at \[.*\]: the edge from particle 4 to 5 goes"
    ):
        Simulation(Scene.from_parameters({**values, "contact.self": True}))
    Simulation(Scene.from_parameters(values))
    path.write_text("\n".join(lines).replace("0.3 0.5 -0.5", "0.3 0.5 1.5") + "\n")
    Simulation(Scene.from_parameters({**values, "contact.self": True}))


@pytest.mark.parametrize(
    ("gap", "words"),
    [
        (
            0.0,
            r"the cloth is 0 m from itself near particle \d+ at \[.*\] and the triangle of particles \d+, \d+, \d+; ",
        ),
        (
            3e-5,
            r"the cloth is 3e-05 m from itself near .* 8e-05 m at least, 0.02 of .*: move its layers 0.00397 m apart",
        ),
        (9e-5, ""),
    ],
)
def test_start_too_close_to_itself_is_refused_with_location(gap, words):
    # The half beyond the middle row lies mirrored on the other one.
    flat = {"obstacles": [""], "cloth__orientation": [0.0, 0.0, 0.0, 1.0]}
    places = Simulation(scene(**flat)).positions
    beyond = places[:, 0] > 0.0
    places[beyond, 0] *= -1.0
    places[beyond, 2] += gap
    if not words:
        assert Simulation(scene(**flat), State(places)).plan.contact.self_gaps(State(places).x)[0] > 0
        return
    with pytest.raises(ValueError, match=words):
        Simulation(scene(**flat), State(places))
    Simulation(scene(**flat, contact__self=False), State(places))


def test_self_intersecting_state_is_refused():
    flat = {"obstacles": [""], "cloth__orientation": [0.0, 0.0, 0.0, 1.0]}
    places = Simulation(scene(**flat)).positions
    places[0] = places[66] + [0.008, -0.004, 0.01]
    places[1] = places[66] + [0.008, -0.004, -0.01]
    with pytest.raises(ValueError, match=r"passes through itself at \[.*\]: the edge from particle \d+ to \d+ goes"):
        Simulation(scene(**flat), State(places))


@pytest.mark.parametrize("seed", range(3))
def test_self_intersection_check_equals_brute_force(seed):
    triangles, rest_positions, x, masses = sheets(
        0.0, 0.0, shift=(0.003, 0.004), rough=[1e-3, 1e-9, 3e-3][seed], seed=seed
    )
    x[25:, 2] += [3e-3, 1e-3, 1e-3][seed]
    plan = compile(alone(triangles, rest_positions, masses, 4e-3))
    crossing = intersections(triangles, x)
    assert bool(crossing) == (seed == 2)
    if crossing:
        with pytest.raises(ValueError, match="passes through itself"):
            plan.contact.check_initial_penetration(0.0, np.ascontiguousarray(x.T), memory={})
    else:
        plan.contact.check_initial_penetration(0.0, np.ascontiguousarray(x.T), memory={})


@pytest.mark.parametrize("self_contact", [True, False])
def test_layers_in_reach_end_implicit_steps(self_contact):
    """A sheet that is too stiff for explicit steps in real time starts folded on itself."""
    simulation = fold(scene(contact__self=self_contact, material__stretch_modulus=3e7, material__damping=0.02))
    for _ in range(2):
        simulation.advance()
        assert bool(IntegratorChoiceState.load(simulation.state).is_implicit) != self_contact
