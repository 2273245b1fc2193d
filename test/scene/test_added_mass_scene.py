# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes with added mass: their force, refusals, swing, and changes while the cloth runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene, SetParameters, Simulation
from cloth_sim_ros.physics.model.forces.added_mass import AddedMass
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters

CHAIN = b"positions: [[0, 0, 1], [0, 0, 2]]\nmasses: [1.0, 1.0]\nsprings: [[0, 1]]\nstiffness: 10.0\n"
TRIANGLES = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
GRID: dict[str, Any] = {"cloth.resolution": [4, 5], "air.added_mass": 0.07, "wind.velocity": [1.0, 2.0, 3.0]}


def added_mass(scene: Scene) -> list[AddedMass]:
    return [force for force in scene.model().forces if isinstance(force, AddedMass)]


def test_cells_of_a_grid_carry_air() -> None:
    (force,) = added_mass(Scene.from_parameters(GRID))
    assert (force.density, force.wind.tolist(), force.panels.shape) == (0.07, [1.0, 2.0, 3.0], (12, 4))
    assert not added_mass(Scene.from_parameters({"cloth.resolution": [4, 5]}))


def test_triangles_of_a_mesh_carry_air() -> None:
    values = {"cloth.mesh": "sheet.obj", "bending.model": "none", "air.added_mass": 0.1, "cloth.anchors": ["0"]}
    scene = Scene.from_parameters(values, files={"sheet.obj": TRIANGLES})
    (force,) = added_mass(scene)
    assert force.panels.shape == (2, 3)
    # The mass of the air is the density times the area.
    x = np.ascontiguousarray(scene.initial_positions().T)
    assert scene.plan().mass_blocks(x)[:3].sum() == pytest.approx(0.1)


def test_raw_springs_with_added_mass_are_refused() -> None:
    values = {"cloth.springs": "chain.yaml", "bending.model": "none", "cloth.anchors": ["0"], "air.added_mass": 0.1}
    with pytest.raises(ParameterError, match=r"air.added_mass is 0.1 kg/m\^2 and needs a surface; .* set it to 0"):
        Scene.from_parameters(values, files={"chain.yaml": CHAIN})


@pytest.mark.parametrize("value", [-0.1, 11.0, float("nan")])
def test_added_mass_out_of_range_is_refused(value: float) -> None:
    with pytest.raises(ParameterError, match=r"air\.added_mass"):
        Scene.from_parameters({"air.added_mass": value})


def test_wind_has_an_effect_on_carried_air() -> None:
    names = {**GRID, "wind.normal_drag": 0.0, "air.drag": 0.0}
    with_air, without = (Scene.from_parameters({**names, "air.added_mass": value}) for value in (0.07, 0.0))
    assert not any("wind.velocity" in text for text in ineffective_parameters(with_air, {"wind.velocity"}))
    assert any("wind.velocity" in text for text in ineffective_parameters(without, {"wind.velocity"}))


def test_example_of_the_package_carries_air() -> None:
    scene = Scene.from_file(Path(__file__).parents[2] / "config" / "swing.yaml")
    assert scene.air.added_mass / scene.material.density == pytest.approx(0.344, abs=0.003)


def swing_period(ratio: float) -> float:
    """Quarter of the period of a small swing of a hung cloth [s], for a ratio of air to cloth."""
    values = {
        "cloth.size": [0.3, 0.3],
        "cloth.resolution": [7, 7],
        "cloth.anchors": ["top"],
        "material.density": 0.2,
        "air.added_mass": 0.2 * ratio,
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
        "rate": 240.0,
    }
    scene = Scene.from_parameters(values)
    state = scene.starting_state()
    top = state.x[2].max()
    state.x[1] += 0.02 * (top - state.x[2])
    cloth, before = Simulation(scene, state), 1.0
    start = state.x[1].mean() - scene.initial_positions()[:, 1].mean()
    for frame in range(1, 240):
        cloth.advance([])
        now = (cloth.state.x[1].mean() - scene.initial_positions()[:, 1].mean()) / start
        if now < 0.0:
            return (frame - now / (now - before)) / 240.0
        before = now
    raise AssertionError("the cloth does not swing")


def test_air_slows_the_swing_of_a_cloth() -> None:
    assert swing_period(0.344) / swing_period(0.0) == pytest.approx(1.344**0.5, rel=0.01)


def test_changes_equal_a_new_start() -> None:
    cloth = Simulation(Scene.from_parameters(GRID))
    for frame in range(20):
        events = [SetParameters({"wind.velocity": [0.0, -2.0, 1.0]})] if frame == 5 else []
        events += [SetParameters({"air.added_mass": 0.2})] if frame == 10 else []
        cloth.advance(events)
        if frame in (6, 12):
            snapshot = cloth.snapshot()
            twin = Simulation(cloth.scene)
            twin.restore(snapshot)
            twin.advance([])
            cloth.advance([])
            assert np.array_equal(twin.state.x, cloth.state.x)
    (force,) = added_mass(cloth.scene)
    assert force.density == 0.2


def test_energy_report_contains_the_air() -> None:
    cloth = Simulation(Scene.from_parameters({**GRID, "diagnostics.energy": True}))
    for _ in range(30):
        cloth.advance([])
    report = cloth.energy_report
    assert report is not None
    assert 0.0 < report.air < cloth.plan.energies(cloth.time, cloth.state.x, cloth.state.v)[0]
    assert abs(report.residual) < 1e-3 * report.turned_over
