# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_verify` with sessions that an outsider changed, gaps between files, and closed pipes."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.records import Attachment, Metadata
from support.falsifier import FRAME, Falsification, alter_messages, falsify
from support.session_maker import NODE, SessionMaker, make_grasp

from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import mcap_builder
from cloth_sim_ros.session.cdr import encode, message_class
from cloth_sim_ros.verify.main import main
from cloth_sim_ros.verify.run import verify


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_grasp(tmp_path_factory.mktemp("session"), seconds=0.2, cloth__resolution=[4, 5])


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    maker = SessionMaker(tmp_path_factory.mktemp("split"), Scene.from_parameters({"cloth.resolution": [4, 4]}))
    for k in range(6):
        maker.add()
        if k in (1, 3):
            maker.split()
    maker.finish()
    return maker.paths


def test_commands_of_another_type_are_a_difference(session: Path, tmp_path: Path) -> None:
    kind = "std_msgs/msg/Header"
    stamp = message_class("builtin_interfaces/msg/Time")(sec=0, nanosec=0)
    data = encode(message_class(kind)(stamp=stamp, frame_id=""), kind)
    for leaf in ("grasp", "target"):
        change = alter_messages(f"{NODE}/gripper/{leaf}", lambda message: message._replace(data=data, type_name=kind))
        verdict = verify([falsify(session, tmp_path / f"{leaf}.mcap", Falsification(change))])
        assert not verdict.same
        assert verdict.differing["declaration"] == 1


def test_bytes_behind_a_frame_record_are_refused(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change = alter_messages(FRAME, lambda message: message._replace(data=message.data + b"hidden"), only=[3])
    assert main([str(falsify(session, tmp_path / "s.mcap", Falsification(change)))]) == 2
    assert "6 bytes follow its end" in capsys.readouterr().err


def test_foreign_records_are_listed(session: Path, tmp_path: Path) -> None:
    raw = session.read_bytes()
    notes = Attachment(create_time=1, log_time=1, name="notes.txt", media_type="", data=b"x")
    records = [notes, Metadata(name="tool", metadata={"a": "b"})]
    opening = raw.index(b"MCAP0\r\n") + 7
    header_end = opening + 9 + int.from_bytes(raw[opening + 1 : opening + 9], "little")
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(raw[:header_end] + b"".join(map(mcap_builder.encode_record, records)) + raw[header_end:])
    verdict = verify([copy])
    assert verdict.same
    assert verdict.not_compared["attachment notes.txt", "not of the scene"] == 1
    assert verdict.not_compared["metadata tool", "not of cloth_sim"] == 1


@pytest.mark.parametrize(("indices", "status"), [((0, 1, 2), 0), ((0, 2), 2), ((1, 2), 0), ((2,), 0)])
def test_gap_between_files_is_an_error(
    split: list[Path], indices: tuple[int, ...], status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(split[index]) for index in indices]) == status
    assert ("part 1 of the session" in capsys.readouterr().err) == (status == 2)


@pytest.mark.parametrize(("indices", "is_listed"), [((0, 1), True), ((0, 1, 2), False)])
def test_file_after_the_last_one_is_named(split: list[Path], indices: tuple[int, ...], is_listed: bool) -> None:
    verdict = verify([split[index] for index in indices])
    assert verdict.same
    assert any("goes on in another file" in sentence for sentence in verdict.missing) == is_listed
