# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions with obstacles: rerun to the same bits, comparison, certificate."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from support.session_maker import SessionMaker

from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.info import Summarizer
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.events import Event, Move, SetParameters
from cloth_sim_ros.verify.accuracy import certify
from cloth_sim_ros.verify.run import verify

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
#: Small cloth that falls on a ball from just above it.
FALLING: dict[str, Any] = {
    "cloth.resolution": [7, 7],
    "cloth.size": [0.3, 0.3],
    "cloth.orientation": list(UPRIGHT),
    "cloth.position": [0.01, 0.0, 0.11],
    "cloth.anchors": [""],
    "tolerance": 1e-3,
    "grippers": [""],
    "obstacles": ["ball"],
    "ball.shape": "sphere",
    "ball.size": [0.1],
    "floor.shape": "plane",
    "floor.position": [0.0, 0.0, -0.15],
}


#: The same with friction.
ROUGH: dict[str, Any] = {**FALLING, "ball.friction": [0.5, 0.4], "floor.friction": [0.3]}


def make_session(folder: Path, *, scene: dict[str, Any] = FALLING, frames: int = 40, **options: Any) -> Path:
    """Write a session with a moving ball and an added floor."""
    maker = SessionMaker(folder, Scene.from_parameters(scene))
    for k in range(frames):
        events: list[Event] = [Move("ball", (0.002 * k, 0.0, 0.0), UPRIGHT)] if 10 < k < 25 else []
        if k == 20:
            events.append(SetParameters({"obstacles": ["floor", "ball"]}))
            maker.split()
        maker.add(events, **options)
    maker.finish()
    return folder


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def test_obstacle_session_reruns_to_same_bits_and_wrenches(tmp_path: Path) -> None:
    paths = parts(make_session(tmp_path))
    verdict = verify(paths)
    assert verdict.same, verdict.first_reason
    assert (verdict.frames, len(paths)) == (40, 2)


@pytest.mark.parametrize(
    ("topic", "words"),
    [("/cloth_sim/ball/wrench", "the wrench on ball"), ("/cloth_sim/ball/target", "ball moved to .* not commanded")],
)
def test_altered_recording_is_found(tmp_path: Path, topic: str, words: str) -> None:
    def spoil(name: str, data: bytes) -> bytes | None:
        if name != topic:
            return data
        return None if topic.endswith("target") else data[:-8] + b"\x00" * 7 + b"\x40"

    verdict = verify(parts(make_session(tmp_path, change=spoil)))
    assert not verdict.same
    assert re.search(words, verdict.first_reason)


def test_events_are_described(tmp_path: Path) -> None:
    with SessionReader(parts(make_session(tmp_path))) as reader:
        summarizer = Summarizer(reader.node)
        for message in reader.messages():
            summarizer.add(message)
    summary = summarizer.summary
    assert summary.events["move"] == 14
    assert any("set_parameters" in line for line in summary.notable_events)


def test_the_certificate_covers_contact(tmp_path: Path) -> None:
    # Impact and moving ball; the independent integrator runs every frame.
    verdict, certificate = certify(parts(make_session(tmp_path, frames=13)), every_sample=True)
    assert verdict.same
    assert certificate.is_satisfied
    assert len(certificate.samples) == 13
    assert max(sample.difference for sample in certificate.samples) < 1e-6
    errors = [frame.error for frame in certificate.frames]
    assert 1e-9 < max(errors) < 1e-4
    # Uncertainty of these errors [m].
    assert max(frame.uncertainty for frame in certificate.frames) < 1e-6


def test_friction_session_reruns_to_same_bits_from_later_part(tmp_path: Path) -> None:
    paths = parts(make_session(tmp_path, scene=ROUGH))
    with SessionReader(paths) as reader:
        first, later = (State.from_bytes(part.state) for part in reader.parts)
    assert ANCHORS_KEY not in first.memory
    assert (later.memory[ANCHORS_KEY][0, 3] > 0.0).any()
    for these, frames in ((paths, 40), (paths[1:], 20)):
        verdict = verify(these)
        assert verdict.same, verdict.first_reason
        assert verdict.frames == frames


def test_lost_friction_anchors_of_snapshot_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = parts(make_session(tmp_path, scene=ROUGH))
    read = State.from_bytes

    def forgetful(data: bytes) -> State:
        state = read(data)
        state.memory.pop(ANCHORS_KEY, None)
        return state

    monkeypatch.setattr(State, "from_bytes", forgetful)
    assert not verify(paths[1:]).same


def test_the_certificate_covers_friction(tmp_path: Path) -> None:
    # The ball rises, and a floor is inserted before it in the list of obstacles: every motion keeps its anchors.
    verdict, certificate = certify(parts(make_session(tmp_path, scene=ROUGH, frames=23)))
    assert verdict.same
    assert certificate.is_satisfied
    assert len(certificate.frames) == 23
    # Sliding amplifies perturbations by orders of magnitude; the errors of single frames do not depend on it.
    alone = [frame.error_of_frame for frame in certificate.frames]
    assert 1e-6 < max(alone) < 1e-3
    assert max(alone[20:]) < 1e-5
