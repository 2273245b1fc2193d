# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Self-contact without intersection in any frame, by ipctk and by exact arithmetic.

`test/soak_contact.py` looks at a million steps.
"""

import numpy as np
import pytest

pytest.importorskip("ipctk")

import soak_contact
from support import self_runs
from support.self_scenes import folded, intersections


def test_oracles_detect_intersections():
    scene = self_runs.scene(12, 12, (0.3, 0.3))
    _, places, velocities = folded(12)
    oracle, upper = self_runs.Oracle(scene), velocities[:, 2] < 0.0
    for tilt, passes in ((0.0, False), (0.1, False), (0.5, True)):
        tilted = places.copy()
        tilted[upper, 2] += tilt * places[upper, 1]
        assert oracle.is_intersecting(tilted) == passes
        assert bool(intersections(oracle.triangles, tilted)) == passes


@pytest.mark.parametrize(
    ("run", "options", "met"),
    [
        (self_runs.fold, {}, 500),
        (self_runs.three_layers, {"frames": 32}, 300),
        (self_runs.fall_on_an_edge, {}, 50),
        (self_runs.twist, {"turns": 1.5}, 20),
        (self_runs.crush, {}, 500),
        (self_runs.mesh_with_a_hole, {"count": 120, "frames": 40}, 20),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_frames_do_not_self_intersect(run, options, met):
    result = run(np.random.default_rng(1), **options)
    simulation, oracle = result.simulation, self_runs.Oracle(result.simulation.scene)
    for events in result.events:
        simulation.advance(events)
        assert not oracle.observe(simulation)
    assert oracle.n_contacts > met
    assert not intersections(oracle.triangles, simulation.positions)


def test_soak_reports_intersections(monkeypatch, capsys):
    arguments = ["--steps", "1", "--scenes", "crush between plates"]
    assert soak_contact.main(arguments) == 0
    assert "0 in which a cloth passes through itself" in capsys.readouterr().out
    monkeypatch.setattr(self_runs.Oracle, "is_intersecting", lambda _oracle, _x: True)
    assert soak_contact.main(arguments) == 1
    assert "passes through itself in frame 1" in capsys.readouterr().err
