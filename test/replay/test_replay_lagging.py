# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded poses of grippers that did not reach their targets, replayed and verified."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from support.falsifier import FRAME, Falsification, alter_messages, falsify
from support.session_maker import SessionMaker

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.replay.grippers import GripperTracks
from cloth_sim_ros.replay.opening import read_opening
from cloth_sim_ros.session.cdr import decode_string, encode_string
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.events import Event, Pause, Reset, SetParameters, Step
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.studies.run_recording import RunRecording
from cloth_sim_ros.verify.main import describe
from cloth_sim_ros.verify.run import verify

NO_TURN, QUARTER_TURN = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.6, 0.8)
ATTACH: dict[str, Any] = {"cloth.resolution": [5, 5], "gripper.radius": 0.3}
#: Pads above a table; the whole cloth lies below them.
PINCH: dict[str, Any] = {
    "cloth.resolution": [4, 4],
    "cloth.size": [0.09, 0.09],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.005],
    "cloth.anchors": [""],
    "contact.thickness": 0.005,
    "tolerance": 1e-2,
    "grippers": ["hand"],
    "gripper.mode": "pinch",
    "gripper.opening": 0.012,
    "gripper.pad_size": [0.2, 0.1, 0.08],
    "obstacles": ["table"],
    "table.shape": "plane",
    # A crushed frame takes all of it.
    "work_limit": 1.0,
}


def attach_events(scene: Scene) -> list[list[Event]]:
    """Grasp of a corner, jump of 1 m with a turn, pause and step in between, arrival, release, grasp, reset."""
    x, y, z = scene.initial_positions()[-1].tolist()
    target_position = Target("gripper", (x, y + 1.0, z), QUARTER_TURN)
    events: list[list[Event]] = [
        [Target("gripper", (x, y, z), NO_TURN)],
        [Grasp("gripper", True)],
        [target_position],
        [],
    ]
    events += [[Pause(True)], [], [Step()], [Pause(False)], *[[] for _ in range(8)]]
    events += [[Target("gripper", (x, y, z), NO_TURN)], [Grasp("gripper", False)], [Grasp("gripper", True)]]
    events += [[Target("gripper", (x, y + 2.0, z))], [Reset()], [], [target_position], [Grasp("gripper", True)]]
    return [*events, [SetParameters({"gripper.max_speed": 1.0}), Target("gripper", (x, y, z))], [], []]


def pinch_events(_scene: Scene) -> list[list[Event]]:
    """Pads that move down into the table until they are stopped, rise by 0.5 m and are reset."""
    down: list[list[Event]] = [[Target("hand", (0.0, 0.0, 0.1 - 0.03 * k))] for k in range(4)]
    return [*down, [], [], [Target("hand", (0.0, 0.0, 0.6))], *[[] for _ in range(4)], [Reset()], []]


CASES = {"attach": (ATTACH, attach_events), "pinch": (PINCH, pinch_events)}


@dataclasses.dataclass
class Recorded:
    """A session with the simulation's results of each frame."""

    path: Path
    scene: Scene
    events: Sequence[Sequence[Event]]
    frames: list[Frame] = dataclasses.field(default_factory=list)
    poses: list[np.ndarray] = dataclasses.field(default_factory=list)
    held: list[list[int]] = dataclasses.field(default_factory=list)


def record(folder: Path, scene: Scene, events: Sequence[Sequence[Event]]) -> Recorded:
    recorded = Recorded(folder, scene, events)

    def watch(simulation: Simulation, frame: Frame) -> None:
        recorded.frames.append(frame)
        recorded.poses.append(simulation.grippers.poses()[0])
        recorded.held.append(simulation.grippers.grasped_particles(0).tolist())

    maker = SessionMaker(folder, scene, watch=watch)
    for each_frame in events:
        maker.add(each_frame)
    recorded.path = maker.finish()
    return recorded


@pytest.fixture(scope="module", params=CASES)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    values, events = CASES[request.param]
    scene = Scene.from_parameters(values)
    return record(tmp_path_factory.mktemp(request.param), scene, events(scene))


def records_of(path: Path) -> list[FrameRecord]:
    with SessionReader(path) as reader:
        return [FrameRecord.from_json(decode_string(message.data)) for message in reader.messages([FRAME])]


def replayed(path: Path, scene: Scene) -> list[tuple[np.ndarray | None, list[int]]]:
    """Return pose and held particles of the first gripper in a replay after each frame."""
    frames = []
    with SessionReader(path) as reader:
        opening = read_opening(reader.scene_yaml, reader.state)
        tracks = GripperTracks(opening, opening.anchored_particles(*scene.shape))
        before = opening.positions
        for recorded in reader.clouds():
            assert recorded.frame is not None
            tracks.advance(recorded.frame, lambda before=before: before)
            track = tracks.tracks[scene.gripper_names[0]]
            assert track.grasped is not None
            frames.append((None if track.pose is None else track.pose.copy(), track.grasped.tolist()))
            before = recorded.cloud.xyz
    return frames


def altered(path: Path, target: Path, alter: Callable[[dict[str, Any]], object]) -> Path:
    """Write a copy of a session with altered extras in each frame record."""

    def change(message: Message) -> Message:
        content = json.loads(decode_string(message.data))
        if "extras" in content:
            alter(content["extras"])
        return message._replace(data=encode_string(json.dumps(content, separators=(",", ":"))))

    return falsify(path, target, Falsification(alter_messages(FRAME, change)))


def test_replayed_poses_equal_simulation(recorded: Recorded) -> None:
    scene = recorded.scene
    for k, (pose, held) in enumerate(replayed(recorded.path, scene)):
        if pose is not None:
            np.testing.assert_allclose(pose, recorded.poses[k], rtol=0.0, atol=1e-15, err_msg=f"frame {k}")
        assert held == recorded.held[k]
    if "hand" in scene.gripper_names:
        assert any(frame.stopped == ("hand",) for frame in recorded.frames)
    assert any(frame.lagging and not frame.stopped for frame in recorded.frames)


def test_step_of_sleeping_cloth_moves_replayed_gripper(tmp_path: Path) -> None:
    scene = Scene.from_parameters({"cloth.resolution": [5, 5], "gravity": [0.0, 0.0, 0.0], "cloth.anchors": [""]})
    asleep: list[list[Event]] = [[] for _ in range(120)]
    events = [[Target("gripper", (0.0, 0.0, 5.0))], *asleep, [Pause(True)], [Target("gripper", (0.0, 1.0, 5.0))]]
    recorded = record(tmp_path, scene, [*events, [Step()]])
    assert not records_of(recorded.path)[-1].steps
    pose, _ = replayed(recorded.path, scene)[-1]
    assert pose is not None
    assert pose.tolist() == recorded.poses[-1].tolist()
    assert pose[1] == 1.0


def test_poses_are_recorded_only_for_missed_targets(recorded: Recorded) -> None:
    scene = recorded.scene
    name, target = scene.gripper_names[0], None
    for frame, pose, record in zip(recorded.frames, recorded.poses, records_of(recorded.path), strict=True):
        for event in frame.events:
            if isinstance(event, Target):
                turn = event.orientation or (NO_TURN if target is None else tuple(target[3:]))
                target = np.array([*event.position, *turn])
            elif isinstance(event, Reset):
                target = None
        missed = frame.moved and target is not None and not np.allclose(pose, target, rtol=0.0, atol=1e-12)
        assert record.extras.get("poses") == ({name: pose.tolist()} if missed else None)
        if frame.stopped:
            assert record.extras["halted"] == [name]
            target = pose


def test_studies_record_the_same_extras(tmp_path: Path, recorded: Recorded) -> None:
    scene, events = recorded.scene, recorded.events
    records = records_of(recorded.path)
    simulation = Simulation(scene)
    run = RunRecording(tmp_path, simulation, name="run", clouds=False)
    for each_frame in events:
        run.add(each_frame, simulation.advance(each_frame))
    study_extras = [
        {k: v for k, v in record.extras.items() if k != "flagged"} for record in records_of(run.finish(reason="x"))
    ]
    assert study_extras == [dict(record.extras) for record in records]
    assert any(study_extras)


def test_verify_compares_poses_exactly(tmp_path: Path, recorded: Recorded) -> None:
    path, name = recorded.path, recorded.scene.gripper_names[0]
    verdict = verify([path])
    assert verdict.same, verdict.first_reason
    assert {topic for topic, _ in verdict.not_compared} == {"events"}

    def move(extras: dict[str, Any]) -> None:
        if "poses" in extras:
            extras["poses"][name][1] = float(np.nextafter(extras["poses"][name][1], 9.0))

    verdict = verify([altered(path, tmp_path / "moved.mcap", move)])
    assert not verdict.same
    assert "its poses" in verdict.first_reason


def test_verify_finds_body_that_was_not_halted(tmp_path: Path) -> None:
    scene = Scene.from_parameters(ATTACH)
    path = record(tmp_path, scene, attach_events(scene)).path
    verdict = verify([altered(path, tmp_path / "more.mcap", lambda extras: extras.update(halted=["gripper"]))])
    assert "its halted" in verdict.first_reason


def test_older_session_is_verified_and_replayed(tmp_path: Path, recorded: Recorded) -> None:
    scene, events = recorded.scene, recorded.events
    path = recorded.path
    older = altered(path, tmp_path / "older.mcap", lambda extras: extras.clear())
    verdict = verify([older])
    assert verdict.same, verdict.first_reason
    assert "'poses', absent from the record" in describe(verdict)
    # Without a recorded pose, each gripper is at its target.
    target = next(event for frame in reversed(events) for event in frame if isinstance(event, Target))
    poses = [pose for pose, _ in replayed(older, scene) if pose is not None]
    assert any(pose[:3].tolist() == list(target.position) for pose in poses)


@pytest.mark.parametrize(
    "extras",
    [
        {"poses": 3},
        {"poses": [1.0]},
        {"poses": {"gripper": None}},
        {"poses": {"gripper": [0.0] * 6}},
        {"poses": {"gripper": [0.0] * 6 + ["1"]}},
        {"poses": {"gripper": [10**400] + [0.0] * 6}},
        {"halted": "gripper"},
        {"halted": [1]},
    ],
)
def test_malformed_poses_are_refused(tmp_path: Path, extras: dict[str, Any]) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(ATTACH))
    maker.add(extras=extras)
    with pytest.raises(SessionError, match="a frame record's extras"):
        records_of(maker.finish())
