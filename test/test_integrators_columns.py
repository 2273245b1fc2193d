# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs that start from arrays which stay as they are, and what of them a large sheet does not keep."""

import numpy as np
import pytest

from cloth_sim_ros.events import Grasp, Target
from cloth_sim_ros.physics.dynamics import Economy
from cloth_sim_ros.physics.integrators import columns
from cloth_sim_ros.physics.integrators.march import leapfrog
from cloth_sim_ros.physics.surface import grid_triangles
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation

SIDE = 18
SCENES = {
    "grid": {"cloth.resolution": [SIDE, SIDE]},
    "mesh": {"cloth.mesh": "sheet.obj", "cloth.anchors": ["0", "17"], "bending.model": "none"},
}
every_scene = pytest.mark.parametrize("values", SCENES.values(), ids=SCENES.keys())


def sheet_file():
    line = np.linspace(-0.5, 0.5, SIDE)
    points = [f"v {x} {y} 0" for y in line for x in line]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in grid_triangles(SIDE, SIDE, "alternating")]
    return "\n".join([*points, *faces]).encode()


def started(values):
    scene = Scene.from_parameters(values, files={"sheet.obj": sheet_file()})
    simulation = Simulation(scene)
    rng = np.random.default_rng(2)
    free = simulation.model.inverse_masses > 0
    simulation.state.x[:, free] += 5e-3 * rng.standard_normal((3, int(free.sum())))
    simulation.state.v[:, free] += 0.3 * rng.standard_normal((3, int(free.sum())))
    return simulation


@every_scene
@pytest.mark.parametrize("how", ["double", "single", "by terms"])
def test_a_run_from_other_arrays_gives_the_bits_of_one_in_place_and_leaves_them(values, how):
    simulation = started(values)
    dynamics, x, v = simulation.dynamics, simulation.state.x, simulation.state.v
    economy = Economy(narrow=how == "single")
    if how == "by terms":
        dynamics.plan = None
    before = x.copy(), v.copy()
    here = x.copy(), v.copy()
    leapfrog(dynamics, 0.0, *here, 1e-4, 9, economy=economy)
    there = np.full_like(x, np.nan), np.full_like(v, np.nan)
    leapfrog(dynamics, 0.0, *there, 1e-4, 9, economy=economy, start=(x, v))
    alone = np.full_like(x, np.nan)
    leapfrog(dynamics, 0.0, alone, None, 1e-4, 9, economy=economy, start=(x, v))
    assert np.array_equal(x, before[0])
    assert np.array_equal(v, before[1])
    assert np.array_equal(here[0], there[0])
    assert np.array_equal(here[1], there[1])
    assert np.array_equal(here[0], alone)
    assert np.abs(here[0] - x).max() > 1e-5


@every_scene
@pytest.mark.parametrize("tolerance", [1e-4, 1e-8], ids=["coarse", "fine"])
def test_what_a_large_sheet_does_not_keep_changes_no_bit(values, tolerance, monkeypatch):
    """Several runs are combined, and some that judged are part of the result after all."""
    digests, combined = [], 0
    for large in (10**9, 1):
        monkeypatch.setattr(columns, "LARGE", large)
        simulation = started({**values, "tolerance": tolerance, "integrator": "extrapolated"})
        for frame in range(4):
            events = [Target("gripper", simulation.positions[-1]), Grasp("gripper", True)] if frame == 2 else []
            done = simulation.advance(events)
            combined = max(combined, done.advance.reason.count(" runs"))
        digests.append(simulation.state.digest())
    assert digests[0] == digests[1]
    assert combined, "several runs were combined"


def test_a_large_sheet_compares_combinations_stretch_by_stretch(monkeypatch):
    simulation = started(SCENES["grid"])
    counts = columns.step_counts(40, 4)
    found = []
    for large, stretch in ((10**9, 4096), (1, 50), (1, 4096)):
        monkeypatch.setattr(columns, "LARGE", large)
        monkeypatch.setattr(columns, "_STRETCH", stretch)
        runs = columns.Columns(simulation.dynamics, simulation.state, 0.0, 1 / 60, counts, taken=4)
        found.append([runs.difference(k) for k in (1, 2, 3)])
        found.append([float(np.abs(part).sum()) for part in runs.combine(4)])
    assert found[0] == found[2] == found[4]
    assert found[1] == found[3] == found[5]


def test_a_large_sheets_runs_serve_one_result(monkeypatch):
    simulation = started(SCENES["grid"])
    counts = columns.step_counts(40, 4)
    for large, often in ((10**9, True), (1, False)):
        monkeypatch.setattr(columns, "LARGE", large)
        runs = columns.Columns(simulation.dynamics, simulation.state, 0.0, 1 / 60, counts, taken=2)
        assert runs.finite(2)
        assert [runs.serves(k) for k in (1, 2, 3)] == [often, True, often]
        runs.combine(2)
        assert runs.serves(2) is often
