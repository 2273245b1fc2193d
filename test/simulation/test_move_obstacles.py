# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Moves of several obstacles by one event: the same bits as single moves, its text form, and refusals."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from support.robots import ARM, robot_scene

from cloth_sim_ros import Move, Scene, Simulation
from cloth_sim_ros.simulation.bodies.obstacles import gaps
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import MoveObstacles, from_dict, to_dict
from cloth_sim_ros.simulation.frame import Frame

NAMES = ("left", "right", "far")


def cloth() -> Simulation:
    values: dict[str, Any] = {"cloth.resolution": [9, 9], "obstacles": list(NAMES)}
    for k, name in enumerate(NAMES):
        values |= {f"{name}.shape": "capsule", f"{name}.size": [0.05, 0.2]}
        values[f"{name}.position"] = [0.0, 0.2 * (-1.0) ** k, 0.9] if k < 2 else [5.0, 0.0, 0.0]
    return Simulation(Scene.from_parameters(values))


def poses(frame: int) -> np.ndarray:
    angle = 0.05 * frame
    turn = [0.0, 0.0, math.sin(angle), 1.2 * math.cos(angle)]
    return np.array(
        [
            [0.0, 0.2 - 0.01 * frame, 0.9, *turn],
            [0.01 * frame, -0.2, 0.9, *turn],
            # Too fast in some frames: the speed limit acts.
            [5.0 + (frame % 5) * 0.2, 0.0, 0.0, *turn],
        ]
    )


def test_one_event_gives_the_bits_of_single_moves() -> None:
    together, alone = cloth(), cloth()
    for frame in range(25):
        rows = poses(frame)
        together.advance([MoveObstacles(NAMES, rows)])
        alone.advance([Move(name, row[:3], row[3:]) for name, row in zip(NAMES, rows, strict=True)])
        assert together.state.digest() == alone.state.digest()
    assert together.obstacles is not None
    assert together.obstacles.lagging == ["far"]


def test_event_keeps_every_bit_through_its_text() -> None:
    event = MoveObstacles(NAMES, poses(3))
    again = from_dict(json.loads(json.dumps(to_dict(event))))
    assert again == event
    assert isinstance(again, MoveObstacles)
    assert again.poses.tobytes() == event.poses.tobytes()
    assert not event.poses.flags.writeable


def test_single_move_counts_after_those_of_several() -> None:
    simulation = cloth()
    simulation.advance([Move("left", (0.0, 0.21, 0.9)), MoveObstacles(NAMES, poses(0))])
    assert simulation.obstacles is not None
    assert simulation.obstacles.poses()[0, 1] == 0.21


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (MoveObstacles(["left", "who"], poses(0)[:2]), "there is no obstacle 'who'"),
        (MoveObstacles(["left", "left"], poses(0)[:2]), "name each of them once"),
        (MoveObstacles(NAMES, poses(0)[:2]), r"poses of 3 obstacles have shape \(2, 7\)"),
        (MoveObstacles(["left"], [[0.0, math.nan, 0.0, 0.0, 0.0, 0.0, 1.0]]), "target of 'left' is .*finite"),
        (MoveObstacles(["left"], [[0.0, 2e4, 0.0, 0.0, 0.0, 0.0, 1.0]]), "no coordinate may be beyond 10000 m"),
        (MoveObstacles(["left"], [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]), "no quaternion"),
    ],
)
def test_invalid_move_of_several_is_refused(event: MoveObstacles, reason: str) -> None:
    simulation = cloth()
    before = simulation.state.digest()
    with pytest.raises(EventError, match=reason):
        simulation.advance([event])
    assert simulation.state.digest() == before


def test_cloth_sleeps_until_a_link_comes_within_reach() -> None:
    scene, links = robot_scene(ARM, {"cloth.resolution": [5, 5], "air.drag": 5.0, "robot.position": [1.2, 0.0, 0.5]})
    simulation = Simulation(scene)

    def move(shoulder: float) -> Frame:
        return simulation.advance([MoveObstacles(links.names, links.poses({"shoulder": shoulder}))])

    angles = (0.1 * math.sin(0.05 * frame) for frame in range(600))
    while not simulation.asleep:
        move(next(angles))
    frame = move(next(angles))
    assert frame.advance is not None
    assert (frame.advance.steps, simulation.asleep) == (0, True)
    assert simulation.obstacles is not None
    assert not simulation.obstacles.is_at_rest
    for k in range(60):
        move(-0.04 * k)
        if not simulation.asleep:
            break
    assert not simulation.asleep, "a link that comes near wakes it"


def test_links_that_may_touch_are_those_within_reach() -> None:
    scene, links = robot_scene(ARM, {"cloth.resolution": [5, 5], "robot.position": [0.9, 0.0, 0.5]})
    simulation = Simulation(scene)
    for angle in (0.0, -0.3, -0.6):
        simulation.advance([MoveObstacles(links.names, links.poses({"shoulder": angle}))])
        is_away = simulation.frame_controls.contact.is_away
        assert simulation.obstacles is not None
        x = simulation.state.x
        for k, (solid, pose) in enumerate(zip(simulation.obstacles.solids, simulation.obstacles.poses(), strict=True)):
            if is_away[k]:
                assert gaps(solid, pose, x).min() > scene.contact.thickness
    # The far base is away, and the hand of the lowered arm is not.
    assert is_away[links.links.index("base")]
    assert not is_away[links.links.index("hand")]
