# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files that an outsider changed: contents that the readers must report, and deficits that must not get lost."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Attachment, Channel
from support import session_samples as samples

from cloth_sim_ros.session import cdr, mcap_builder
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.main import main
from cloth_sim_ros.session.part import SessionPart
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recover import recover
from cloth_sim_ros.session.writer import SessionWriter, WriterOptions
from cloth_sim_ros.verify.main import main as verify_main

SMALL = WriterOptions(chunk_bytes=4096, sync_seconds=0)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return samples.write_session(tmp_path, list(samples.samples(40)), options=SMALL)


def _damage_last_chunk(session: Path) -> Path:
    with contextlib.closing(SessionPart(session)) as part:
        assert part.summary is not None
        offset = max(part.summary.chunks)
    raw = bytearray(session.read_bytes())
    raw[offset + 80] ^= 0xFF
    session.write_bytes(raw)
    return session


def _with_attachments(session: Path, *attachments: Attachment) -> None:
    """Insert attachments behind the opening and leave out the indexes."""
    raw = session.read_bytes()
    with contextlib.closing(SessionPart(session)) as part:
        assert part.summary is not None
        offset = min(part.summary.chunks)
        end = part.summary.start
    added = b"".join(map(mcap_builder.encode_record, attachments))
    session.write_bytes(raw[:offset] + added + raw[offset:end])


def _attachment(name: str, data: bytes) -> Attachment:
    return Attachment(create_time=1, log_time=1, name=name, media_type="", data=data)


@pytest.mark.parametrize("ending", ["npz", "parquet"])
def test_export_reports_damage_of_the_last_chunk(
    session: Path, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    out = session.with_suffix(f".{ending}")
    assert main(["export", str(_damage_last_chunk(session)), "-o", str(out)]) == 0
    assert "fails its checksum" in capsys.readouterr().err


def test_torn_bytes_are_counted_after_a_partial_pass(session: Path) -> None:
    with contextlib.closing(SessionPart(session)) as part:
        assert part.summary is not None
        last = max(part.summary.chunks)
    session.write_bytes(session.read_bytes()[: last + 100])
    with SessionReader(session) as reader:
        list(reader.messages())
        reader.topology()
        next(iter(reader.messages()))
        assert "(100 bytes of a torn chunk" in str(reader.missing)


def test_attachments_count_once_in_several_passes(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloth_sim_ros.session.part.MAX_CHUNK_BYTES", 1 << 20)
    _with_attachments(session, _attachment("file:mesh.obj", bytes(700_000)))
    with SessionReader(session) as reader:
        counts = {sum(1 for _ in reader.messages()) for _ in range(3)}
        assert len(counts) == 1
        assert "limit" not in str(reader.missing)


def test_two_different_scenes_in_one_file_are_refused(session: Path) -> None:
    _with_attachments(session, _attachment("scene.yaml", b"/cloth_sim: {ros__parameters: {}}"))
    with pytest.raises(SessionError, match=r"two different attachments 'scene.yaml'"), SessionReader(session) as reader:
        list(reader.messages())


def test_contradicting_declarations_are_damage(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closing = mcap_builder.McapBuilder.encode_closing

    def renamed(builder: mcap_builder.McapBuilder, offset: int) -> bytes:
        # private: no public call writes a summary that contradicts the data
        channels: dict[int, Channel] = builder._channels
        builder._channels = {
            key: dataclasses.replace(channel, topic=channel.topic.replace("points", "other"))
            for key, channel in channels.items()
        }
        return closing(builder, offset)

    monkeypatch.setattr(mcap_builder.McapBuilder, "encode_closing", renamed)
    path = samples.write_session(session.parent, list(samples.samples(4)), stem="renamed")
    assert main(["info", str(path)]) == 1
    with SessionReader(path) as reader:
        assert any(message.topic == samples.POINTS for message in reader.messages())
        assert "declared twice, with different contents" in str(reader.missing)


@pytest.mark.parametrize("field", ["log_time", "publish_time"])
def test_times_beyond_those_of_ros_are_damage(tmp_path: Path, field: str) -> None:
    writer = SessionWriter(tmp_path, snapshot=samples.SNAPSHOT, stem="late", log_time=samples.START, options=SMALL)
    for sample in samples.samples(4):
        if not writer.is_declared(sample.topic):
            writer.declare(sample.topic, sample.type_name)
        times = {"log_time": sample.log_time, "publish_time": sample.log_time}
        if sample.topic == samples.POINTS:
            times[field] = 10**9 << 31
        writer.add(sample.topic, sample.data, sequence=0, **times)
    writer.finish(reason="stopped")
    with SessionReader(writer.path) as reader:
        assert not any(message.topic == samples.POINTS for message in reader.messages())
        assert f"a time of {samples.POINTS} beyond those of ROS" in str(reader.missing)


@pytest.mark.parametrize("change", [lambda data: data + b"hidden", lambda data: data[:-1] + b"}"])
def test_bytes_behind_a_text_are_refused(change: Callable[[bytes], bytes]) -> None:
    data = cdr.encode_string("text")
    assert cdr.decode_string(data + bytes(3)) == "text"
    with pytest.raises(SessionError, match=r"std_msgs/msg/String"):
        cdr.decode_string(change(data))


def test_cloud_without_points_has_no_positions() -> None:
    kind = "sensor_msgs/msg/PointCloud2"
    content = cdr.decode(samples.cloud(np.zeros((4, 3), np.float32), 5), kind)
    content.height = content.width = content.row_step = 0
    content.point_step, content.data = 20_000, np.zeros(0, np.uint8)
    for k, cloud_field in enumerate(content.fields):
        cloud_field.offset = 10_000 + 4 * k
    assert cdr.decode_cloud(cdr.encode(content, kind)).xyz.shape == (0, 3)


def test_recovered_file_reports_what_it_lacks(session: Path) -> None:
    recovery = recover(_damage_last_chunk(session))
    assert main(["info", str(recovery.path)]) == 1
    with SessionReader(recovery.path) as reader:
        assert "recovered, the chunk at byte" in str(reader.missing)


def test_recovered_file_with_all_messages_is_whole(session: Path) -> None:
    session.write_bytes(session.read_bytes()[:-20])
    assert main(["info", str(recover(session).path)]) == 0


def test_chunk_without_messages_leaves_times_alone(session: Path) -> None:
    with contextlib.closing(SessionPart(session)) as part:
        assert part.summary is not None
        offset, statistics = min(part.summary.chunks), part.summary.statistics
    empty = mcap_builder.pack_chunk_record(payload=b"", compression="", raw_size=0, crc=0, times=(0, 0), indexes={})
    raw = session.read_bytes()
    session.write_bytes(raw[:offset] + b"".join(empty.parts) + raw[offset:-20])
    with contextlib.closing(SessionPart(recover(session).path)) as part:
        assert part.summary is not None
        assert part.summary.statistics is not None
        assert statistics is not None
        assert part.summary.statistics.message_start_time == statistics.message_start_time


@pytest.mark.parametrize(("removed", "status"), [(0, 1), (1, 1), (2, 1), (None, 0)])
def test_all_parts_miss_a_removed_file(
    tmp_path: Path, removed: int | None, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = _split_session(tmp_path)
    if removed is not None:
        paths[removed].unlink()
        paths.pop(removed)
    assert main(["info", "--all-parts", str(paths[0])]) == status
    error = capsys.readouterr().err
    assert (f"part {removed} of the session" in error) == (removed is not None)


def _split_session(folder: Path) -> list[Path]:
    paths = []
    for part, reason in enumerate(("split", "split", "stopped")):
        writer = SessionWriter(
            folder, snapshot=samples.SNAPSHOT, stem="s", part=part, log_time=samples.START, options=SMALL
        )
        for sample in samples.samples(4):
            if not writer.is_declared(sample.topic):
                writer.declare(sample.topic, sample.type_name)
            writer.add(sample.topic, sample.data, log_time=sample.log_time, publish_time=sample.log_time, sequence=0)
        writer.finish(reason=reason)
        paths.append(writer.path)
    return paths


def test_names_in_a_file_do_not_control_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = "/cloth\x1b[2J\x1b]0;title\x07\nstate       complete\u202e"
    content = [item._replace(topic=name) if item.topic.endswith("/wrench") else item for item in samples.samples(40)]
    path = samples.write_session(tmp_path, content, options=SMALL)
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) * 2 // 3])
    assert main(["info", str(path)]) == 1
    verify_main([str(path)])
    output = "".join(capsys.readouterr())
    assert "\\x1b[2J\\x1b]0;title\\x07\\nstate" in output
    assert all(character.isprintable() or character == "\n" for character in output.replace("\r", ""))
