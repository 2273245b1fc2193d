# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pinching grippers in a simulation: grasps, loads, and pads in the state through every event."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_AT_REST_KEY, JAWS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation

PINCH: dict[str, Any] = {
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.15, 0.02, 0.15],
    "gripper.opening": 0.02,
    "gripper.force": 2.0,
    "cloth.resolution": [6, 6],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [0.0, 0.0, 0.15],
    "tolerance": 1e-3,
}
CORNER = (0.15, 0.0, 0.0)
#: The particles between the pads.
BETWEEN = [28, 29, 34, 35]
MASS = 0.2 * 0.3 * 0.3


def pinching(*, frames: int = 20, **values: Any) -> Simulation:
    """A sheet whose corner was pinched a number of frames ago."""
    cloth = Simulation(Scene.from_parameters({**PINCH, **values}))
    cloth.advance([Target("gripper", CORNER), Grasp("gripper", True)])
    for _ in range(frames):
        cloth.advance()
    return cloth


def test_pinch_grasp_is_pending_until_pads_rest() -> None:
    cloth = Simulation(Scene.from_parameters(PINCH))
    first = cloth.advance([Target("gripper", CORNER), Grasp("gripper", True)])
    assert [grasp.pending for grasp in first.grasps] == [True]
    pinches = [frame.pinches for frame in (cloth.advance() for _ in range(30)) if frame.pinches]
    assert len(pinches) == 1
    assert (pinches[0][0].grasped_count, pinches[0][0].reason, pinches[0][0].pending) == (4, "", False)
    assert cloth.grasped_count(0) == 4
    # Nothing is attached.
    assert not cloth.grippers.grasped_particles(0).size
    again = cloth.advance([Grasp("gripper", True)])
    assert again.grasps[0].reason == "it is closed already: open it first"
    opened = cloth.advance([Grasp("gripper", False)])
    assert (opened.grasps[0].closed, opened.grasps[0].reason) == (False, "")
    for _ in range(15):
        cloth.advance()
    assert cloth.grasped_count(0) == 0
    assert not cloth.state.memory[ANCHORS_KEY].any()


def test_a_sheet_that_hangs_from_its_pads_weighs_on_the_gripper() -> None:
    cloth = pinching(**{"cloth.anchors": ["top"]})
    cloth.advance([SetParameters({"cloth.anchors": [""], "gripper.force": 5.0, "air.drag": 5.0})])
    for _ in range(400):
        frame = cloth.advance()
    wrench = frame.wrenches[0]
    assert wrench[:3] == pytest.approx([0.0, 0.0, -MASS * 9.81], abs=2e-2 * MASS * 9.81)
    # The torque is about the gripper: the sheet's weight acts beside it.
    centre = (cloth.model.masses @ cloth.positions) / MASS
    moment = np.cross(centre - CORNER, [0.0, 0.0, -MASS * 9.81])
    assert wrench[3:] == pytest.approx(moment, abs=2e-2 * MASS * 9.81 * 0.3)
    assert frame.obstacle_wrenches.shape == (0, 6)


def test_lower_grip_force_lets_the_sheet_slip() -> None:
    cloth = pinching()
    cloth.advance([SetParameters({"cloth.anchors": [""], "gripper.force": 0.02})])
    for _ in range(60):
        cloth.advance()
    assert cloth.grasped_count(0) == 0
    assert cloth.positions[:, 2].max() < -1.0


def test_anchors_and_pads_stay_when_obstacles_come_and_go() -> None:
    cloth = pinching()
    initial_anchors, pads = cloth.state.memory[ANCHORS_KEY].copy(), cloth.state.memory[JAWS_KEY].copy()
    assert sorted(np.flatnonzero(initial_anchors[0, 3])) == BETWEEN
    cloth.advance([Pause(True)])
    ball = {"ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -3.0], "obstacles": ["ball"]}
    cloth.advance([SetParameters(ball)])
    assert np.array_equal(cloth.state.memory[ANCHORS_KEY][1:], initial_anchors)
    assert not cloth.state.memory[ANCHORS_KEY][0].any()
    assert np.array_equal(cloth.state.memory[JAWS_KEY], pads)
    cloth.advance([Pause(False)])
    for _ in range(5):
        frame = cloth.advance()
    assert frame.obstacle_wrenches.shape == (1, 6)
    cloth.advance([SetParameters({"obstacles": [""]})])
    assert cloth.state.memory[ANCHORS_KEY].shape == initial_anchors.shape
    assert cloth.grasped_count(0) == 4


def test_a_reset_opens_pads_and_takes_them_away() -> None:
    cloth = pinching()
    cloth.advance([Reset()])
    assert cloth.state.memory[JAWS_KEY][0] == pytest.approx([0.01, 0.0])
    assert cloth.pinching is not None
    assert cloth.pinching.placed_pads() == []
    assert not cloth.state.memory[ANCHORS_KEY].any()
    for _ in range(3):
        assert not cloth.advance().pinches


def test_snapshot_during_closing_continues_to_the_same_bits() -> None:
    cloth = pinching(frames=8)
    assert not cloth.state.memory[JAWS_AT_REST_KEY].any()
    twin = Simulation(cloth.scene, State.from_bytes(cloth.state.to_bytes()))
    for k in range(15):
        events: list[Event] = [Target("gripper", (0.15, -0.001 * k, 0.001 * k))]
        assert cloth.advance(events).pinches == twin.advance(events).pinches
        assert cloth.state.digest() == twin.state.digest()


def test_pads_follow_no_faster_than_obstacles_do() -> None:
    cloth = Simulation(Scene.from_parameters(PINCH))
    cloth.advance([Target("gripper", (0.0, 1.0, 0.0))])
    cloth.advance([Target("gripper", (0.0, -1.0, 0.0))])
    assert cloth.grippers.poses()[0, 1] == pytest.approx(1.0 - 10.0 / 60.0)


def test_a_pinch_at_rest_sleeps_and_a_touch_wakes_it() -> None:
    cloth = pinching(**{"air.drag": 20.0, "tolerance": 3e-3})
    for _ in range(900):
        if cloth.asleep:
            break
        cloth.advance()
    assert cloth.asleep
    wrenches = cloth.advance().wrenches
    assert wrenches == pytest.approx(cloth.advance().wrenches)
    cloth.advance([Target("gripper", (0.15, -0.01, 0.0))])
    assert not cloth.asleep


def test_attaching_is_the_default_and_has_no_pads() -> None:
    cloth = Simulation(Scene.from_parameters({"cloth.resolution": [6, 6]}))
    cloth.advance()
    assert cloth.pinching is None
    assert not {JAWS_KEY, JAWS_AT_REST_KEY} & set(cloth.state.memory)
    attached = cloth.advance([Target("gripper", (0.5, 0.0, 0.5)), Grasp("gripper", True)])
    assert attached.grasps[0].grasped_count == 1
    assert not attached.grasps[0].pending


def test_pads_that_would_be_placed_in_the_cloth_are_refused() -> None:
    cloth = Simulation(Scene.from_parameters(PINCH))
    words = r"gripper.right_pad would be in the cloth: particle \d+ at \[.*\] is 0\.01 m deep in it; begin where"
    with pytest.raises(EventError, match=words):
        cloth.advance([Target("gripper", (0.15, 0.02, 0.0))])
    # The gripper still has no pose and may be placed elsewhere.
    cloth.advance([Target("gripper", CORNER)])


def test_pads_that_would_come_through_a_cell_are_refused() -> None:
    cloth = Simulation(Scene.from_parameters({**PINCH, "gripper.pad_size": [0.02, 0.02, 0.02]}))
    # Cells are of 60 mm: the middle of one is clear of particles. A pad's faces are 10 and 30 mm from the gripper.
    through = (0.0, 0.02, 0.0)
    with pytest.raises(EventError, match=r"'gripper.right_pad' comes through the cloth between particles \d+ and \d+"):
        cloth.advance([Target("gripper", through)])
    cloth.advance([Target("gripper", (0.0, 0.05, 0.0))])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda memory: memory.pop(JAWS_KEY), "memory 'contact.settled' has shape (1,); it must be (0,)"),
        (lambda memory: memory.update({JAWS_AT_REST_KEY: np.ones(2, dtype=bool)}), "has shape (2,); it must be (1,)"),
        (lambda memory: memory.update({JAWS_KEY: np.full((1, 2), np.nan)}), "must be finite"),
        (lambda memory: memory.update({ANCHORS_KEY: np.zeros((3, 4, 36))}), "of 3 obstacles and pads"),
    ],
)
def test_inconsistent_pinch_states_are_refused(change: Any, words: str) -> None:
    state = pinching(frames=2).state.copy()
    state.memory["obstacle.pose"] = np.zeros((0, 7))
    for quantity, width in (("target", 7), ("twist", 6), ("turn", 6)):
        state.memory[f"obstacle.{quantity}"] = np.zeros((0, width))
    State.from_bytes(state.to_bytes())
    change(state.memory)
    with pytest.raises(ValueError, match=re.escape(words)):
        State.from_bytes(state.to_bytes())


def test_a_state_of_another_mode_is_refused() -> None:
    pinched = pinching(frames=2).state
    attaching = Scene.from_parameters({**PINCH, "gripper.mode": "attach"})
    with pytest.raises(ValueError, match="the state has 1 grippers that pinch, the scene none"):
        Simulation(attaching, pinched)


def test_ineffective_pinch_parameters_are_reported() -> None:
    values = {"gripper.force": 3.0, "gripper.radius": 0.1}
    sentences = ineffective_parameters(Scene.from_parameters(values), values)
    assert sentences == ["gripper.force is set and has no effect: no gripper pinches (gripper.mode)"]
    values |= {"gripper.mode": "pinch"}
    sentences = ineffective_parameters(Scene.from_parameters(values), values)
    assert sentences == ["gripper.radius is set and has no effect: no gripper attaches (gripper.mode)"]


def test_one_gripper_pinches_while_another_attaches() -> None:
    values = {**PINCH, "gripper.mode": "attach", "grippers": ["left", "right"], "right.mode": "pinch"}
    cloth = Simulation(Scene.from_parameters(values))
    assert Scene.from_parameters(cloth.scene.parameters()) == cloth.scene
    places = {"left": (-0.15, 0.0, 0.0), "right": CORNER}
    events: list[Event] = [Target(name, position) for name, position in places.items()]
    first = cloth.advance([*events, *(Grasp(name, True) for name in places)])
    assert [grasp.grasped_count for grasp in first.grasps] == [1, 0]
    for _ in range(20):
        frame = cloth.advance()
    assert [cloth.grasped_count(0), cloth.grasped_count(1)] == [1, 4]
    assert cloth.grippers.grasped_particles(0).tolist() == [30]
    assert frame.wrenches.shape == (2, 6)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"left.mode": "pinch"}, "left.mode is set, and there is no gripper 'left'; there are gripper"),
        ({"grippers": ["left"], "left.mode": "grab"}, "left.mode is 'grab'; it must be one of attach, pinch"),
        ({"gripper.friction": [0.1, 0.1, 0.1]}, "gripper.friction has 3 entries"),
        ({"gripper.opening": 0.0}, "gripper.opening is 0.0 m; it must be above 0.0 m"),
    ],
)
def test_invalid_modes_and_pads_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        Scene.from_parameters({**PINCH, **values})


def test_a_mode_can_not_change_while_the_cloth_runs() -> None:
    scene = Scene.from_parameters({"grippers": ["left"], "left.mode": "pinch"})
    with pytest.raises(ParameterError, match=r"left\.mode can't change while the cloth runs"):
        scene.changed({"left.mode": "attach"})


def test_implicit_steps_see_pads_where_they_are() -> None:
    """Pads move through air where open pads would be in the cloth."""
    values = {"gripper.pad_size": [0.12, 0.02, 0.12], "gripper.opening": 0.08, "gripper.speed": 0.6}
    values |= {"cloth.size": [0.4, 0.35], "cloth.resolution": [9, 8], "gripper.force": 0.5, "integrator": "implicit"}
    values |= {"cloth.position": [0.1, -0.3, 1.7], "cloth.orientation": [0.61, 0.07, -0.13, 0.77]}
    cloth = Simulation(Scene.from_parameters({**PINCH, **values}))
    start = cloth.positions[-1]
    for k in range(16):
        share = k / 16.0
        displacement = (-0.3 * share, -0.35 * share, 0.3 * share * (1.0 - share))
        events: list[Event] = [Target("gripper", np.add(start, displacement).tolist(), (share / 3.0, 0.0, share, 1.0))]
        if k == 2:
            events.append(Grasp("gripper", True))
        cloth.advance(events)
    assert np.isfinite(cloth.positions).all()
