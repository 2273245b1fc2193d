# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A cloth on obstacles: it lies, sleeps, wakes, is moved and released, with reproducible bits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Move, Pause, Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

#: A flat cloth of 0.2 kg/m^2 and 1 m^2 that lies on a block.
LYING: dict[str, Any] = {
    "cloth.resolution": [8, 8],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.0529],
    "cloth.anchors": [""],
    "wind.normal_drag": 0.0,
    "tolerance": 1e-3,
    "obstacles": ["block"],
    "block.shape": "box",
    "block.size": [1.2, 1.2, 0.1],
}
WEIGHT = 0.2 * 9.81


@pytest.fixture(scope="module")
def rested() -> State:
    """A state in which the cloth lies asleep."""
    cloth = Simulation(Scene.from_parameters(LYING))
    for _ in range(900):
        cloth.advance()
        if cloth.asleep:
            return cloth.state
    pytest.fail("it does not come to rest")


def lying(rested: State) -> Simulation:
    return Simulation(Scene.from_parameters(LYING), rested)


def test_lying_cloth_sleeps_and_reports_its_weight(rested: State) -> None:
    cloth = lying(rested)
    frame = cloth.advance()
    assert cloth.asleep
    assert frame.advance is not None
    assert frame.advance.steps == 0
    assert frame.obstacle_wrenches[0, 2] == pytest.approx(-WEIGHT, rel=1e-3)
    assert np.abs(frame.obstacle_wrenches[0, [0, 1, 3, 4, 5]]).max() < 1e-3
    gaps = cloth.gaps()
    assert gaps is not None
    assert gaps[0, 0] == 64
    assert 0.0025 < gaps[0, 1] < 0.003


def test_gaps_follow_obstacles_before_frames_and_while_paused(rested: State) -> None:
    cloth = Simulation(Scene.from_parameters({**LYING, "block.position": [0.0, 0.0, -0.001]}))
    gaps = cloth.gaps()
    assert gaps is not None
    assert gaps[0, 1] == pytest.approx(0.0039)
    cloth.advance([Move("block", (0.0, 0.0, -0.1))])
    cloth.advance([Reset(), Pause(True)])
    gaps = cloth.gaps()
    assert gaps is not None
    assert gaps[0, 1] == pytest.approx(0.0039)


def test_moving_obstacle_wakes_and_carries_the_cloth(rested: State) -> None:
    cloth = lying(rested)
    cloth.advance()
    height = cloth.positions[:, 2].mean()
    for k in range(30):
        cloth.advance([Move("block", (0.0, 0.0, 0.002 * (k + 1)))])
        assert not cloth.asleep
    assert cloth.positions[:, 2].mean() == pytest.approx(height + 0.06, abs=0.003)


def test_work_of_a_moving_obstacle_is_recorded(rested: State) -> None:
    cloth = Simulation(Scene.from_parameters({**LYING, "diagnostics.energy": True, "air.drag": 0.0}), rested)
    for k in range(30):
        cloth.advance([Move("block", (0.0, 0.0, 0.005 * (k + 1)))])
    report = cloth.energy_report
    assert report is not None
    # 0.2 kg lifted by 0.15 m, and in motion.
    assert report.work == pytest.approx(0.2 * 9.81 * 0.15 + 0.5 * 0.2 * 0.3**2, rel=0.05)
    assert abs(report.residual) < 1e-3 * report.work


def test_contact_damping_reduces_the_bounce() -> None:
    def bounce(damping: float) -> float:
        values = {"cloth.position": [0.0, 0.0, 0.15], "contact.damping": damping, "air.drag": 0.0, "grippers": [""]}
        cloth = Simulation(Scene.from_parameters({**LYING, **values}))
        speed = 0.0
        for _ in range(20):
            cloth.advance()
            speed = max(speed, float(cloth.velocities[:, 2].mean()))
        return speed

    # It falls by 0.1 m and lands at 1.4 m/s; some of that energy goes into waves.
    assert 1.2 < bounce(0.0) < 1.41
    assert bounce(10.0) < 0.6


def test_removed_obstacle_lets_the_cloth_fall(rested: State) -> None:
    cloth = lying(rested)
    cloth.advance([SetParameters({"obstacles": [""]})])
    assert not cloth.asleep
    for _ in range(5):
        cloth.advance()
    assert cloth.velocities[:, 2].max() < -0.5
    assert cloth.gaps() is None
    with pytest.raises(EventError, match=r"the cloth is inside obstacle 'block': particle \d+ at"):
        cloth.advance([SetParameters({"obstacles": ["block"]})])


def test_cloth_does_not_pass_through_at_any_speed() -> None:
    values = {"cloth.position": [0.0, 0.0, 0.4], "gravity": [0.0, 0.0, -9.81], "wind.velocity": [0.0, 0.0, -20.0]}
    cloth = Simulation(Scene.from_parameters({**LYING, **values, "air.drag": 1.0}))
    cloth.state.v[2] = -20.0
    least = np.inf
    for _ in range(20):
        cloth.advance()
        gaps = cloth.gaps()
        assert gaps is not None
        least = min(least, gaps[0, 1])
    assert least > 0.0


def test_block_pushed_into_the_cloth_carries_it(rested: State) -> None:
    # Commanded to the far side at once, the block follows at its speed limit, and the cloth stays in front of it.
    cloth = lying(rested)
    cloth.advance([Move("block", (0.0, 0.0, 0.5))])
    for _ in range(10):
        cloth.advance()
        assert cloth.obstacles is not None
        top = cloth.obstacles.poses()[0, 2] + 0.05
        assert cloth.positions[:, 2].min() > top


def test_same_commands_from_any_frame_give_the_same_bits(rested: State) -> None:
    cloth = lying(rested)
    script = {3: [Move("block", (0.01, 0.0, 0.02))], 8: [SetParameters({"block.friction": [0.2]})], 12: [Reset()]}
    states, digests = [], []
    for k in range(16):
        states.append(cloth.state.copy())
        cloth.advance(script.get(k, []))
        digests.append(cloth.state.digest())
    for begin in (2, 5, 9):
        changed = {"block.friction": [0.2]} if begin > 8 else {}
        again = Simulation(Scene.from_parameters({**LYING, **changed}), State.from_bytes(states[begin].to_bytes()))
        for k in range(begin, 16):
            again.advance(script.get(k, []))
            assert again.state.digest() == digests[k]


def test_a_frame_that_fails_leaves_everything_as_it_was(rested: State) -> None:
    cloth = lying(rested)
    cloth.advance([Move("block", (0.0, 0.0, 0.01))])
    before = cloth.state.digest()
    with pytest.raises(EventError):
        cloth.advance(
            [SetParameters({"obstacles": ["block", "ball"], "ball.shape": "sphere"}), Move("ball", (9e9, 0, 0))]
        )
    assert cloth.state.digest() == before
    assert cloth.scene.obstacle_names == ["block"]
    reference = Simulation(cloth.scene, cloth.state)
    for _ in range(3):
        cloth.advance()
        reference.advance()
    assert cloth.state.digest() == reference.state.digest()


def test_reset_into_an_obstacle_is_refused(rested: State) -> None:
    cloth = lying(rested)
    ball = {"ball.shape": "sphere", "ball.size": [0.1], "ball.position": [0.0, 0.0, -2.0]}
    cloth.advance([SetParameters({"obstacles": ["block", "ball"], **ball})])
    cloth.advance([Reset()])
    cloth.advance([SetParameters({"obstacles": ["block"]})])
    for _ in range(40):
        cloth.advance([Move("block", (0.0, 0.0, 0.3))])
    near_ball = {"ball.size": [0.2], "ball.position": [0.0, 0.0, 0.1]}
    cloth.advance([SetParameters({"obstacles": ["block", "ball"], **near_ball})])
    with pytest.raises(EventError, match="the cloth as it starts is inside obstacle 'ball'"):
        cloth.advance([Reset()])


def test_plan_has_obstacles_at_scene_poses() -> None:
    turn = [0.0, 0.3826834323650898, 0.0, 0.9238795325112867]
    values = {"cloth.anchors": [""], "cloth.position": [0.0, 0.0, 1.0], "obstacles": ["slope", "ball"]}
    shapes = {"slope.shape": "plane", "slope.position": [0.1, 0.2, -3.0], "slope.orientation": turn}
    ball = {"ball.shape": "sphere", "ball.size": [0.1], "ball.position": [3.0, 0.0, 0.0]}
    scene = Scene.from_parameters({**values, **shapes, **ball})
    plan, state = scene.plan(), scene.starting_state()
    simulation = Simulation(scene)
    assert plan.contact is not None
    gaps = simulation.gaps()
    assert gaps is not None
    assert np.array_equal(plan.contact.obstacle_gaps(0.0, state.x, memory=state.memory), gaps)


def test_cloth_inside_obstacle_is_refused_with_its_name() -> None:
    scene = Scene.from_parameters(
        {"cloth.anchors": [""], "obstacles": ["wall"], "wall.shape": "plane", "wall.position": [0.0, 0.0, 9.0]}
    )
    with pytest.raises(ValueError, match=r"m deep inside obstacle 'wall' at 0 s"):
        scene.build_integrator().advance(scene.plan(), scene.starting_state(), 0.0, 1.0 / 60.0)


def test_obstacle_motion_within_one_frame_acts_on_the_cloth() -> None:
    # At either end of the frame the obstacle is far away, or as slow as the cloth. It is fast only in between.
    values = {
        "cloth.resolution": [8, 8],
        "contact.thickness": 0.01,
        "material.stretch_modulus": 3e4,
        "grippers": [""],
        "obstacles": ["front", "back"],
        **{f"{name}.shape": "box" for name in ("front", "back")},
        **{f"{name}.size": [1.2, 0.1, 1.2] for name in ("front", "back")},
        "front.position": [0.0, -0.2, 1.0],
        "back.position": [0.0, 0.2, 1.0],
    }
    cloth = Simulation(Scene.from_parameters(values))
    before = cloth.energy()
    # Two plates press the sheet from both sides, so that it does not move: their work is stored in the gaps.
    cloth.advance([Move("front", (0.0, -0.053, 1.0)), Move("back", (0.0, 0.053, 1.0))])
    assert cloth.gaps()[:, 1] == pytest.approx([0.003, 0.003], rel=1e-3)
    # private: not public without energy diagnostics
    put_in = cloth._accumulator.work - cloth._accumulator.dissipation
    assert cloth.energy() - before > 100.0
    assert put_in == pytest.approx(cloth.energy() - before, rel=0.02)
