# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joints (S4) between particles and obstacles: balances, moved, removed and added obstacles."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.ros.check import check
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.parameter_file import dump
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Move, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.main import main as verify

#: A sheet of 5 x 6 in still vacuum below a bar; its upper edge is joined to the bar.
BAR: dict[str, Any] = {
    "cloth.resolution": [5, 6], "cloth.size": [0.5, 0.6], "cloth.anchors": [""], "air.drag": 0.0,
    "wind.normal_drag": 0.0, "grippers": [""], "tolerance": 1e-4, "obstacles": ["bar"], "bar.shape": "box",
    "bar.size": [0.8, 0.02, 0.02], "bar.position": [0.0, 0.0, 1.28], "cloth.joints": ["top-bar"],
}  # fmt: skip
WEIGHT = 0.2 * 0.5 * 0.6 * 9.81
#: A quarter turn about z.
QUARTER = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
ROD: dict[str, Any] = {"rod.shape": "sphere", "rod.size": [0.02], "rod.position": [0.0, 0.0, 0.4]}
CALM = {"air.drag": 4.0, "cloth.joint_damping": 2.0, "tolerance": 1e-3}


def bar_scene(**values: Any) -> Scene:
    return Scene.from_parameters({**BAR, **values})


def stretches(simulation: Simulation) -> np.ndarray:
    """Return the separation of each joined particle from its point on the bar [m], shape (6, 3)."""
    pose = simulation.state.memory["obstacle.pose"][0]
    points = pose[:3] + simulation.state.memory["joint.offsets"] @ rotation_matrix(pose[3:]).T
    return simulation.positions[:6] - points


def advance(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(60 * seconds)):
        simulation.advance()


def test_joints_carry_the_weight_of_a_sheet_at_rest() -> None:
    simulation = Simulation(bar_scene(**CALM))
    advance(simulation, 4.0)
    assert -1000.0 * stretches(simulation).sum(axis=0) == pytest.approx([0.0, 0.0, WEIGHT], rel=1e-3, abs=1e-3)
    assert simulation.advance().obstacle_wrenches[0, :3] == pytest.approx([0.0, 0.0, -WEIGHT], rel=1e-3, abs=1e-3)


def test_momentum_changes_by_weight_and_wrench_on_the_bar() -> None:
    simulation = Simulation(bar_scene())
    masses = simulation.model.masses
    for index in range(40):
        before = masses @ simulation.velocities
        frame = simulation.advance([Move("bar", (0.01 * index, 0.0, 1.28))] if index < 20 else [])
        impulse = masses @ simulation.velocities - before
        expected = (np.array([0.0, 0.0, -WEIGHT]) - frame.obstacle_wrenches[0, :3]) / 60.0
        assert impulse == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_work_of_a_moved_bar_closes_the_energy_balance() -> None:
    simulation = Simulation(bar_scene(**{"diagnostics.energy": True}))
    for index in range(40):
        simulation.advance([Move("bar", (0.0, 0.05 * np.sin(0.2 * index), 1.28 + 0.005 * index))])
    report = simulation.energy_report
    assert report is not None
    assert report.work > 0.1
    assert abs(report.residual) < 1e-4 * report.turned_over


def test_joined_particles_turn_with_the_bar() -> None:
    simulation = Simulation(bar_scene(**CALM))
    start = simulation.positions[:6]
    simulation.advance([Move("bar", (0.1, 0.0, 1.4), QUARTER)])
    advance(simulation, 4.0)
    turned = np.stack([0.1 - start[:, 1], start[:, 0], start[:, 2] + 0.12], axis=1)
    assert np.abs(simulation.positions[:6] - turned).max() < 2.0 * WEIGHT / 6.0 / 1000.0


def test_sheet_falls_without_its_bar_and_hangs_on_a_new_one() -> None:
    simulation = Simulation(bar_scene())
    advance(simulation, 0.5)
    simulation.advance([SetParameters({"obstacles": [""]})])
    assert "joint.offsets" not in simulation.state.memory
    velocity = simulation.model.masses @ simulation.velocities
    advance(simulation, 0.1)
    fall = simulation.model.masses @ simulation.velocities - velocity
    assert fall == pytest.approx([0.0, 0.0, -0.1 * WEIGHT], rel=1e-6, abs=1e-9)
    frame = simulation.advance([SetParameters({"obstacles": ["bar"]})])
    assert np.abs(stretches(simulation)).max() < 0.1
    assert frame.obstacle_wrenches[0, 2] < 0.0
    start = simulation.positions
    advance(simulation, 1.0)
    assert np.abs(simulation.positions - start).max() < 0.2


def test_remaining_bar_keeps_its_joints() -> None:
    simulation = Simulation(bar_scene(**ROD, **{"cloth.joints": ["top-bar", "rod-27"]}))
    offsets = simulation.state.memory["joint.offsets"]
    assert offsets.shape == (6, 3)
    advance(simulation, 0.2)
    simulation.advance([SetParameters({"obstacles": ["rod", "bar"]})])
    assert np.array_equal(simulation.state.memory["joint.offsets"][1:], offsets)
    simulation.advance([SetParameters({"obstacles": ["bar"]})])
    assert np.array_equal(simulation.state.memory["joint.offsets"], offsets)


def test_stiffness_changes_while_the_sheet_hangs() -> None:
    simulation = Simulation(bar_scene(**CALM))
    advance(simulation, 3.0)
    soft = stretches(simulation)[:, 2].sum()
    simulation.advance([SetParameters({"cloth.joint_stiffness": 2000.0})])
    advance(simulation, 3.0)
    assert stretches(simulation)[:, 2].sum() == pytest.approx(0.5 * soft, rel=1e-2)


def test_gripper_and_joints_hold_one_sheet() -> None:
    values = {**CALM, "grippers": ["hand"], "gripper.radius": 0.05}
    simulation = Simulation(bar_scene(**values))
    position = tuple(simulation.positions[24].tolist())
    simulation.advance([Target("hand", position), Grasp("hand", True)])
    advance(simulation, 3.0)
    frame = simulation.advance()
    assert frame.wrenches.shape == (1, 6)
    total = frame.wrenches[0, :3] + frame.obstacle_wrenches[0, :3]
    assert total == pytest.approx([0.0, 0.0, -WEIGHT], rel=1e-3, abs=1e-3)
    assert simulation.positions[24] == pytest.approx(position, abs=1e-2)


def test_reset_and_restore_give_the_same_frames() -> None:
    simulation = Simulation(bar_scene())
    snapshot, digests = simulation.snapshot(), list[str]()
    for _ in range(2):
        for index in range(20):
            simulation.advance([Move("bar", (0.1, 0.0, 1.3))] if index == 5 else [])
        digests.append(simulation.state.digest())
        simulation.restore(snapshot)
    assert digests[0] == digests[1]
    advance(simulation, 0.2)
    offsets = simulation.state.memory["joint.offsets"]
    simulation.advance([SetParameters({"obstacles": [""]}), SetParameters({"obstacles": ["bar"]})])
    assert not np.array_equal(simulation.state.memory["joint.offsets"], offsets)
    simulation.advance([Reset()])
    assert np.array_equal(simulation.state.memory["joint.offsets"], offsets)


def test_saved_state_keeps_the_joints() -> None:
    scene = bar_scene()
    simulation = Simulation(scene)
    advance(simulation, 0.5)
    loaded = Simulation(scene, State.from_bytes(simulation.state.to_bytes()))
    for running in (simulation, loaded):
        running.advance([Move("bar", (0.1, 0.0, 1.3))])
    assert loaded.state.digest() == simulation.state.digest()
    with pytest.raises(ValueError, match=r"the state has 6 joints to obstacles, the scene none"):
        Simulation(bar_scene(**{"cloth.joints": [""]}), simulation.state)
    with pytest.raises(ValueError, match=r"the state has 6 joints to obstacles, the scene 1 \(cloth\.joints\)"):
        Simulation(bar_scene(**{"cloth.joints": ["0-bar"]}), simulation.state)


def test_session_with_joints_runs_again(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, bar_scene(**ROD, obstacles=["rod", "bar"]))
    for index in range(70):
        events = {20: Move("bar", (0.05, 0.1, 1.35), QUARTER), 40: SetParameters({"obstacles": ["rod"]}),
                  45: SetParameters({"obstacles": ["rod", "bar"]})}  # fmt: skip
        maker.add([events[index]] if index in events else [])
    assert verify([str(maker.finish())]) == 0


def test_certificate_knows_the_joints(tmp_path: Path) -> None:
    small = {"cloth.resolution": [2, 3], "cloth.size": [0.2, 0.2], "bar.position": [0.0, 0.0, 1.13], "tolerance": 1e-3}
    maker = SessionMaker(tmp_path, bar_scene(**small))
    for index in range(20):
        maker.add([Move("bar", (0.002 * index, 0.0, 1.13), (0.0, 0.0, 0.0, 1.0))])
    assert verify(["--accuracy", str(maker.finish())]) == 0


def test_pieces_of_a_mesh_hang_on_one_bar() -> None:
    faces = "\nf 1 2 3\nf 4 5 6"
    vertices = [
        f"v {x} {y} 0" for x, y in ((-0.3, 0.0), (-0.1, 0.0), (-0.2, -0.2), (0.1, 0.0), (0.3, 0.0), (0.2, -0.2))
    ]
    mesh = {
        **CALM,
        "cloth.mesh": "m.obj",
        "cloth.joints": ["0-bar", "1-bar", "3-bar", "4-bar"],
        "bending.model": "none",
    }
    files = {"m.obj": ("\n".join(vertices) + faces).encode()}
    scene = Scene.from_parameters({**BAR, **mesh, "bar.position": [0.0, 0.0, 1.05]}, files=files)
    simulation = Simulation(scene)
    advance(simulation, 1.0)
    assert simulation.positions[:, 2].min() > 0.75
    with pytest.raises(ParameterError, match=r"nothing connects particle 3 with particle 0"):
        Scene.from_parameters({**BAR, **mesh, "cloth.joints": ["0-bar"]}, files=files)


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (["bar-bar"], "cloth.joints has 'bar-bar', which joins two obstacles; name a particle and one"),
        (["0-bar", "top-bar"], "cloth.joints joins particle 0 and obstacle 'bar' 2 times; name the joint once"),
        (["0-rail"], "or give a particle's number or an obstacle's name"),
        (["30-bar"], "cloth.joints names particle 30; there are 30, counted from 0"),
    ],
)
def test_invalid_obstacle_joints_are_refused(joints: list[str], words: str) -> None:
    with pytest.raises(ParameterError) as caught:
        bar_scene(**{"cloth.joints": joints})
    assert words in str(caught.value)


def test_check_reports_obstacle_joints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.yaml").write_text(dump(BAR))
    assert check.check(str(tmp_path / "scene.yaml"), node="cloth_sim") == 0
    assert "6 joints to obstacle 'bar'" in capsys.readouterr().out


def test_model_of_a_scene_has_its_joints() -> None:
    scene = bar_scene()
    grips = scene.model().force("grips")
    simulation = Simulation(scene)
    simulation.advance()
    assert np.array_equal(grips.offsets, simulation.state.memory["joint.offsets"])
    assert np.array_equal(grips.stiffness, simulation.plan.grips.stiffness)
    assert np.array_equal(grips.damping, simulation.plan.grips.damping)
