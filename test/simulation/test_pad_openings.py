# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pads that close or open to a commanded distance, with a commanded force and speed."""

from __future__ import annotations

import json
from typing import Any

import pytest

from cloth_sim_ros import Scene
from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw, drive_inertia
from cloth_sim_ros.physics.state.controller_state import SETPOINTS_KEY
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.simulation.bodies.grippers import GraspResult
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Grasp, Reset, SetParameters, Target, from_dict, to_dict
from cloth_sim_ros.simulation.simulation import Simulation

OPENING = 0.06
PINCH: dict[str, Any] = {
    "gripper.mode": "pinch",
    "gripper.pad_size": [0.15, 0.02, 0.15],
    "gripper.opening": OPENING,
    "gripper.force": 2.0,
    "cloth.resolution": [6, 6],
    "cloth.size": [0.3, 0.3],
    "cloth.position": [0.0, 0.0, 0.15],
    "tolerance": 1e-3,
}
CORNER, FAR_AWAY = (0.15, 0.0, 0.0), (0.6, 0.0, 0.0)


def gripper_at(position: tuple[float, ...], **values: Any) -> Simulation:
    cloth = Simulation(Scene.from_parameters({**PINCH, **values}))
    cloth.advance([Target("gripper", position)])
    return cloth


def moved(cloth: Simulation, *grasps: Grasp, frames: int = 80) -> tuple[list[GraspResult], int]:
    """Return the results of the first frame that reports resting pads, and the number of frames until then."""
    events: list[Any] = list(grasps)
    for count in range(1, frames):
        frame = cloth.advance(events)
        if frame.pinches:
            return list(frame.pinches), count
        events = []
    return [], frames


def gap(cloth: Simulation) -> float:
    assert cloth.pinching is not None
    return cloth.pinching.drive_state("gripper")[0]


@pytest.mark.parametrize("integrator", ["auto", "implicit"])
def test_pads_stop_at_commanded_opening(integrator: str) -> None:
    cloth = gripper_at(FAR_AWAY, integrator=integrator)
    for closed, opening in ((True, 0.03), (True, 0.02), (False, 0.05), (True, 0.0), (False, OPENING)):
        results, _ = moved(cloth, Grasp("gripper", closed, opening))
        assert [(result.closed, result.reached) for result in results] == [(closed, True)]
        # A stop gives way by a part of the contact thickness, 3 mm.
        assert gap(cloth) == pytest.approx(opening, abs=1.5e-3)


def test_cloth_stops_pads_before_commanded_opening() -> None:
    cloth = gripper_at(CORNER)
    results, _ = moved(cloth, Grasp("gripper", True, 0.0))
    assert [(result.reached, result.grasped_count) for result in results] == [(False, 4)]
    held = gap(cloth)
    # A larger opening than that of the cloth between the pads is reached.
    results, _ = moved(cloth, Grasp("gripper", False, 0.02))
    assert [(result.reached, result.closed) for result in results] == [(True, False)]
    results, _ = moved(cloth, Grasp("gripper", True, held - 1e-3))
    assert [result.reached for result in results] == [False]


def test_force_and_speed_are_limits() -> None:
    cloth = gripper_at(FAR_AWAY)
    _, fast = moved(cloth, Grasp("gripper", True, 0.03))
    cloth = gripper_at(FAR_AWAY)
    _, slow = moved(cloth, Grasp("gripper", True, 0.03, force=1.0, speed=0.025))
    # 15 mm for each pad at 0.05 m/s take 18 frames.
    assert (fast, slow) == (pytest.approx(19, abs=2), pytest.approx(37, abs=2))
    assert cloth.pinching is not None
    assert cloth.pinching.drive_state("gripper")[2] == pytest.approx(1.0, rel=1e-3)
    # Above those of the scene they change nothing.
    moved(cloth, Grasp("gripper", True, 0.02, force=50.0, speed=5.0))
    assert cloth.pinching.drive_state("gripper")[2] == pytest.approx(2.0, rel=1e-3)


def test_plain_grasp_replaces_opening() -> None:
    cloth = gripper_at(FAR_AWAY)
    moved(cloth, Grasp("gripper", True, 0.03))
    results, _ = moved(cloth, Grasp("gripper", True))
    assert [result.reached for result in results] == [True]
    assert gap(cloth) == pytest.approx(0.0, abs=1.5e-3)
    cloth.advance([Grasp("gripper", False)])
    for _ in range(60):
        assert not cloth.advance().pinches
    assert gap(cloth) == pytest.approx(OPENING, abs=1.5e-3)
    cloth.advance([Reset()])
    assert SETPOINTS_KEY not in cloth.state.memory


def test_held_opening_stops_moving_pads() -> None:
    cloth = gripper_at(FAR_AWAY)
    for _ in range(6):
        cloth.advance([Grasp("gripper", True, 0.0)])
    present = gap(cloth)
    results, count = moved(cloth, Grasp("gripper", True, present))
    assert results[0].reached
    assert count <= 3
    assert gap(cloth) == pytest.approx(present, abs=1e-3)


@pytest.mark.parametrize(
    ("grasp", "words"),
    [
        (Grasp("gripper", True, 0.07), "opening of 'gripper' is 0.07 m; it must be from 0 to 0.06 m"),
        (Grasp("gripper", True, float("nan")), "opening of 'gripper' is nan m"),
        (Grasp("gripper", False, 0.01), "its pads are 0.06022 m apart; they cannot open to that: close them"),
        (Grasp("gripper", True, 0.03, force=-1.0), "force of 'gripper' is -1.0 N"),
        (Grasp("gripper", True, 0.03, speed=1e-6), "speed of 'gripper' is 1e-06 m/s; it must be at least 0.0001 m/s"),
    ],
)
def test_impossible_opening_is_refused(grasp: Grasp, words: str) -> None:
    cloth = gripper_at(FAR_AWAY)
    with pytest.raises(EventError, match=words.replace("(", r"\(")):
        cloth.advance([grasp])


def test_opening_of_attaching_gripper_is_refused() -> None:
    cloth = Simulation(Scene())
    with pytest.raises(EventError, match="it has no pads: set gripper"):
        cloth.advance([Grasp("gripper", True, 0.01)])


def test_thickness_is_refused_beyond_commanded_stop() -> None:
    cloth = gripper_at(FAR_AWAY)
    moved(cloth, Grasp("gripper", True, 0.03))
    with pytest.raises(EventError, match="it would leave the pads of 'gripper'"):
        cloth.advance([SetParameters({"contact.thickness": 1e-4})])


def test_opening_survives_saved_state_and_record() -> None:
    cloth = gripper_at(FAR_AWAY)
    for _ in range(4):
        cloth.advance([Grasp("gripper", True, 0.03, 1.5, 0.04)])
    again = Simulation(cloth.scene, cloth.state)
    for _ in range(30):
        cloth.advance()
        again.advance()
    assert cloth.state.digest() == again.state.digest()
    plain, full = Grasp("gripper", True), Grasp("gripper", True, 0.03, 1.5, 0.04)
    # Sessions of grasps without an opening stay as they were.
    assert to_dict(plain) == {"kind": "grasp", "gripper": "gripper", "closed": True}
    assert from_dict(json.loads(json.dumps(to_dict(full)))) == full
    record = {"frame": 1, "time": 0.0, "integrator": "", "tolerance": None, "steps": 1, "digest": "", "paused": False}
    FrameRecord.from_json(json.dumps({**record, "events": [to_dict(full)]}))
    with pytest.raises(SessionError, match="'force' that is a number"):
        FrameRecord.from_json(json.dumps({**record, "events": [{**to_dict(full), "force": "large"}]}))


def test_limited_drive_keeps_mass_of_cloth() -> None:
    jaw = ParallelJaw(
        gripper="hand", size=(0.1, 0.02, 0.1), friction=(0.5, 0.5), force=2.0, speed=0.05, opening=0.02,
        inertia=drive_inertia(0.01, 2.0, 0.05),
    )  # fmt: skip
    limited = jaw.with_limits(1.0, 0.02)
    assert (limited.force, limited.speed) == (1.0, 0.02)
    assert limited.inertia == pytest.approx(drive_inertia(0.01, 1.0, 0.02), rel=1e-12)
    assert jaw.with_limits(0.0, 0.0) is jaw
