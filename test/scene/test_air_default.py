# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Air across the sheet by default, and cloths that have no surface for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene, SetParameters, Simulation
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.scene.parameters.declare import ParameterError

CHAIN = b"positions: [[0, 0, 1], [0, 0, 2]]\nmasses: [1.0, 1.0]\nsprings: [[0, 1]]\nstiffness: 10.0\n"
SPRINGS: dict[str, Any] = {"cloth.springs": "chain.yaml", "bending.model": "none", "cloth.anchors": ["0"]}
FILES = {"chain.yaml": CHAIN}


def panels(scene: Scene) -> list[AirPanels]:
    return [force for force in scene.model().forces if isinstance(force, AirPanels)]


def test_sheet_has_air_across_it_by_default() -> None:
    (air,) = panels(Scene.from_parameters({"cloth.resolution": [4, 5]}))
    assert (air.normal, air.tangential) == (0.45, 0.0)
    assert not panels(Scene.from_parameters({"cloth.resolution": [4, 5], "wind.normal_drag": 0.0}))


def test_raw_springs_have_no_air_across_them() -> None:
    scene = Scene.from_parameters(SPRINGS, files=FILES)
    assert scene.wind.normal_drag == 0.0
    assert not panels(scene)
    again = Scene.from_parameters(scene.parameters(), files=scene.files)
    assert again == scene
    cloth = Simulation(scene)
    cloth.advance([SetParameters({"gravity": [0.0, 0.0, -1.0]})])
    assert cloth.scene.wind.normal_drag == 0.0


@pytest.mark.parametrize("value", [0.45, 1.0])
@pytest.mark.parametrize("name", ["wind.normal_drag", "wind.tangential_drag"])
def test_raw_springs_with_air_across_them_are_refused(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match="need a surface; raw springs have none: set both to 0"):
        Scene.from_parameters({**SPRINGS, name: value}, files=FILES)


def test_chain_of_the_package_starts_without_air_across_it() -> None:
    scene = Scene.from_file(Path(__file__).parents[2] / "config" / "chain.yaml")
    assert scene.wind.normal_drag == 0.0


def test_swing_decays_by_air_drag() -> None:
    """Swing of the recorded cloth: its amplitude decays at half of normal drag / density."""
    values = {
        "cloth.size": [0.3, 0.3],
        "cloth.resolution": [9, 9],
        "cloth.orientation": [0.5, 0.5, 0.5, 0.5],
        "material.density": 0.45 / 2.30,
        "air.drag": 0.0,
        "material.damping": 1.0,
        "grippers": [""],
    }
    angle = 0.1
    turn = {"cloth.orientation": [float(np.sin(np.pi / 4 + angle / 2)), 0.0, 0.0, float(np.cos(np.pi / 4 + angle / 2))]}
    swings = []
    for drag in ({}, {"wind.normal_drag": 0.0}):
        cloth = Simulation(Scene.from_parameters({**values, **turn, "cloth.anchors": ["top"], **drag}))
        edge = []
        for _ in range(150):
            cloth.advance()
            edge.append(cloth.positions[-5, 1] - cloth.positions[4, 1])
        swings.append(np.abs(edge))
    with_air, without = (swing[90:].max() for swing in swings)
    assert without > 0.5 * swings[1].max()
    assert with_air / without == pytest.approx(np.exp(-0.5 * 2.30 * 2.0), rel=0.35)
