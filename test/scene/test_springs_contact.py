# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact of raw springs with obstacles, and with themselves if they have triangles."""

import json

import numpy as np
import pytest
from support.raw_nets import BALL, VALUES, chain_tables, net_tables, springs_scene, two_nets

from cloth_sim_ros.ros.check import check
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.parameter_file import dump
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation


def gaps_to_ball(simulation, frames):
    """Return the least distance of any particle from the ball's surface in each frame [m]."""
    gaps = []
    for _ in range(frames):
        simulation.advance()
        x, y, z = simulation.state.x
        gaps.append(float(np.sqrt(x * x + y * y + z * z).min()) - 0.1)
    return gaps


@pytest.mark.parametrize("tables", [chain_tables(), net_tables()], ids=["chain", "net"])
def test_raw_springs_fall_on_a_ball(tables):
    scene = springs_scene(tables, **{**BALL, "cloth.position": [0.0, 0.0, 0.15], "contact.thickness": 0.01})
    gaps = gaps_to_ball(Simulation(scene), 40)
    assert 0.0 < min(gaps) < 0.01


def test_ball_smaller_than_a_cell_holds_a_net():
    tables = net_tables()
    border = [str(i) for i, (x, y, _) in enumerate(tables["positions"]) if max(abs(x), abs(y)) > 0.19]
    # The ball is below the triangle of particles 33, 34 and 43.
    values = {**BALL, "ball.size": [0.012], "ball.position": [0.132, -0.034, 0.0], "cloth.anchors": border}
    simulation = Simulation(springs_scene(tables, **values, **{"cloth.position": [0.0, 0.0, 0.02]}))
    for _ in range(30):
        simulation.advance()
    height = simulation.state.x[2, [33, 34, 43]].mean()
    assert height > 0.012 > simulation.state.x[2].min()


def test_chain_meets_an_obstacle_that_is_added_later():
    values = {**BALL, "cloth.position": [0.0, 0.0, 0.15], "obstacles": [""]}
    simulation = Simulation(springs_scene(chain_tables(), **values))
    simulation.advance()
    simulation.advance([SetParameters({"obstacles": ["ball"]})])
    assert 0.0 < min(gaps_to_ball(simulation, 40)) < simulation.scene.contact.thickness


def test_layers_of_nets_stay_apart():
    # The upper net falls on the lower one, whose particles are anchored.
    for touches_itself in (False, True):
        values = {"contact.self": touches_itself, "cloth.anchors": [str(i) for i in range(25)]}
        simulation = Simulation(springs_scene(two_nets(5, gap=0.04), **values, **{"contact.thickness": 0.02}))
        gaps = []
        for _ in range(30):
            simulation.advance()
            gaps.append(float(simulation.state.x[2, 25:].min()) - simulation.scene.cloth.position[2])
        assert (min(gaps) > 0.0) == touches_itself


def test_edges_have_rest_lengths_not_starting_distances():
    tables = net_tables(3)
    stretched = {**tables, "positions": (2.0 * np.array(tables["positions"])).tolist(), "rest_lengths": 0.2}
    sheet = springs_scene(stretched).sheet
    assert sheet.edge_lengths() == pytest.approx(np.full((8, 3), 0.2))
    with pytest.raises(ParameterError, match=r"more than half the cloth's shortest edge, 0\.2 m"):
        springs_scene(stretched, **{"contact.self": True, "contact.thickness": 0.11})


def test_edges_without_spring_have_starting_distances():
    tables = net_tables(3)
    sheet = springs_scene({**tables, "springs": [[0, 1]], "rest_lengths": 0.1}).sheet
    lengths = sheet.edge_lengths()
    assert lengths[0] == pytest.approx([0.1, 0.2, 0.2 * 2**0.5])


def test_compressed_net_finds_as_many_pairs_as_at_rest():
    counts = []
    for rest_length in (0.05, 1e12):
        scene = springs_scene({**net_tables(), "rest_lengths": rest_length}, **{"contact.self": True})
        simulation = Simulation(scene)
        simulation.state.v[0] += np.linspace(0.0, 100.0, 81)
        counts.append(simulation.plan.contact.operation_count(0.0, 0.01, simulation.state))
    assert counts[0] == counts[1]


def test_work_limit_counts_contact_that_begins_in_a_frame():
    scene = springs_scene({**net_tables(), "rest_lengths": 10.0}, **{"contact.self": True, "contact.thickness": 0.02})
    simulation = Simulation(scene)
    advance, plan = simulation.advance().advance, simulation.plan
    assert advance.limited_by == "work"
    evaluation_time = 1e-9 * plan.multirate_step_cost(1) * plan.model.particle_count
    allowed_without_contact = scene.work_limit * scene.period / evaluation_time
    assert advance.evaluations < 0.6 * allowed_without_contact


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (chain_tables(), "contact.self needs a surface, and the file of cloth.springs has none"),
        ({**net_tables(), "triangles": [[0, 1, 9], [1, 2, 2]]}, r"row 1 of table 'triangles'.* is \[1, 2, 2\]"),
        (
            {**net_tables(), "triangles": [[0, 1, 9], [0, 1, 2]]},
            r"row 1 .* is \[0, 1, 2\]; it has no area at the start",
        ),
        ({**net_tables(3), "positions": [[0.0] * 3] * 9, "rest_lengths": 0.1}, "row 0 .* it has no area at the start"),
        ({**net_tables(3), "springs": [[1, 4]], "rest_lengths": 0.0}, "row 0 .* a joint is one of its edges: remove"),
    ],
)
def test_self_contact_without_surface_is_refused(tables, words):
    with pytest.raises(ParameterError, match=words):
        springs_scene(tables, **{"contact.self": True})


def test_check_names_the_particles_that_touch(tmp_path, capsys):
    (tmp_path / "s.yaml").write_text(json.dumps(chain_tables()))
    values = {**VALUES, **BALL, "cloth.springs": str(tmp_path / "s.yaml")}
    (tmp_path / "scene.yaml").write_text(dump(values))
    assert check.check(str(tmp_path / "scene.yaml"), node="cloth_sim") == 0
    assert "only particles touch: the file of cloth.springs has no triangles" in capsys.readouterr().out
