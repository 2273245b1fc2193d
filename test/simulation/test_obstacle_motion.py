# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Obstacles of a simulation: poses, motion, addition and removal, all kept in the state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.bodies.kinematic_bodies import MAX_BODY_SPEED
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Move, Reset, SetParameters, from_dict, ordered, to_dict
from cloth_sim_ros.simulation.simulation import Simulation

BASE: dict[str, Any] = {
    "cloth.resolution": [6, 6],
    "obstacles": ["ball", "post"],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "ball.position": [0.0, 1.0, 1.0],
    "post.shape": "cylinder",
    "post.size": [0.1, 1.0],
    "post.position": [0.0, -1.0, 1.0],
    "block.shape": "box",
    "block.size": [0.2, 0.2, 0.2],
    "block.position": [0.0, 0.0, -1.0],
}


def simulation(**values: Any) -> Simulation:
    return Simulation(Scene.from_parameters({**BASE, **values}))


def test_obstacle_reaches_target_at_frame_end_and_stays() -> None:
    cloth = simulation()
    assert cloth.obstacles is not None
    turn = (0.0, 0.0, 0.28, 0.96)
    cloth.advance([Move("ball", (0.05, 1.0, 1.0), turn)])
    assert cloth.obstacles.poses()[0].tolist() == pytest.approx([0.05, 1.0, 1.0, *turn])
    assert cloth.obstacles.poses()[1].tolist() == [0.0, -1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    assert not cloth.obstacles.is_at_rest
    assert cloth.obstacles.lagging == []
    cloth.advance()
    cloth.advance()
    assert cloth.obstacles.is_at_rest


def test_far_target_is_followed_at_the_speed_limit() -> None:
    cloth = simulation()
    assert cloth.obstacles is not None
    cloth.advance([Move("ball", (1.0, 1.0, 1.0), (0.0, 0.0, 1.0, 0.0))])
    assert cloth.obstacles.lagging == ["ball"]
    places, most = [cloth.obstacles.poses()[0]], MAX_BODY_SPEED / 60.0
    for _ in range(20):
        cloth.advance()
        places.append(cloth.obstacles.poses()[0])
    steps = np.sqrt((np.diff(np.array(places)[:, :3], axis=0) ** 2).sum(axis=1))
    assert steps.max() <= most
    assert steps[0] > 0.7 * most
    assert places[-1].tolist() == [1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0]
    assert np.abs((np.array(places)[:, 3:] ** 2).sum(axis=1) - 1.0).max() < 1e-12


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (Move("bowl", (0.0, 0.0, 0.0)), "there is no obstacle 'bowl'; this cloth has ball, post"),
        (Move("ball", (0.0, float("nan"), 0.0)), "target of 'ball' is .*; it must be 3 finite numbers"),
        (Move("ball", (0.0, 0.0, 2e4)), "no coordinate may be beyond"),
        (Move("ball", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), "target of 'ball': .* is no quaternion"),
        (SetParameters({"obstacles": ["block"], "block.position": [0.1, 0.0, 1.1]}), "is inside obstacle 'block'"),
    ],
)
def test_invalid_event_is_refused_and_changes_nothing(event: Event, words: str) -> None:
    cloth = simulation()
    before = cloth.state.digest()
    with pytest.raises(EventError, match=words):
        cloth.advance([event])
    assert cloth.state.digest() == before


def test_cloth_starting_inside_obstacle_is_refused_with_location() -> None:
    with pytest.raises(ValueError, match=r"inside obstacle 'ball': particle 14 at .* is 0.01 m deep"):
        simulation(**{"ball.position": [-0.1, 0.09, 1.1], "cloth.position": [0.0, 0.0, 1.0]})


def test_anchored_particle_may_be_inside_obstacle_until_freed() -> None:
    # The clamped edge of a hung cloth.
    cloth = simulation(**{"ball.position": [0.1, 0.0, 1.5]})
    cloth.advance()
    before = cloth.state.digest()
    with pytest.raises(EventError, match=r"the cloth, once it is let go, is inside obstacle 'ball': particle 3 at"):
        cloth.advance([SetParameters({"cloth.anchors": ["0"]})])
    assert cloth.state.digest() == before
    cloth.advance([SetParameters({"cloth.anchors": ["3"]})])


def test_remaining_obstacles_keep_their_poses() -> None:
    cloth = simulation()
    cloth.advance([Move("post", (0.1, -1.0, 1.0))])
    moving = cloth.state.memory["obstacle.turn"][1].copy()
    cloth.advance([SetParameters({"obstacles": ["block", "post"]})])
    assert cloth.obstacles is not None
    assert cloth.obstacles.names == ["block", "post"]
    assert cloth.obstacles.poses().tolist() == [[0, 0, -1, 0, 0, 0, 1], [0.1, -1, 1, 0, 0, 0, 1]]
    assert moving.any()
    cloth.advance([SetParameters({"obstacles": [""]})])
    assert cloth.obstacles is None
    assert not any(name.startswith(("obstacle", "contact")) for name in cloth.state.memory)
    cloth.advance([SetParameters({"obstacles": ["post"]})])
    assert cloth.obstacles is not None
    assert cloth.obstacles.poses().tolist() == [[0, -1, 1, 0, 0, 0, 1]]


def test_reset_restores_poses_and_keeps_added_obstacles() -> None:
    cloth = simulation()
    cloth.advance([Move("ball", (0.05, 1.0, 1.0)), SetParameters({"obstacles": ["ball", "block"]})])
    cloth.advance([Move("block", (0.05, 0.0, -1.0))])
    cloth.advance([Reset()])
    assert cloth.obstacles is not None
    assert cloth.obstacles.names == ["ball", "block"]
    assert cloth.obstacles.poses()[:, :3].tolist() == [[0.0, 1.0, 1.0], [0.0, 0.0, -1.0]]


def test_saved_state_continues_to_the_same_bits() -> None:
    cloth = simulation()
    cloth.advance([Move("ball", (0.6, 1.0, 1.0), (0.0, 0.6, 0.0, 0.8))])
    again = Simulation(cloth.scene, State.from_bytes(cloth.state.to_bytes()))
    for _ in range(5):
        cloth.advance()
        again.advance()
    assert again.state.digest() == cloth.state.digest()


def test_a_state_of_another_number_of_obstacles_is_refused() -> None:
    cloth = simulation()
    with pytest.raises(ValueError, match="the state has 2 obstacles, the scene 1"):
        Simulation(Scene.from_parameters({**BASE, "obstacles": ["ball"]}), cloth.state)


def test_newest_move_per_obstacle_counts_and_is_recorded() -> None:
    moves: list[Event] = [Move("b", (1.0, 0.0, 0.0)), Move("a", (2.0, 0.0, 0.0)), Move("b", (0.1, 0.2, 0.3))]
    assert ordered(moves) == [moves[1], moves[2]]
    assert [from_dict(to_dict(move)) for move in moves] == moves


def test_scene_without_obstacles_has_no_obstacle_state() -> None:
    cloth = Simulation(Scene.from_parameters({"cloth.resolution": [6, 6]}))
    cloth.advance()
    assert cloth.obstacles is None
    assert not any(name.startswith(("obstacle", "contact")) for name in cloth.state.memory)


def test_dependent_parameters_may_be_set_in_one_frame() -> None:
    cloth = simulation()
    one_by_one: list[Event] = [
        SetParameters({"peg.shape": "capsule"}),
        SetParameters({"peg.size": [0.1, 0.2]}),
        SetParameters({"peg.position": [0.0, 0.0, -1.0]}),
        SetParameters({"obstacles": ["peg"]}),
    ]
    cloth.advance(one_by_one)
    assert cloth.scene.obstacle_names == ["peg"]
    with pytest.raises(EventError, match=r"unknown parameter 'cone.size'"):
        cloth.advance([SetParameters({"cone.size": [0.1]}), SetParameters({"cone.shape": "sphere"})])
