# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Friction in a simulation: sticking, sliding, and anchors in the state through every event."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_sim_ros import Scene
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.events import Move, Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

MU = 0.5
SMALL: dict[str, Any] = {
    "cloth.resolution": [5, 5],
    "cloth.size": [0.2, 0.2],
    "cloth.anchors": [""],
    "grippers": [""],
    "tolerance": 1e-3,
    "obstacles": ["box"],
    "box.shape": "box",
    "box.size": [2.0, 2.0, 0.1],
    "box.friction": [MU],
}


def inclined(degrees: float, **values: Any) -> Simulation:
    """A sheet on a box rotated about y, at the distance where contact carries it."""
    turn = Rotation.from_euler("y", degrees, degrees=True)
    position = turn.apply([0.0, 0.0, 0.05 + 0.98 * 0.003])
    scene_values = {
        "cloth.position": position.tolist(),
        "cloth.orientation": turn.as_quat().tolist(),
        "box.orientation": turn.as_quat().tolist(),
    }
    return Simulation(Scene.from_parameters({**SMALL, **scene_values, **values}))


def anchors(cloth: Simulation) -> np.ndarray:
    return cloth.state.memory[ANCHORS_KEY]


def lying() -> Simulation:
    """A sheet that has been on the box for some frames and sticks to it."""
    cloth = inclined(0.0)
    for _ in range(5):
        cloth.advance()
    assert (anchors(cloth)[0, 3] > 0.0).all()
    return cloth


def test_sheet_on_slope_slides_above_friction_angle_only() -> None:
    steep = float(np.degrees(np.arctan(MU)))
    below = inclined(steep - 2.0)
    for _ in range(60):
        below.advance()
    initial_anchors, x = anchors(below).copy(), below.positions
    assert (initial_anchors[0, 3] == 1.0).all()
    for _ in range(30):
        below.advance()
        assert np.array_equal(anchors(below), initial_anchors)
    assert np.abs(below.positions - x).max() < 1e-6
    above = inclined(steep + 2.0)
    start = above.positions.mean(axis=0)
    for _ in range(60):
        above.advance()
    assert np.linalg.norm(above.positions.mean(axis=0) - start) > 0.05
    assert (anchors(above)[0, 3] == 2.0).all()


def test_zero_friction_gives_the_bits_of_no_friction() -> None:
    plain = {name: value for name, value in SMALL.items() if name != "box.friction"}
    digests = []
    for values in (plain, {**plain, "box.friction": [0.0]}, {**plain, "box.friction": [0.0, 0.0]}):
        flat = {"cloth.position": [0.0, 0.0, 0.06], "cloth.orientation": [0.0, 0.0, 0.0, 1.0]}
        cloth = Simulation(Scene.from_parameters({**values, **flat}))
        for _ in range(20):
            cloth.advance()
        assert ANCHORS_KEY not in cloth.state.memory
        digests.append(cloth.state.digest())
    assert len(set(digests)) == 1


def test_friction_anchors_belong_to_their_obstacle() -> None:
    cloth = lying()
    initial_anchors = anchors(cloth)[0].copy()
    ball = {"ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -3.0], "obstacles": ["ball", "box"]}
    cloth.advance([SetParameters(ball)])
    assert anchors(cloth).shape == (2, 4, 25)
    # The sheet is at rest: only the number of anchors has changed.
    assert np.array_equal(anchors(cloth)[1], initial_anchors)
    assert not anchors(cloth)[0].any()
    cloth.advance([SetParameters({"obstacles": ["box"]})])
    assert np.array_equal(anchors(cloth), initial_anchors[None])
    cloth.advance([SetParameters({"obstacles": ["ball"]})])
    assert ANCHORS_KEY not in cloth.state.memory


def test_removing_one_obstacle_keeps_anchors_of_the_other() -> None:
    cloth = lying()
    ball = {"ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -3.0], "ball.friction": [0.2]}
    cloth.advance([SetParameters({**ball, "box.friction": [0.0], "obstacles": ["box", "ball"]})])
    assert not anchors(cloth).any()


def test_disabling_friction_releases_anchors() -> None:
    cloth = lying()
    cloth.advance([SetParameters({"box.friction": [0.0]})])
    assert ANCHORS_KEY not in cloth.state.memory
    for _ in range(3):
        cloth.advance([SetParameters({"gravity": [2.0, 0.0, -9.81]})])
    x = cloth.positions
    cloth.advance([SetParameters({"box.friction": [MU], "gravity": [0.0, 0.0, -9.81]})])
    # The new anchors are at the present positions, not at the old ones.
    held = anchors(cloth)[0, :2].T
    assert np.abs(held - x[:, :2]).max() < 0.01
    assert np.abs(held - x[:, :2]).max() < 0.5 * np.abs(lying().positions - x).max()


def test_reset_releases_anchors() -> None:
    cloth = lying()
    cloth.advance([Reset()])
    fresh = inclined(0.0)
    fresh.advance()
    assert np.array_equal(anchors(cloth), anchors(fresh))


def test_refused_frame_keeps_anchors() -> None:
    cloth = lying()
    before = cloth.state.digest()
    with pytest.raises(ValueError, match="ball"):
        cloth.advance([SetParameters({"box.friction": [0.0]}), Move("ball", (0.0, 0.0, 0.0))])
    assert cloth.state.digest() == before
    restored = Simulation(cloth.scene, State.from_bytes(cloth.state.to_bytes()))
    cloth.advance([Move("box", (0.01, 0.0, 0.0))])
    restored.advance([Move("box", (0.01, 0.0, 0.0))])
    assert cloth.state.digest() == restored.state.digest()


def test_the_energy_balance_closes_while_a_sheet_slides() -> None:
    cloth = inclined(40.0, **{"diagnostics.energy": True, "air.drag": 0.0, "wind.normal_drag": 0.0})
    for _ in range(40):
        cloth.advance()
    report = cloth.energy_report
    assert report is not None
    assert report.dissipated > 1e-3
    assert abs(report.residual) < 1e-3 * report.turned_over
    # A query changes nothing.
    assert cloth.energy() == pytest.approx(report.total, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a[:, :3], r"has shape \(1, 3, 25\); it must be \(1, 4, 25\)"),
        (lambda a: a[:, :, 1:], r"it must be \(1, 4, 25\)"),
        (lambda a: np.array(1.0), r"has shape \(\)"),
        (lambda a: a.astype(np.int64), "it must be float64"),
        (lambda a: a * np.nan, "it must be finite"),
        (lambda a: np.concatenate([a, a]), "is of 2 obstacles, 'obstacle.pose' of 1"),
        (
            lambda a: a + 0.5 * (np.arange(4) == 3)[:, None],
            r"has bond 1.5 of obstacle 0 with particle 0; .* \(slides\)",
        ),
    ],
)
def test_anchors_that_do_not_fit_are_refused(change: Any, words: str) -> None:
    state = lying().state
    state.memory[ANCHORS_KEY] = change(state.memory[ANCHORS_KEY])
    with pytest.raises(ValueError, match=f"memory 'contact.anchors' .*{words}"):
        State.from_bytes(state.to_bytes())
