# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Resets that start named obstacles at other poses than those of the scene: motion, bits, text form and refusals."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Move, Scene, Simulation, State
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import MoveObstacles, Pause, Reset, from_dict, to_dict

#: A ball on one side of a hanging cloth, and a bar beside it.
HANGING: dict[str, Any] = {
    "cloth.resolution": [12, 12],
    "obstacles": ["hand", "bar"],
    "hand.shape": "sphere",
    "hand.size": [0.08],
    "hand.position": [0.0, -0.6, 1.0],
    "bar.shape": "capsule",
    "bar.size": [0.05, 0.2],
    "bar.position": [2.0, 0.0, 1.0],
}
#: Where the ball is at the reset: on the other side.
BEYOND = (0.0, 0.6, 1.0, 0.0, 0.0, 0.0, 1.0)


def cloth_with_ball_beyond() -> Simulation:
    """A cloth round which a ball has moved to the other side."""
    simulation = Simulation(Scene.from_parameters(HANGING))
    for x, y in ((2.0, -0.6), (2.0, 0.6), (0.0, 0.6)):
        for _ in range(40):
            simulation.advance([Move("hand", (x, y, 1.0)), Move("bar", (3.0, 0.0, 1.0))])
    return simulation


def poses(simulation: Simulation) -> np.ndarray:
    assert simulation.obstacles is not None
    return simulation.obstacles.poses()


def test_obstacle_that_a_reset_places_sweeps_no_cloth() -> None:
    simulation = cloth_with_ball_beyond()
    simulation.advance([Reset(["hand"], [BEYOND])])
    assert poses(simulation).tolist() == [list(BEYOND), [2.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]]
    largest = 0.0
    for _ in range(20):
        simulation.advance([MoveObstacles(["hand"], [BEYOND])])
        largest = max(largest, float(np.abs(simulation.velocities).max()))
    assert largest < 0.2
    assert np.abs(simulation.positions[:, 1]).max() < 0.01


def test_placed_obstacle_is_at_rest_at_its_unit_pose() -> None:
    simulation, twin = cloth_with_ball_beyond(), cloth_with_ball_beyond()
    turned = (*BEYOND[:3], 0.0, 0.0, 0.3, 1.2)
    simulation.advance([Pause(True), Reset(["hand"], [turned])])
    assert simulation.obstacles is not None
    assert simulation.obstacles.lagging == []
    assert simulation.obstacles.is_at_rest
    assert np.linalg.norm(poses(simulation)[0, 3:]) == pytest.approx(1.0)
    # The same pose as a target moves nothing.
    simulation.advance([Pause(False)])
    twin.advance([Pause(True), Reset(["hand"], [turned])])
    twin.advance([Pause(False), MoveObstacles(["hand"], [turned])])
    assert simulation.state.digest() == twin.state.digest()


def test_reset_at_scene_poses_gives_bits_of_plain_reset() -> None:
    simulation, twin = cloth_with_ball_beyond(), cloth_with_ball_beyond()
    for k in range(5):
        simulation.advance([] if k else [Reset()])
        twin.advance([] if k else [Reset(["hand"], [[0.0, -0.6, 1.0, 0.0, 0.0, 0.0, 1.0]])])
        assert simulation.state.digest() == twin.state.digest()


def test_reset_with_poses_runs_again_from_saved_states() -> None:
    simulation, script = cloth_with_ball_beyond(), {3: [Reset(["hand"], [[0.0, 0.081, 1.0, 0.0, 0.0, 0.0, 1.0]])]}
    snapshot, states, digests = simulation.snapshot(), list[State](), list[str]()
    for k in range(8):
        states.append(simulation.state.copy())
        simulation.advance(script.get(k, []))
        digests.append(simulation.state.digest())
    simulation.restore(snapshot)
    for k in range(8):
        simulation.advance(script.get(k, []))
        assert simulation.state.digest() == digests[k]
    for begin in (2, 3, 6):
        loaded = Simulation(Scene.from_parameters(HANGING), State.from_bytes(states[begin].to_bytes()))
        for k in range(begin, 8):
            loaded.advance(script.get(k, []))
            assert loaded.state.digest() == digests[k]


def test_text_of_reset_keeps_every_bit_and_old_form() -> None:
    event = Reset(["hand"], [(0.1, 1.0 / 3.0, 2.0, 0.0, 0.0, 0.0, 1.0)])
    assert from_dict(json.loads(json.dumps(to_dict(event)))) == event
    assert to_dict(Reset()) == {"kind": "reset"}
    assert from_dict({"kind": "reset"}) == Reset()
    assert hash(event) == hash(Reset(("hand",), np.array(event.poses)))


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (Reset(["foot"], [BEYOND]), "there is no obstacle 'foot'; this cloth has hand, bar"),
        (Reset(["hand", "hand"], [BEYOND, BEYOND]), "name each of them once"),
        (Reset(["hand"], []), r"poses of 1 obstacles have shape \(0, 0\); give 7 numbers for each"),
        (Reset([], [BEYOND]), r"poses of 0 obstacles have shape \(1, 7\); give 7 numbers for each"),
        (Reset(["hand", "bar"], [BEYOND, BEYOND[:3]]), r"shape \(2, 0\); give 7 numbers for each"),
        (Reset(["hand"], [(float("nan"), *BEYOND[1:])]), "it must be 3 finite numbers"),
        (Reset(["hand"], [(0.0, 0.05, 1.0, 0.0, 0.0, 0.0, 1.0)]), "obstacle 'hand' comes through the cloth"),
    ],
    ids=["name", "twice", "no pose", "no name", "ragged", "nan", "in the cloth"],
)
def test_invalid_poses_of_a_reset_are_refused(event: Reset, reason: str) -> None:
    simulation = cloth_with_ball_beyond()
    before = simulation.state.digest()
    with pytest.raises(EventError, match=reason):
        simulation.advance([event])
    with pytest.raises(EventError, match=reason):
        simulation.restart(event)
    assert simulation.state.digest() == before


def test_joined_obstacle_takes_no_pose_from_a_reset() -> None:
    joined = {"cloth.anchors": [""], "cloth.joints": ["top-bar"], "bar.position": [0.0, 0.0, 1.8]}
    simulation = Simulation(Scene.from_parameters({**HANGING, **joined}))
    with pytest.raises(EventError, match="pose of obstacle 'bar', which joints hold to the cloth"):
        simulation.advance([Reset(["bar"], [[0.0, 0.5, 1.8, 0.0, 0.0, 0.0, 1.0]])])
    simulation.advance([Reset(["hand"], [BEYOND])])


def test_obstacle_placed_near_the_cloth_reduces_thickness() -> None:
    simulation = cloth_with_ball_beyond()
    # 1 mm from the sheet; the thickness is 3 mm.
    frame = simulation.advance([Reset(["hand"], [[0.0, 0.081, 1.0, 0.0, 0.0, 0.0, 1.0]])])
    assert frame.recovery is not None
    assert simulation.contact_recovery is not None
    for _ in range(30):
        simulation.advance()
    assert np.abs(simulation.velocities).max() < 1.0


def test_restart_resets_without_time() -> None:
    simulation, twin = cloth_with_ball_beyond(), cloth_with_ball_beyond()
    event = Reset(["hand"], [BEYOND])
    time = simulation.time
    simulation.restart(event)
    assert simulation.time == time
    assert poses(simulation)[0].tolist() == list(BEYOND)
    simulation.advance()
    twin.advance([event])
    assert simulation.state.digest() == twin.state.digest()
