# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles and grippers that would crush the cloth: they stop, the frame reports it, and time continues."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.contact_scenes import still
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.integrators.implicit import Implicit
from cloth_sim_ros.physics.integrators.stage_matrix import StageMatrix
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.plan.runs import RunSummary
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Grasp, Move, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.run import verify

FRAME = 1.0 / 60.0
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
#: A small cloth on a table.
LYING: dict[str, Any] = {
    "cloth.resolution": [4, 4],
    "cloth.size": [0.09, 0.09],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.005],
    "cloth.anchors": [""],
    "contact.thickness": 0.005,
    "tolerance": 1e-2,
    "grippers": [""],
    "obstacles": ["table", "iron"],
    "table.shape": "plane",
    "iron.shape": "box",
    "iron.size": [0.2, 0.2, 0.02],
    "iron.position": [0.0, 0.0, 0.1],
}


def finite(cloth: Simulation) -> bool:
    gaps = cloth.gaps()
    assert gaps is not None
    return bool(np.isfinite(cloth.positions).all() and (gaps[:, 1] > 0.0).all())


def test_crushing_obstacle_stops_until_new_target(tmp_path: Path) -> None:
    stopped: list[tuple[str, ...]] = []
    maker = SessionMaker(
        tmp_path, Scene.from_parameters(LYING), watch=lambda _cloth, frame: stopped.append(frame.stopped)
    )
    cloth = maker.simulation
    assert cloth.obstacles is not None
    for k in range(12):
        maker.add([Move("iron", (0.0, 0.0, max(0.0, 0.1 - 0.02 * k)), UPRIGHT)] if k < 6 else [])
        assert finite(cloth)
    assert set(stopped) == {(), ("iron",)}
    # The obstacle's middle stopped above half its height and has not moved since.
    assert 0.01 < cloth.obstacles.poses()[1, 2] < 0.03
    assert cloth.obstacles.is_at_rest
    assert stopped[-1] == ()
    maker.add([Move("iron", (0.0, 0.0, 0.1), UPRIGHT)])
    for _ in range(3):
        maker.add()
    assert cloth.obstacles.poses()[1, 2] == pytest.approx(0.1)
    assert finite(cloth)
    again = verify([maker.finish()])
    assert again.same
    assert again.frames == 16


def test_frame_lists_stopped_bodies_only() -> None:
    far_obstacle = {
        "obstacles": ["table", "iron", "far"],
        "far.shape": "sphere",
        "far.size": [0.1],
        "far.position": [3.0, 0.0, 1.0],
    }
    cloth = Simulation(Scene.from_parameters({**LYING, **far_obstacle}))
    stopped = [cloth.advance([Move("iron", (0.0, 0.0, -0.1))]).stopped for _ in range(3)]
    assert ("iron",) in stopped
    assert set(stopped) <= {(), ("iron",)}


def test_gripper_stops_before_pushing_cloth_through_table() -> None:
    # All of the cloth but a slit is under the pads: it can't escape.
    hand = {"grippers": ["hand"], "gripper.mode": "pinch"}
    hand |= {"gripper.opening": 0.012, "gripper.pad_size": [0.2, 0.1, 0.08]}
    # A crushed frame takes all of its work limit.
    values = {**LYING, **hand, "obstacles": ["table"], "work_limit": 2.0}
    cloth = Simulation(Scene.from_parameters(values))
    frames = [cloth.advance([Target("hand", (0.0, 0.0, 0.1 - 0.03 * k))]) for k in range(5)]
    assert any(frame.stopped == ("hand",) for frame in frames)
    assert finite(cloth)


@pytest.mark.parametrize("radius", [0.02, 0.03])
def test_ball_that_squeezes_a_cell_within_a_frame_stops(radius: float) -> None:
    # The ball is smaller than a cell: edges and faces keep it out, not particles.
    values = {**LYING, "cloth.size": [0.3, 0.3], "cloth.resolution": [8, 8], "cloth.position": [0.0, 0.0, 0.05]}
    values |= {"contact.thickness": 0.003, "tolerance": 1e-3, "obstacles": ["table", "ball"], "table.shape": "box"}
    values |= {"table.size": [1.2, 0.8, 0.04], "table.position": [0.0, 0.0, -0.02], "table.friction": [0.5, 0.4]}
    values |= {"ball.shape": "sphere", "ball.size": [radius], "ball.position": [0.0, 0.0, 0.3]}
    values = {name: value for name, value in values.items() if not name.startswith("iron.")}
    cloth = Simulation(Scene.from_parameters(values))
    for _ in range(120):
        cloth.advance()
    frames = [cloth.advance([Move("ball", (0.0, 0.0, -0.5))])] + [cloth.advance() for _ in range(9)]
    assert any(frame.stopped == ("ball",) for frame in frames)
    assert finite(cloth)


def test_thickness_that_lets_an_obstacle_intersect_is_refused() -> None:
    # Particles just outside the ball keep it out. At a smaller thickness nothing else would.
    values = {**LYING, "obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1], "cloth.resolution": [3, 3]}
    values |= {"cloth.size": [0.1, 0.1], "cloth.position": [0.025, 0.025, 0.0937], "contact.thickness": 0.003}
    cloth = Simulation(Scene.from_parameters(values))
    cloth.check(SetParameters({"contact.thickness": 0.002}))
    with pytest.raises(EventError, match="obstacle 'ball' comes through the cloth between particles"):
        cloth.check(SetParameters({"contact.thickness": 0.0002}))


def test_changes_of_one_frame_are_checked_in_order() -> None:
    # The second event refers to obstacles that the first one adds.
    cloth = Simulation(Scene.from_parameters({**LYING, "ball.shape": "sphere", "ball.size": [0.01]}))
    more = SetParameters({"obstacles": ["table", "ball", "iron"], "ball.position": [0.0, 0.3, 0.1]})
    cloth.advance([more, SetParameters({"contact.thickness": 0.004})])
    assert cloth.scene.obstacle_names == ["table", "ball", "iron"]


def test_thickness_that_puts_pads_beyond_stops_is_refused() -> None:
    hand = {"grippers": ["hand"], "gripper.mode": "pinch", "gripper.opening": 0.02}
    cloth = Simulation(Scene.from_parameters({**LYING, **hand, "obstacles": ["table"]}))
    cloth.advance([Target("hand", (0.0, 0.0, 0.1))])
    cloth.state.memory[JAWS_KEY] = np.array([[0.0135, 0.3]])
    cloth.check(SetParameters({"contact.thickness": 0.0052}))
    with pytest.raises(EventError, match=r"leave the pads of 'hand' 0.0005 m from their stop, and"):
        cloth.check(SetParameters({"contact.thickness": 0.004}))
    assert math.isfinite(cloth.advance().advance.step)


def test_opening_far_below_that_of_open_pads_is_refused() -> None:
    hand = {"grippers": ["hand"], "gripper.mode": "pinch", "gripper.opening": 0.06}
    cloth = Simulation(Scene.from_parameters({**LYING, **hand, "obstacles": ["table"]}))
    cloth.advance([Target("hand", (0.0, 0.0, 0.3))])
    with pytest.raises(
        EventError, match=r"gripper.opening is 0.03 m; .* pads of 'hand' .*; set it once they are closed"
    ):
        cloth.check(SetParameters({"gripper.opening": 0.03}))
    cloth.advance([Grasp("hand", True)])
    for _ in range(40):
        cloth.advance()
    cloth.advance([SetParameters({"gripper.opening": 0.03})])
    assert math.isfinite(cloth.advance([Grasp("hand", False)]).advance.step)


def test_saved_state_of_pads_beyond_the_opening_is_refused() -> None:
    hand = {"grippers": ["hand"], "gripper.mode": "pinch", "gripper.opening": 0.06}
    values = {**LYING, **hand, "obstacles": [""]}
    cloth = Simulation(Scene.from_parameters(values))
    cloth.advance([Target("hand", (0.0, 0.0, 0.3))])
    files = {"open.state": cloth.state.to_bytes()}
    loaded = {**values, "initial_state": "open.state"}
    assert Simulation(Scene.from_parameters(loaded, files=files)).advance().moved
    with pytest.raises(ValueError, match=r"gripper.opening is 0.03 m; the state would leave the pads of 'hand' -0.0"):
        Simulation(Scene.from_parameters({**loaded, "gripper.opening": 0.03}, files=files))


def test_large_motion_in_an_implicit_step_does_not_intersect() -> None:
    # A ball under a cell, at 10 m/s: in an eighth of a frame it moves further than its width.
    sheet = Scene.from_parameters(
        {**LYING, "cloth.size": [0.4, 0.4], "obstacles": [""], "cloth.position": [0.0, 0.0, 0.0]}
    )
    model, ball = sheet.plan().model, Obstacle(name="ball", shape="sphere", size=(0.005,))
    faces = ContactSurface(sheet.sheet.triangles(), sheet.sheet.positions(), thickness=0.003)
    force = Contact([ball], thickness=0.003, faces=faces)
    path = still((0.01, 0.02, -0.04))
    path[6] = 10.0
    force.set_paths(path[None])
    plan = compile(Model(model.masses, [*model.forces, force]))
    state = sheet.starting_state()
    Implicit(FRAME / 8.0).advance(plan, state, 0.0, FRAME)
    assert plan.contact is not None
    plan.contact.check_initial_penetration(FRAME, state.x, memory=state.memory)
    assert state.x[2].max() > 0.05


def test_anchors_inside_an_obstacle_keep_the_matrix_finite() -> None:
    sheet = Scene.from_parameters(
        {**LYING, "cloth.size": [0.4, 0.4], "obstacles": [""], "cloth.position": [0.0, 0.0, 0.0]}
    )
    model, ball = sheet.plan().model, Obstacle(name="ball", shape="sphere", size=(0.02,))
    faces = ContactSurface(sheet.sheet.triangles(), sheet.sheet.positions(), thickness=0.003)
    force = Contact([ball], thickness=0.003, faces=faces)
    x = sheet.starting_state().x
    # At the anchored corner the adjacent triangles intersect the ball.
    force.set_paths(still(x[:, 0] + np.sign(x[:, 5] - x[:, 0]) * (0.03, 0.01, 0.0))[None])
    StageMatrix(Model(model.masses, [*model.forces, force], anchors=[0])).update(0.0, x, 1e-3, {})


def test_steps_that_end_on_a_surface_are_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    cloth, original = Simulation(Scene.from_parameters(LYING)), ExtrapolationTableau.summary
    attempts: list[ExtrapolationTableau] = []

    def on_the_surface(columns: ExtrapolationTableau, count: int) -> RunSummary:
        summary = original(columns, count)
        if columns not in attempts:
            attempts.append(columns)
        if len(attempts) <= 2:
            monkeypatch.setattr(ExtrapolationTableau, "contact_summary", lambda *_: (math.inf, 0.0, (0.0, 0.0)))
            return summary._replace(activity=math.nan)
        monkeypatch.undo()
        return summary

    monkeypatch.setattr(ExtrapolationTableau, "summary", on_the_surface)
    cloth.advance()
    steps = [columns.duration / columns.counts[0] for columns in attempts]
    assert steps[1] < 0.6 * steps[0]
