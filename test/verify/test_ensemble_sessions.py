# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clouds of an ensemble in sessions: compared with members that run again, or listed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap")

from support.ensemble_session import record_ensemble
from support.falsifier import Falsification, drop, falsify, renumbered

from cloth_sim_ros.session.cdr import decode_cloud, decode_string, encode_string
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.simulation.events import Event, Reset, SetParameters
from cloth_sim_ros.verify.main import describe
from cloth_sim_ros.verify.run import verify

ENSEMBLE, FRAME = "/cloth_sim/ensemble", "/cloth_sim/frame"
FRAMES = 16
EVENTS: dict[int, list[Event]] = {
    4: [SetParameters({"air.drag": 0.6})],
    9: [Reset()],
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_ensemble(tmp_path_factory.mktemp("session"), FRAMES, events=EVENTS)


def test_ensemble_clouds_come_out_the_same(session: Path) -> None:
    verdict = verify([session])
    assert verdict.same, verdict.first_reason
    assert verdict.compared["ensemble cloud"] == FRAMES
    assert {topic for topic, _ in verdict.not_compared} == {"events"}
    with SessionReader(session) as reader:
        clouds = [decode_cloud(message.data) for message in reader.messages([ENSEMBLE])]
    assert [cloud.deviation is not None and cloud.xyz.shape == (30, 3) for cloud in clouds] == [True] * FRAMES
    assert clouds[6].deviation is not None and clouds[6].deviation.max() > 1e-4


def _shift_deviation(data: bytes) -> bytes:
    cloud = decode_cloud(data)
    assert cloud.deviation is not None
    changed = bytearray(data)
    # The last point ends before is_dense and its padding.
    end = len(data) - 4
    changed[end - 4 : end] = np.float32(cloud.deviation[-1] + 1e-6).tobytes()
    return bytes(changed)


def _move(message: Message) -> Message:
    return message._replace(publish_time=message.publish_time + 5, log_time=message.log_time + 5)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda message: message._replace(data=_shift_deviation(message.data)), "m of the deviation"),
        (lambda message: message._replace(data=message.data[:60]), "cannot be read"),
        (_move, "belongs to no frame"),
    ],
)
def test_altered_ensemble_cloud_is_found(
    session: Path, tmp_path: Path, change: Callable[[Message], Message], reason: str
) -> None:
    def alter(messages: list[Message]) -> list[Message]:
        positions = [k for k, message in enumerate(messages) if message.topic == ENSEMBLE]
        messages[positions[5]] = change(messages[positions[5]])
        return messages

    verdict = verify([falsify(session, tmp_path / "false.mcap", Falsification(alter))])
    assert not verdict.same
    assert reason in verdict.first_reason
    assert verdict.differing["ensemble cloud"] >= 1


def test_left_out_frames_are_listed(session: Path, tmp_path: Path) -> None:
    verdict = verify(
        [falsify(session, tmp_path / "less.mcap", Falsification(renumbered(drop(ENSEMBLE, only=[3, 15]))))]
    )
    assert verdict.same, verdict.first_reason
    assert verdict.compared["ensemble cloud"] == FRAMES - 2
    reason = "frames without a message, as a slow ensemble leaves them out"
    assert verdict.not_compared[ENSEMBLE, reason] == 2
    assert "2 x frames without a message" in describe(verdict)


def test_dropped_ensemble_clouds_are_counted(session: Path, tmp_path: Path) -> None:
    falsification = Falsification(drop(ENSEMBLE, only=[3, 4]), end={"dropped": "2"})
    verdict = verify([falsify(session, tmp_path / "dropped.mcap", falsification)])
    assert verdict.same, verdict.first_reason
    verdict = verify([falsify(session, tmp_path / "lost.mcap", Falsification(drop(ENSEMBLE, only=[3, 4])))])
    assert "2 messages of /cloth_sim/ensemble" in verdict.first_reason


def test_ensemble_without_a_start_is_listed(session: Path, tmp_path: Path) -> None:
    def forget(messages: list[Message]) -> list[Message]:
        return [
            message._replace(data=_without_extras(message.data)) if message.topic == FRAME else message
            for message in messages
        ]

    verdict = verify([falsify(session, tmp_path / "late.mcap", Falsification(forget))])
    assert verdict.same, verdict.first_reason
    assert verdict.not_compared[ENSEMBLE, "its start is not in the recording, or too long ago"] == FRAMES
    assert verdict.compared["ensemble cloud"] == 0


def _without_extras(data: bytes) -> bytes:
    record = json.loads(decode_string(data))
    record.pop("extras", None)
    return encode_string(json.dumps(record, separators=(",", ":")))
