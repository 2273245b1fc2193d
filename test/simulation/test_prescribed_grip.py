# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers with `gripper.model` prescribed: their particles follow them exactly, from closing to opening."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies import bodies
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.accuracy import certify
from cloth_sim_ros.verify.run import verify

GRAVITY = 9.81
#: A small sheet without anchors.
SMALL: dict[str, Any] = {
    "cloth.resolution": [8, 8],
    "cloth.size": [0.35, 0.35],
    "cloth.anchors": [""],
    "gripper.radius": 0.06,
    "gripper.model": "prescribed",
    "diagnostics.energy": True,
}
HUNG: dict[str, Any] = {**SMALL, "cloth.anchors": ["top_left"]}
#: A sheet on a table.
LYING: dict[str, Any] = {
    **SMALL,
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.005],
    "contact.thickness": 0.01,
    "gripper.radius": 0.02,
    "obstacles": ["table"],
    "table.shape": "plane",
    "table.position": [0.0, 0.0, -0.005],
}


def target(start: np.ndarray, k: int) -> Target:
    """Target of a frame: a circle that begins at rest, while the gripper turns."""
    angle = 2.0 * math.pi * k / 40.0
    away = 0.08 * np.array([1.0 - math.cos(angle), math.sin(angle) ** 2, math.sin(0.5 * angle) ** 2])
    return Target("gripper", tuple((start + away).tolist()), (0.1 * math.sin(angle), 0.0, 0.2 * math.sin(angle), 1.0))


def closed(scene: Scene) -> tuple[Simulation, np.ndarray]:
    """A simulation whose gripper has closed on the last particle, and the gripper's position then [m]."""
    cloth = Simulation(scene)
    start = cloth.positions[-1]
    (result,) = cloth.advance([Target("gripper", tuple(start.tolist())), Grasp("gripper", True)]).grasps
    assert result.grasped_count > 0
    return cloth, start


def points(cloth: Simulation, gripper: int = 0) -> np.ndarray:
    """Points of a gripper's particles by its pose [m], shape (m, 3)."""
    memory = cloth.state.memory
    starts, pose = memory["grip.starts"], memory["gripper.pose"][gripper]
    offsets = memory["grip.offsets"][starts[gripper] : starts[gripper + 1]]
    return np.asarray(pose[:3] + offsets @ rotation_matrix(pose[3:]).T)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"tolerance": 1e-6},
        {"tolerance": 0.0},
        {"integrator": "leapfrog"},
        {"integrator": "implicit"},
        {"integrator": "symplectic_euler", "tolerance": 0.0},
        {"work_limit": 0.001},
        {"bending.model": "crossed", "material.bending_modulus": 1e-4},
    ],
    ids=str,
)
def test_grasped_particles_are_at_their_points(values: dict[str, Any]) -> None:
    cloth, start = closed(Scene.from_parameters({**HUNG, **values}))
    for k in range(20):
        cloth.advance([target(start, k)])
        grasped = cloth.positions[cloth.grippers.grasped_particles(0)]
        assert np.abs(grasped - points(cloth)).max() < 1e-14


def test_wrench_at_rest_is_the_weight_also_asleep() -> None:
    cloth, _ = closed(Scene.from_parameters({**SMALL, "air.drag": 8.0, "tolerance": 1e-2}))
    weight = cloth.model.mass * GRAVITY
    frame = cloth.advance()
    while not cloth.asleep:
        frame = cloth.advance()
        assert cloth.frame < 3000
    assert frame.wrenches[0, :3] == pytest.approx([0.0, 0.0, -weight], abs=2e-3 * weight)
    asleep = [cloth.advance() for _ in range(3)][-1]
    assert asleep.advance is not None
    assert asleep.advance.steps == 0
    assert asleep.wrenches[0] == pytest.approx(frame.wrenches[0], abs=2e-3 * weight)
    pose = cloth.grippers.poses()[0]
    moved = cloth.advance([Target("gripper", (pose[0] + 0.01, pose[1], pose[2]))])
    assert not cloth.asleep
    assert moved.advance is not None
    assert moved.advance.steps > 0


def test_sheet_on_a_table_falls_asleep_in_a_gripper() -> None:
    cloth, _ = closed(
        Scene.from_parameters({**LYING, "table.friction": [0.5, 0.4], "air.drag": 8.0, "tolerance": 1e-2})
    )
    frame = cloth.advance()
    while not cloth.asleep:
        frame = cloth.advance()
        assert cloth.frame < 3000
    asleep = cloth.advance()
    assert asleep.advance is not None
    assert asleep.advance.steps == 0
    # The table pushes against the particle as before.
    assert asleep.wrenches[0, 2] == pytest.approx(frame.wrenches[0, 2], abs=1e-3)


def test_joints_to_obstacles_are_springs_beside_prescribed_grips() -> None:
    values = {
        **SMALL,
        "obstacles": ["pole"],
        "pole.shape": "sphere",
        "pole.size": [0.02],
        "pole.position": [0.0, 1.0, 1.0],
    }
    values |= {"cloth.joints": ["0-pole"], "contact.thickness": 0.004}
    cloth, start = closed(Scene.from_parameters(values))
    for k in range(10):
        cloth.advance([target(start, k)])
    grasped = cloth.grippers.grasped_particles(0)
    assert cloth.plan.prescribed_particles().tolist() == grasped.tolist()
    assert np.abs(cloth.positions[grasped] - points(cloth)).max() < 1e-14


@pytest.mark.parametrize("integrator", ["auto", "implicit"])
def test_energy_balance_closes(integrator: str) -> None:
    cloth, start = closed(Scene.from_parameters({**HUNG, "integrator": integrator, "tolerance": 1e-4}))
    for k in range(20):
        cloth.advance([target(start, k)])
    report = cloth.energy_report
    assert report is not None
    assert report.work > 1e-3
    assert abs(report.residual) < 1e-4 * report.turned_over


def test_closing_on_moving_cloth_dissipates_its_impulse() -> None:
    # The sheet falls; a gripper at rest stops a single particle.
    scene = Scene.from_parameters({**SMALL, "gripper.radius": 0.01, "air.drag": 0.0, "tolerance": 1e-6})
    cloth = Simulation(scene)
    for _ in range(12):
        cloth.advance()
    before = cloth.energy_report
    velocity, mass = cloth.state.v[:, -1].copy(), float(cloth.model.masses[-1])
    frame = cloth.advance([Target("gripper", tuple(cloth.positions[-1].tolist())), Grasp("gripper", True)])
    after = cloth.energy_report
    assert before is not None
    assert after is not None
    assert not cloth.state.v[:, -1].any()
    loss = 0.5 * mass * float(velocity @ velocity)
    assert after.dissipated - before.dissipated > loss
    assert abs(after.residual - before.residual) < 1e-3 * loss
    # The impulse belongs to the wrench of the first frame.
    assert frame.wrenches[0, 2] * scene.period < mass * velocity[2]


def test_opening_keeps_the_velocity() -> None:
    # The whole sheet is held, so that nothing but gravity acts on it afterwards.
    cloth, start = closed(Scene.from_parameters({**SMALL, "gripper.radius": 1.0, "air.drag": 0.0}))
    for k in range(10):
        cloth.advance([Target("gripper", tuple((start + np.array([0.01 * k, 0.0, 0.005 * k])).tolist()))])
    x, v, period = cloth.state.x.copy(), cloth.state.v.copy(), cloth.scene.period
    assert v[0] == pytest.approx(0.6)
    (result,) = cloth.advance([Grasp("gripper", False)]).grasps
    assert not result.closed
    fall = np.array([[0.0], [0.0], [-GRAVITY]])
    # Runs in single precision stretch the springs by their rounding.
    assert cloth.state.v == pytest.approx(v + period * fall, abs=1e-3)
    assert cloth.state.x == pytest.approx(x + period * v + 0.5 * period * period * fall, abs=1e-5)


def test_other_grippers_leave_prescribed_particles() -> None:
    names = {"grippers": ["left", "right"], "left.model": "prescribed", "gripper.model": "spring"}
    cloth = Simulation(Scene.from_parameters({**HUNG, **names}))
    position = tuple(cloth.positions[-1].tolist())
    events: list[Event] = [
        Target("left", position),
        Target("right", position),
        Grasp("left", True),
        Grasp("right", True),
    ]
    first, second = cloth.advance(events).grasps
    assert first.grasped_count == 3
    assert second.grasped_count == 0
    assert second.reason == "all 3 free particles within 0.06 m follow a gripper (gripper.model)"
    # The nearest particle that is left.
    cloth.advance([Grasp("right", False), Target("right", tuple(cloth.positions[-2].tolist()))])
    cloth.advance()
    (third,) = cloth.advance([Grasp("right", True)]).grasps
    grasped = set(cloth.grippers.grasped_particles(1).tolist())
    assert third.grasped_count == len(grasped) > 0
    assert not grasped & set(cloth.grippers.grasped_particles(0).tolist())


def test_anchored_particles_are_not_taken() -> None:
    cloth = Simulation(Scene.from_parameters({**HUNG, "gripper.radius": 0.01}))
    position = tuple(cloth.positions[0].tolist())
    (result,) = cloth.advance([Target("gripper", position), Grasp("gripper", True)]).grasps
    assert result.reason == "all 1 particles within 0.01 m are anchored"


def test_snapshot_within_a_grasp_continues_with_equal_bits() -> None:
    cloth, start = closed(Scene.from_parameters(HUNG))
    for k in range(8):
        cloth.advance([target(start, k)])
    snapshot, state = cloth.snapshot(), State.from_bytes(cloth.state.to_bytes())
    first = [cloth.advance([target(start, k)]) for k in range(8, 16)]
    digest = cloth.state.digest()
    cloth.restore(snapshot)
    second = [cloth.advance([target(start, k)]) for k in range(8, 16)]
    assert cloth.state.digest() == digest
    assert all(np.array_equal(a.wrenches, b.wrenches) for a, b in zip(first, second, strict=True))
    loaded = Simulation(cloth.scene, state)
    for k in range(8, 16):
        loaded.advance([target(start, k)])
    assert loaded.state.digest() == digest


@pytest.mark.parametrize("values", [HUNG, {**LYING, "tolerance": 1e-3}], ids=["hung", "lying"])
def test_session_reruns_to_the_last_bit(values: dict[str, Any], tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(values))
    start = maker.simulation.positions[-1]
    maker.add([Target("gripper", tuple(start.tolist()))])
    maker.add([Grasp("gripper", True)])
    for k in range(14):
        maker.add([target(start, k)])
    maker.add([Grasp("gripper", False)])
    for _ in range(4):
        maker.add()
    verdict = verify([maker.finish()])
    assert verdict.same
    assert verdict.frames == 21


def test_certificate_agrees_with_independent_integrator(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters({**HUNG, "tolerance": 1e-4, "diagnostics.energy": False}))
    start = maker.simulation.positions[-1]
    maker.add([Target("gripper", tuple(start.tolist()))])
    maker.add([Grasp("gripper", True)])
    for k in range(12):
        maker.add([target(start, k)])
    verdict, certificate = certify([maker.finish()], every_sample=True)
    assert verdict.same
    assert len(certificate.samples) == len(certificate.frames) > 0
    assert all(sample.agrees for sample in certificate.samples)
    assert max(sample.difference for sample in certificate.samples) < 1e-8
    assert max(sample.independent for sample in certificate.samples) > 1e-8


def test_gripper_stops_before_its_particle_enters_an_obstacle() -> None:
    cloth, start = closed(Scene.from_parameters(LYING))
    frames = [cloth.advance([Target("gripper", (start[0], start[1], start[2] - 0.005 * k))]) for k in range(1, 9)]
    assert frames[0].stopped == ()
    assert frames[-1].stopped == ("gripper",)
    assert frames[-1].lagging[0][0] == "gripper"
    assert -0.004 < cloth.positions[-1, 2] < 0.003
    # The gripper feels the table.
    assert frames[-1].wrenches[0, 2] > 1.0
    for k in range(12):
        frame = cloth.advance([Target("gripper", (start[0], start[1], start[2] + 0.01 * k))])
    assert frame.stopped == ()
    assert cloth.positions[-1] == pytest.approx([start[0], start[1], start[2] + 0.11])
    cloth.advance([Grasp("gripper", False)])
    for _ in range(30):
        cloth.advance()
    assert np.isfinite(cloth.positions).all()


def test_gripper_slides_along_a_near_obstacle() -> None:
    turn = Rotation.from_euler("xyz", [0.2, 0.3, 0.1])
    orientation, normal, along = turn.as_quat().tolist(), turn.apply([0.0, 0.0, 1.0]), turn.apply([1.0, 0.4, 0.0])
    tilted = {
        "table.orientation": orientation,
        "table.position": [0.0, 0.0, 0.0],
        "cloth.orientation": orientation,
        "cloth.position": (5e-4 * normal).tolist(),
    }
    cloth, start = closed(Scene.from_parameters({**LYING, **tilted}))
    frames = [cloth.advance([Target("gripper", tuple((start + 0.002 * k * along).tolist()))]) for k in range(1, 13)]
    assert all(frame.stopped == () for frame in frames)
    assert cloth.positions[-1] == pytest.approx(start + 0.024 * along)
    frame = cloth.advance([Target("gripper", tuple((start + 0.024 * along - 1e-4 * normal).tolist()))])
    assert frame.stopped == ("gripper",)


def test_gripper_that_crushes_the_cloth_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    # Without the test of its path, the frame that has no solution stops it.
    monkeypatch.setattr(bodies, "blocked_grippers", lambda *_: [])
    cloth, start = closed(Scene.from_parameters({**LYING, "tolerance": 1e-2}))
    frames = [cloth.advance([Target("gripper", (start[0], start[1], start[2] - 0.0064 * k))]) for k in range(1, 4)]
    assert [frame.stopped for frame in frames] == [(), ("gripper",), ("gripper",)]
    assert cloth.positions[-1, 2] == pytest.approx(start[2] - 0.0064)


def test_state_with_two_motions_of_a_particle_is_refused() -> None:
    values = {**HUNG, "grippers": ["left", "right"], "gripper.model": "spring"}
    cloth = Simulation(Scene.from_parameters(values))
    position = tuple(cloth.positions[-1].tolist())
    events: list[Event] = [Target("left", position), Target("right", position), Grasp("left", True)]
    cloth.advance([*events, Grasp("right", True)])
    mixed = Simulation(Scene.from_parameters({**values, "left.model": "prescribed"}), cloth.state)
    mixed.advance()
    assert np.abs(mixed.positions[-3:] - cloth.positions[-3:]).max() < 0.1
    with pytest.raises(ValueError, match=r"the state has particle \d+ in two grippers, which both prescribe"):
        Simulation(Scene.from_parameters({**values, "gripper.model": "prescribed"}), cloth.state)


def test_prescribed_grip_sets_no_step() -> None:
    values = {**HUNG, "cloth.resolution": [20, 20], "cloth.size": [1.0, 1.0], "tolerance": 0.0}
    limits = {}
    for model in ("spring", "prescribed", "open"):
        grip = {"gripper.model": "spring" if model == "open" else model}
        cloth, _ = closed(Scene.from_parameters({**values, **grip}))
        if model == "open":
            cloth.advance([Grasp("gripper", False)])
        frame = cloth.advance()
        assert frame.advance is not None
        limits[model] = frame.advance.limit
    assert limits["prescribed"] > 1.15 * limits["spring"]
    assert limits["prescribed"] == pytest.approx(limits["open"], rel=0.05)


def test_model_is_declared_for_all_and_for_one() -> None:
    assert Scene().gripper.model == "spring"
    two = {"grippers": ["left", "right"], "left.model": "prescribed"}
    scene = Scene.from_parameters(two)
    assert scene.prescribing == ["left"]
    assert Scene.from_parameters(scene.parameters()) == scene
    assert Scene.from_parameters({**two, "gripper.model": "prescribed", "left.mode": "pinch"}).prescribing == ["right"]
    with pytest.raises(ParameterError, match=r"gripper\.model is 'glue'; it must be one of spring, prescribed"):
        Scene.from_parameters({"gripper.model": "glue"})
    with pytest.raises(ParameterError, match=r"hand\.model is set, and there is no gripper 'hand'"):
        Scene.from_parameters({**two, "hand.model": "spring"})
    with pytest.raises(ParameterError, match=r"gripper\.model"):
        scene.changed({"gripper.model": "prescribed"})


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (
            {"gripper.model": "prescribed", "gripper.stiffness": 10.0},
            "gripper.stiffness is set and has no effect: no gripper holds by springs (gripper.model)",
        ),
        (
            {"gripper.model": "prescribed", "grippers": [""]},
            "gripper.model is set and has no effect: there are no grippers",
        ),
        (
            {"gripper.model": "prescribed", "gripper.mode": "pinch"},
            "gripper.model is set and has no effect: no gripper attaches (gripper.mode)",
        ),
        ({"grippers": ["a", "b"], "a.model": "prescribed", "gripper.stiffness": 10.0}, ""),
    ],
)
def test_ineffective_parameters_are_named(values: dict[str, Any], sentence: str) -> None:
    assert ineffective_parameters(Scene.from_parameters(values), values) == ([sentence] if sentence else [])
