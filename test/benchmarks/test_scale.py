# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Large sheets: nothing is made that they do not need, and the command that measures them."""

import json

import pytest

from benchmarks.__main__ import main
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.integrators import stage_matrix
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation


def test_the_cost_of_a_matrix_is_known_before_it_is_made():
    scene = Scene.from_parameters({"cloth.resolution": [40, 40]})
    matrix = stage_matrix.stage_matrix(scene.model())
    rows, width = matrix.size
    assert rows == 39 * 40
    assert 40 <= width <= 45
    assert "_rows" not in vars(matrix._matrix)


def test_a_sheet_too_large_for_implicit_frames_asks_for_no_matrix(monkeypatch):
    scene = Scene.from_parameters({"cloth.resolution": [12, 12]})

    def refuse(_model):
        raise AssertionError("a matrix was asked for")

    monkeypatch.setattr(stage_matrix, "stage_matrix", refuse)
    monkeypatch.setattr(CONSTANTS, "operation", 1e3)
    with pytest.raises(AssertionError, match="a matrix was asked for"):
        Simulation(scene).advance()
    monkeypatch.setattr(CONSTANTS, "implicit", 100.0)
    Simulation(scene).advance()


@pytest.mark.parametrize("kind", ["grid", "mesh"])
def test_a_small_run_tells_time_and_memory(kind, tmp_path):
    file = tmp_path / "scale.json"
    main(["scale", "--kinds", kind, "--sizes", "16", "24", "--seconds", "0.05", "--rounds", "1", "--json", str(file)])
    time, memory = json.loads(file.read_text())["tables"]
    assert [row[:2] for row in time["rows"]] == [[kind, 256], [kind, 576]]
    for row in memory["rows"]:
        state, forces, tables = row[4:7]
        # Positions and velocities; while all is calm, where a second ago it was.
        assert 0.95 * 48e-6 < state / row[1] < 1.1 * 72e-6
        assert forces == pytest.approx(row[1] * 24e-6)
        assert tables > state
