# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Moves of several obstacles by one event: the same bits as single moves, its text form, and refusals."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Move, Scene, Simulation
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import MoveObstacles, from_dict, to_dict

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
