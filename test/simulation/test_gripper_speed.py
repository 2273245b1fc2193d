# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Speed limit of a gripper: jumps are followed smoothly at the limit; other motion keeps its bits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.physics.plan.gripper_path import rotation_vector
from cloth_sim_ros.scene.gripper_section import MAX_SPEED
from cloth_sim_ros.simulation.events import Grasp, Reset, SetParameters, Target

BASE: dict[str, Any] = {"cloth.resolution": [6, 6], "cloth.anchors": [""], "gravity": [0.0, 0.0, 0.0]}
NO_TURN, HALF_TURN = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)


def cloth_at(*grippers: str, closed: bool = True, **values: Any) -> Simulation:
    """A cloth with each gripper at the last particle, closed or open."""
    scene = Scene.from_parameters({**BASE, "grippers": grippers or ["gripper"], **values})
    cloth = Simulation(scene)
    names = scene.gripper_names
    cloth.advance([Target(name, corner(cloth), NO_TURN) for name in names])
    cloth.advance([Grasp(name, closed) for name in names])
    return cloth


def corner(cloth: Simulation, y: float = 0.0) -> tuple[float, ...]:
    """Return a position at a distance y [m] from the last particle's start."""
    x0, y0, z0 = cloth.scene.initial_positions()[-1].tolist()
    return x0, y0 + y, z0


def position(cloth: Simulation, index: int = 0) -> np.ndarray:
    return cloth.grippers.poses()[index, :3]


@pytest.mark.parametrize("jump", [1.0, 100.0])
def test_jump_is_followed_at_the_limit(jump: float) -> None:
    cloth = cloth_at(**{"gripper.max_speed": 60.0})
    before, ways = position(cloth), []
    cloth.advance([Target("gripper", corner(cloth, jump), NO_TURN)])
    assert cloth.grippers.speed_limited == ({} if jump == 1.0 else {"gripper": pytest.approx(60.0 * jump)})
    while True:
        assert len(ways) < 100
        ways.append(float(np.linalg.norm(position(cloth) - before)))
        before = position(cloth)
        if not cloth.grippers.speed_limited:
            break
        cloth.advance()
    assert max(ways) <= 1.0 + 1e-6
    assert len(ways) == math.ceil(jump)
    assert position(cloth) == pytest.approx(corner(cloth, jump))


def test_default_limits_a_distant_target_and_forgets_it() -> None:
    cloth = cloth_at()
    cloth.advance([Target("gripper", corner(cloth, 1.0))])
    assert position(cloth)[1] - corner(cloth)[1] == pytest.approx(MAX_SPEED / 60.0)
    assert cloth.grippers.speed_limited == {"gripper": pytest.approx(60.0)}
    cloth.advance([Target("gripper", corner(cloth))])
    assert position(cloth) == pytest.approx(corner(cloth))
    assert not cloth.grippers.speed_limited


def test_velocity_is_continuous_at_the_limit() -> None:
    cloth = cloth_at(**{"gripper.max_speed": 2.0})
    ends, begins = [], []
    cloth.advance([Target("gripper", corner(cloth, 0.3), NO_TURN)])
    for _ in range(20):
        path = cloth.plan.grips.paths[0]
        begins.append(path[4:7].copy())
        h = cloth.scene.period
        ends.append(path[4:7] + h * (2.0 * path[7:10] + 3.0 * h * path[10:13]))
        cloth.advance()
    assert np.abs(np.array(begins[1:]) - np.array(ends[:-1])).max() < 1e-9
    # The gripper continues at its limit.
    assert begins[3][1] == pytest.approx(2.0)
    assert position(cloth) == pytest.approx(corner(cloth, 0.3))


def test_half_turn_speed_is_limited_by_grasped_particles() -> None:
    values = {"gripper.radius": 0.3, "cloth.size": [1.0, 1.0], "gripper.max_speed": 2.0}
    held, free = cloth_at(**values), cloth_at(closed=False, **values)
    particles = held.grippers.grasped_particles(0)
    reach = float(np.linalg.norm(held.positions[particles] - position(held), axis=1).max())
    for cloth in (held, free):
        cloth.advance([Target("gripper", corner(cloth), HALF_TURN)])
    # Nothing is grasped, so nothing moves.
    assert free.grippers.poses()[0, 3:].tolist() == list(HALF_TURN)
    assert held.grippers.speed_limited == {"gripper": pytest.approx(math.pi * reach * 60.0)}
    turn = rotation_vector(NO_TURN, held.grippers.poses()[0, 3:].tolist())
    assert np.linalg.norm(turn) * reach == pytest.approx(2.0 / 60.0)
    for _ in range(60):
        held.advance()
    assert held.grippers.poses()[0, 3:] == pytest.approx(HALF_TURN)


def test_each_gripper_has_its_own_limit() -> None:
    values = {"left.max_speed": 3.0, "gripper.max_speed": 0.0}
    cloth = cloth_at("left", "right", **values)
    cloth.advance([Target(name, corner(cloth, 1.0)) for name in ("left", "right")])
    assert position(cloth, 0)[1] - corner(cloth)[1] == pytest.approx(3.0 / 60.0)
    assert position(cloth, 1) == pytest.approx(corner(cloth, 1.0))
    assert list(cloth.grippers.speed_limited) == ["left"]
    cloth.advance([SetParameters({"right.max_speed": 1.0}), Target("right", corner(cloth))])
    assert corner(cloth, 1.0)[1] - position(cloth, 1)[1] == pytest.approx(1.0 / 60.0)
    assert cloth.scene.parameters()["right.max_speed"] == 1.0


@pytest.mark.parametrize("speed", [MAX_SPEED, 2.5])
def test_motion_up_to_the_limit_keeps_every_bit(speed: float) -> None:
    limited, free = cloth_at(**{"gripper.max_speed": speed}), cloth_at(**{"gripper.max_speed": 0.0})
    for k in range(30):
        # The exact limit, up to rounding, then back with a rotation.
        distance = min(k, 15) * speed / 60.0
        turned = (0.0, 0.0, 0.01 * k, 1.0)
        for cloth in (limited, free):
            cloth.advance([Target("gripper", corner(cloth, distance), turned if k > 15 else None)])
        assert not limited.grippers.speed_limited
        assert limited.state.digest() == free.state.digest()


def test_limit_changes_while_the_cloth_runs_and_reset_clears() -> None:
    cloth = cloth_at(**{"gripper.max_speed": 1.0})
    cloth.advance([Target("gripper", corner(cloth, 1.0))])
    assert cloth.grippers.speed_limited
    cloth.advance([SetParameters({"gripper.max_speed": 0.0})])
    assert position(cloth) == pytest.approx(corner(cloth, 1.0))
    cloth.advance([SetParameters({"gripper.max_speed": 1.0}), Target("gripper", corner(cloth))])
    assert cloth.grippers.speed_limited
    cloth.advance([Reset()])
    assert not cloth.grippers.speed_limited


def test_limit_holds_while_cloth_is_held() -> None:
    cloth = cloth_at(closed=False, **{"gripper.max_speed": 1.0})
    for y in (1.0, 100.0, 0.0):
        cloth.advance([Target("gripper", corner(cloth, y))])
        assert position(cloth) == pytest.approx(corner(cloth, y))
    cloth.advance([Grasp("gripper", True)])
    cloth.advance([Target("gripper", corner(cloth, 1.0))])
    assert position(cloth)[1] - corner(cloth)[1] == pytest.approx(1.0 / 60.0)
    # Events of a frame precede its motion: the released gripper jumps.
    cloth.advance([Grasp("gripper", False)])
    assert position(cloth) == pytest.approx(corner(cloth, 1.0))
    # A gripper closed on nothing jumps too.
    cloth.advance([Grasp("gripper", True)])
    cloth.advance([Target("gripper", corner(cloth))])
    assert position(cloth) == pytest.approx(corner(cloth))


def test_pads_keep_to_the_smaller_limit() -> None:
    values = {"gripper.mode": "pinch", "cloth.position": [0.0, 0.0, 5.0]}
    for speed, most in ((0.0, 10.0), (2.0, 2.0), (50.0, 10.0)):
        cloth = Simulation(Scene.from_parameters({**BASE, **values, "gripper.max_speed": speed}))
        cloth.advance([Target("gripper", (0.0, 0.0, 1.0))])
        cloth.advance([Target("gripper", (0.0, 1.0, 1.0))])
        assert position(cloth)[1] == pytest.approx(most / 60.0)
        assert list(cloth.grippers.speed_limited) == ["gripper"]
