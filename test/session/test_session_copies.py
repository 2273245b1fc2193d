# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Copies of sessions by other tools: without chunks or indexes, with moved or missing records."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
from support.falsifier import Falsification, falsify
from support.mcap_copies import copy_by_tool
from support.session_maker import make_grasp

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.export import export
from cloth_sim_ros.session.info import Summarizer, render
from cloth_sim_ros.session.main import main as session_command
from cloth_sim_ros.session.mcap_builder import MAGIC
from cloth_sim_ros.session.part import SessionPart
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recover import recover
from cloth_sim_ros.session.writer import metadata_checksum
from cloth_sim_ros.verify.main import main as verify_command
from cloth_sim_ros.verify.run import verify

FRAMES = 24
PLAIN = {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
VARIANTS: dict[str, dict[str, Any]] = {
    "no chunks": {"use_chunking": False},
    "no chunks, no indexes": {"use_chunking": False, "index_types": IndexType.NONE},
    "no chunks, no summary": {"use_chunking": False, "use_summary_offsets": False, **PLAIN},
    "no chunk indexes": {"index_types": IndexType.ATTACHMENT | IndexType.METADATA},
    "no indexes": {"index_types": IndexType.NONE},
    "no summary": {"use_summary_offsets": False, **PLAIN},
    "no attachment index": {"index_types": IndexType.CHUNK | IndexType.MESSAGE},
    "no statistics": {"use_statistics": False},
    "no declarations repeated": {"repeat_channels": False, "repeat_schemas": False},
    "no checksums": {"enable_crcs": False},
    "data checksum": {"use_chunking": False, "enable_data_crcs": True},
    "not compressed": {"compression": CompressionType.NONE, "chunk_size": 10_000},
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD, "chunk_size": 10_000},
    "opening at the end": {"contents_last": True},
    "opening at the end, no chunks": {"contents_last": True, "use_chunking": False, "index_types": IndexType.NONE},
    "no profile": {"profile": ""},
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_grasp(tmp_path_factory.mktemp("session"), seconds=FRAMES / 60.0, cloth__resolution=[6, 6])


def contents(path: Path) -> list[tuple[str, str, bytes, int, int, int]]:
    with SessionReader(path, strict=True) as reader:
        messages = [tuple(message) for message in reader.messages()]
        assert reader.parts[0].damage == ()
    return messages


@pytest.mark.parametrize("variant", VARIANTS)
def test_copy_holds_every_message(session: Path, tmp_path: Path, variant: str) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", **VARIANTS[variant])
    assert contents(copy) == contents(session)
    verdict = verify([copy])
    assert (verdict.same, verdict.frames, verdict.clouds) == (True, FRAMES, FRAMES)
    assert not verdict.damaged


@pytest.mark.parametrize("variant", ["no chunks", "no chunk indexes", "no summary", "opening at the end, no chunks"])
def test_copy_is_summarized_replayed_and_exported(session: Path, tmp_path: Path, variant: str) -> None:
    pytest.importorskip("rerun")
    from cloth_sim_ros.replay.main import main as replay_command

    copy = copy_by_tool(session, tmp_path / "copy.mcap", **VARIANTS[variant])
    with SessionReader(copy) as reader:
        summarizer = Summarizer(reader.node)
        for message in reader.messages():
            summarizer.add(message)
        assert f"1 to {FRAMES} ({FRAMES} records)" in render(reader, summarizer.summary)
        assert export(reader, tmp_path / "out.npz") == FRAMES
    assert np.load(tmp_path / "out.npz")["positions"].shape == (FRAMES, 36, 3)
    assert replay_command([str(copy), "--save", str(tmp_path / "out.rrd")]) == 0


@pytest.mark.parametrize("variant", ["no chunks", "no chunk indexes"])
def test_copy_is_an_initial_state(session: Path, tmp_path: Path, variant: str) -> None:
    pytest.importorskip("rclpy")
    from cloth_sim_ros.ros.recording.initial_state import session_state

    copy = copy_by_tool(session, tmp_path / "copy.mcap", **VARIANTS[variant])
    (state,), (again,) = (session_state(f"{path}@12").values() for path in (session, copy))
    assert state == again


def test_messages_outside_of_chunks_are_read(session: Path, tmp_path: Path) -> None:
    # First half in chunks, second half without: the data sections of two files, concatenated.
    chunked = copy_by_tool(session, tmp_path / "chunked.mcap").read_bytes()
    bare = copy_by_tool(session, tmp_path / "bare.mcap", use_chunking=False).read_bytes()
    with SessionReader(tmp_path / "bare.mcap") as reader:
        messages = list(reader.messages())
        reader.parts[0].rewind()
        first = next(iter(reader.parts[0].chunks())).location.offset
    end = bare.index(b"\x0f\x04\0\0\0\0\0\0\0")
    both = tmp_path / "both.mcap"
    data_end = chunked.index(b"\x0f\x04\0\0\0\0\0\0\0")
    both.write_bytes(chunked[:data_end] + bare[first:end] + bare[end:])
    with SessionReader(both) as reader:
        assert len(list(reader.messages())) == 2 * len(messages)


def records(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and bytes of each record of a file."""
    data, position = path.read_bytes(), len(MAGIC)
    while position < len(data) - len(MAGIC):
        opcode, size = struct.unpack_from("<BQ", data, position)
        yield opcode, data[position : position + 9 + size]
        position += 9 + size


def test_chunk_that_the_indexes_hide_is_read(session: Path, tmp_path: Path) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", compression=CompressionType.NONE)
    clouds = copy_by_tool(session, tmp_path / "clouds.mcap", topics=lambda topic: topic.endswith("/points"))
    hidden = next(record for opcode, record in records(clouds) if opcode == Opcode.CHUNK)
    content, summary = bytearray(MAGIC), b""
    for opcode, record in records(copy):
        if opcode == Opcode.DATA_END:
            content += hidden + record
            summary = bytes(content)
        elif opcode == Opcode.CHUNK_INDEX:
            # The bytes of the hidden chunk count as message indexes.
            length = 9 + 36 + int.from_bytes(record[9 + 32 : 9 + 36], "little")
            claimed = int.from_bytes(record[length : length + 8], "little") + len(hidden)
            content += record[:length] + claimed.to_bytes(8, "little") + record[length + 8 :]
        elif opcode not in (Opcode.SUMMARY_OFFSET, Opcode.FOOTER):
            content += record
    content += struct.pack("<BQQQI", Opcode.FOOTER, 20, len(summary), 0, 0) + MAGIC
    copy.write_bytes(content)
    verdict = verify([copy])
    assert verdict.differing["cloud"] >= FRAMES


@pytest.mark.parametrize("key", ["messages", "dropped"])
@pytest.mark.parametrize("value", ["9" * 5000, "many", "-1"])
def test_end_record_of_no_number_is_no_traceback(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, value: str
) -> None:
    copy = falsify(session, tmp_path / "copy.mcap", Falsification(end={key: value}))
    assert verify_command([str(copy)]) == 0
    assert "Not all of it is there" in capsys.readouterr().out
    # The status reports a file that lacks messages.
    assert session_command(["info", str(copy)]) == (key == "dropped")


@pytest.mark.parametrize("value", ["9" * 5000, "first", "-1", ""])
def test_part_of_no_number_is_refused(session: Path, tmp_path: Path, value: str) -> None:
    copy = tmp_path / "copy.mcap"
    with contextlib.closing(SessionPart(session)) as part, copy.open("wb") as stream:
        metadata = {**part.metadata, "part": value}
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.add_metadata("cloth_sim", {**metadata, "checksum": metadata_checksum(metadata)})
        for name, attachment in part.attachments.items():
            writer.add_attachment(0, 0, name, attachment.media_type, attachment.data)
        writer.finish()
    with pytest.raises(SessionError, match="does not tell which file"):
        SessionReader(copy)


def test_flipped_bit_of_unchunked_message_is_found(session: Path, tmp_path: Path) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", **VARIANTS["data checksum"])
    with SessionReader(copy) as reader:
        cloud = next(reader.messages([f"{reader.node}/points"])).data
    data = bytearray(copy.read_bytes())
    data[data.index(cloud) + len(cloud) // 2] ^= 1
    copy.write_bytes(data)
    verdict = verify([copy])
    assert verdict.damaged
    assert "checksum" in "; ".join(verdict.missing)


def test_copy_without_chunks_that_was_cut_off_is_recovered(session: Path, tmp_path: Path) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", use_chunking=False)
    data = copy.read_bytes()
    whole = contents(session)
    # A frame has several messages; a cut may be before, between and behind them.
    for end in range(len(data) * 2 // 3, len(data) * 2 // 3 + 1200, 150):
        copy.write_bytes(data[:end])
        recovery = recover(copy)
        recovered = contents(recovery.path)
        assert recovered == whole[: len(recovered)]
        assert recovery.messages == len(recovered) > len(whole) // 2
        for path in (copy, recovery.path):
            verdict = verify([path])
            assert verdict.same, verdict.first_reason
            assert verdict.missing
        recovery.path.unlink()


LEFT_OUT = {
    "opening": ({"metadata": lambda name: name != "cloth_sim"}, "the metadata record 'cloth_sim'"),
    "metadata": ({"metadata": lambda _name: False}, "the metadata record 'cloth_sim'"),
    "attachments": ({"attachments": lambda _name: False}, "the attachments scene.yaml and state.npz"),
    "state": ({"attachments": lambda name: name != "state.npz"}, "the attachment state.npz"),
    "both": (
        {"metadata": lambda _name: False, "attachments": lambda _name: False},
        "the metadata record 'cloth_sim' and the attachments scene.yaml and state.npz",
    ),
}


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"use_summary_offsets": False, **PLAIN}])
@pytest.mark.parametrize("left_out", LEFT_OUT)
def test_copy_without_opening_is_reported_by_every_command(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], left_out: str, options: dict[str, Any]
) -> None:
    from cloth_sim_ros.fit.main import main as fit_command

    changes, named = LEFT_OUT[left_out]
    copy = copy_by_tool(session, tmp_path / "copy.mcap", **changes, **options)
    commands: list[Any] = [
        lambda: session_command(["info", str(copy)]),
        lambda: session_command(["recover", str(copy)]),
        lambda: session_command(["export", str(copy)]),
        lambda: verify_command([str(copy)]),
        lambda: fit_command([str(copy), "--parameters", "stretch"]),
    ]
    for command in commands:
        assert command()
        said = capsys.readouterr().err
        assert "lacks its opening" in said
        assert named in said
        assert "mcap filter --include-metadata --include-attachments" in said


def test_copy_without_opening_is_reported_by_replay_and_state(session: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    pytest.importorskip("rclpy")
    from cloth_sim_ros.replay.show import save_recording
    from cloth_sim_ros.ros.recording.initial_state import session_state
    from cloth_sim_ros.scene.parameters.declare import ParameterError

    copy = copy_by_tool(session, tmp_path / "copy.mcap", attachments=lambda _name: False)
    with pytest.raises(SessionError, match="lacks its opening"):
        save_recording([copy], tmp_path / "out.rrd")
    with pytest.raises(ParameterError, match="lacks its opening"):
        session_state(f"{copy}@3")


def test_merged_recordings_are_refused_with_the_cause(session: Path, tmp_path: Path) -> None:
    second = make_grasp(tmp_path, seconds=0.1, stem="other", cloth__resolution=[4, 4])
    merged = copy_by_tool(session, tmp_path / "merged.mcap", more=(second,))
    with pytest.raises(SessionError, match="the openings of two recordings"):
        SessionReader(merged)


def test_copy_without_end_record_is_reported(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", metadata=lambda name: name == "cloth_sim")
    assert session_command(["info", str(copy)]) == 0
    assert "unknown: the record 'cloth_sim_end' is missing" in capsys.readouterr().out


def test_verify_fails_without_frames(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", topics=lambda topic: not topic.endswith("/frame"))
    assert verify_command([str(copy)]) == 2
    assert "holds no frames" in capsys.readouterr().out
