# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The matrix of implicit steps: its cost is known before it is made, and no large sheet asks for one."""

import pytest

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators import implicit_advance, stage_matrix
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation


def test_the_cost_of_a_matrix_is_known_before_it_is_made():
    scene = Scene.from_parameters({"cloth.resolution": [40, 40]})
    matrix = stage_matrix.stage_matrix(scene.model())
    rows, width = matrix.size
    assert rows == 39 * 40
    assert 40 <= width <= 45
    # private: memory is not public
    assert "_rows" not in vars(matrix._matrix)


def test_sheet_above_implicit_limit_builds_no_matrix(monkeypatch):
    scene = Scene.from_parameters({"cloth.resolution": [12, 12]})

    def refuse(_model):
        raise AssertionError("unexpected stage matrix")

    # It takes the function by its name: were it first imported now, it would keep the replacement.
    monkeypatch.setattr(implicit_advance, "stage_matrix", refuse)
    monkeypatch.setattr(stage_matrix, "stage_matrix", refuse)
    monkeypatch.setattr(CONSTANTS, "operation_time", 1e3)
    with pytest.raises(AssertionError, match="unexpected stage matrix"):
        Simulation(scene).advance()
    monkeypatch.setattr(CONSTANTS, "implicit_max_particles", 100.0)
    Simulation(scene).advance()
