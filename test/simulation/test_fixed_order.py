# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames without a tolerance: fixed order and no error estimate, for any stiffness and work limit."""

from __future__ import annotations

import random
from typing import Any

import pytest

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target

BALL = {
    "obstacles": ["ball"],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "ball.position": [0.0, -0.16, 0.3],
    "contact.thickness": 0.01,
}


def commands(index: int, draw: random.Random) -> list[Event]:
    """Random targets of a ball and a gripper every few frames."""
    events: list[Event] = []
    if index % 3 == 0:
        x, y, z = (draw.uniform(-0.3, 0.6) for _ in range(3))
        events.append(Move("ball", (x, y, z), (0.0, 0.0, 0.0, 1.0)))
    if index == 4:
        events.append(Grasp("gripper", True))
    if index == 0:
        events.append(Target("gripper", (0.4, -0.3, 0.4)))
    elif index % 5 == 0:
        x, y, z = (draw.uniform(-0.5, 0.8) for _ in range(3))
        events.append(Target("gripper", (x, y, z)))
    return events


@pytest.mark.parametrize("work", [2.0, 0.5, 0.1])
@pytest.mark.parametrize("seed", [6, 10])
@pytest.mark.parametrize("integrator", ["extrapolated", "auto"])
@pytest.mark.parametrize(
    "more",
    [{}, {"step": 2e-4}, {"contact.self": True}, {"gripper.mode": "pinch"}],
    ids=["obstacle", "step", "self", "pinch"],
)
def test_no_tolerance_asks_for_no_error_estimate(more: dict[str, Any], integrator: str, seed: int, work: float) -> None:
    scene = {"integrator": integrator, "tolerance": 0.0, "rate": 240.0, "work_limit": work, **BALL, **more}
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (8, 8), **scene}))
    draw = random.Random(seed)
    for index in range(45):
        try:
            advance = simulation.advance(commands(index, draw)).advance
        except UnstableError:
            # Steps finer than the work limit permits: the frame reports it, and this test asks no more.
            return
        assert advance is None or advance.error is None
