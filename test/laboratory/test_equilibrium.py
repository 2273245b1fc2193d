# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relaxation of scenes to their equilibrium."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.laboratory.equilibrium import MAX_RESIDUAL, LaboratoryError, find_equilibrium
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

SHEET = {"cloth.size": [0.2, 0.2], "cloth.resolution": [6, 6], "grippers": [""], "material.stretch_modulus": 200.0}


def sheet(**values: object) -> Scene:
    return Scene.from_parameters({**SHEET, **values})


def test_hanging_sheet_stretches_by_its_weight() -> None:
    # Springs along the columns alone carry the weight: extension w L² / 2 E.
    scene = sheet(**{"material.shear_modulus": 0.0, "bending.model": "none"})
    equilibrium = find_equilibrium(scene)
    assert equilibrium.is_converged
    assert equilibrium.residual < MAX_RESIDUAL
    extension = np.ptp(equilibrium.positions[:, 2]) - 0.2
    assert extension == pytest.approx(0.2 * 9.81 * 0.2**2 / (2.0 * 200.0), rel=0.01)


def test_equilibrium_is_one_for_the_simulation_too() -> None:
    scene = sheet(**{"cloth.orientation": [0.0, 0.0, 0.0, 1.0]})
    equilibrium = find_equilibrium(scene, max_residual=1e-6)
    assert equilibrium.is_converged
    simulation = Simulation(scene)
    simulation.state.x = np.ascontiguousarray(equilibrium.positions.T)
    for _ in range(30):
        simulation.advance()
    assert np.abs(simulation.positions - equilibrium.positions).max() < 1e-5


def test_loading_time_does_not_change_a_single_equilibrium() -> None:
    scene = sheet()
    fast, slow = (
        find_equilibrium(scene, max_residual=1e-5),
        find_equilibrium(scene, loading_time=0.5, max_residual=1e-5),
    )
    assert slow.time > 0.5
    assert np.abs(fast.positions - slow.positions).max() < 1e-6


def test_drag_acts_once_the_load_is_complete() -> None:
    # Both move alike while the load grows. The times differ because oscillations decay at half of the drag.
    scene = sheet()
    slow, fast = (find_equilibrium(scene, loading_time=0.1, drag=drag, max_residual=1e-5) for drag in (4.0, 16.0))
    assert slow.is_converged
    assert fast.is_converged
    assert fast.time < 0.7 * slow.time
    assert np.abs(fast.positions - slow.positions).max() < 1e-6


def test_start_moves_anchored_particles() -> None:
    scene = sheet(**{"gravity": [0.0, 0.0, 0.0]})
    start = scene.initial_positions() + np.array([0.0, 0.0, 0.05])
    equilibrium = find_equilibrium(scene, start)
    assert np.abs(equilibrium.positions - start).max() < 1e-12


def test_end_without_rest_is_told() -> None:
    equilibrium = find_equilibrium(sheet(**{"cloth.orientation": [0.0, 0.0, 0.0, 1.0]}), max_time=0.1)
    assert not equilibrium.is_converged
    assert equilibrium.residual > MAX_RESIDUAL


def test_wind_is_refused() -> None:
    with pytest.raises(LaboratoryError, match=r"wind\.velocity"):
        find_equilibrium(sheet(**{"wind.velocity": [1.0, 0.0, 0.0]}))
