# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Session files are valid for ROS 2 tools: independent readers agree on every message."""

from __future__ import annotations

import fcntl
import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from mcap.reader import NonSeekingReader, SeekingReader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader as BagReader
from support import session_samples as samples

from cloth_sim_ros.session.errors import RecordingError, SessionError
from cloth_sim_ros.session.export import export
from cloth_sim_ros.session.mcap_builder import Compression
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.writer import SessionWriter, WriterOptions

CONTENT = list(samples.samples(90))
COMPRESSIONS = get_args(Compression)


@pytest.fixture(params=COMPRESSIONS)
def session(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    options = WriterOptions(chunk_bytes=8192, compression=request.param, sync_seconds=0)
    return samples.write_session(tmp_path, CONTENT, options=options)


def test_reader_returns_everything(session: Path) -> None:
    with SessionReader(session, strict=True) as reader:
        assert samples.plain(list(reader.messages())) == samples.plain(CONTENT)
        assert reader.complete
        assert reader.missing is None
        assert reader.state == samples.SNAPSHOT.state
        assert reader.scene_yaml == samples.SNAPSHOT.scene_yaml
        assert reader.files == samples.SNAPSHOT.files
        assert reader.metadata["period"] == "0.016666666666666666"
        assert reader.node == samples.NODE
        assert [frame.frame for frame in reader.frames()] == list(range(90))
        surface = reader.topology()
        assert surface is not None
        assert surface.triangles.shape == (38, 3)
        for index, recorded in enumerate(reader.clouds()):
            assert recorded.frame == next(iter_frames(index))
            assert recorded.cloud.xyz.tolist() == samples.positions(index, 40).tolist()


def iter_frames(index: int):  # type: ignore[no-untyped-def]
    events = ()
    if index % 3 == 0:
        events = ({"kind": "target", "gripper": "gripper", "position": [0.5, 0.0, index / 60]},)
    if index % 20 == 10:
        events += ({"kind": "grasp", "gripper": "gripper", "closed": True},)
    yield samples.frame_record(index, events)


def test_mcap_readers_agree(session: Path) -> None:
    expected = samples.plain(CONTENT)
    for kind in (SeekingReader, NonSeekingReader):
        with session.open("rb") as file:
            reader = kind(file, validate_crcs=True)
            got = [
                (channel.topic, schema.name, message.data, message.log_time)
                for schema, channel, message in reader.iter_messages(log_time_order=False)
            ]
            assert got == expected
        with session.open("rb") as file:
            reader = kind(file, validate_crcs=True)
            summary = reader.get_summary()
            assert summary.statistics.message_count == len(CONTENT)
            assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 5
            assert summary.statistics.message_start_time == samples.START
            assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
            assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
            for channel in summary.channels.values():
                assert channel.metadata.keys() == {"offered_qos_profiles", "topic_type_hash"}
    with session.open("rb") as file:
        reader = SeekingReader(file)
        assert reader.get_header().profile == "ros2"
        attachments = {item.name: item.data for item in reader.iter_attachments()}
        assert attachments == {
            "scene.yaml": samples.SNAPSHOT.scene_yaml.encode(),
            "state.npz": samples.SNAPSHOT.state,
            "file:cloth.springs": b"springs",
        }
        assert [item.name for item in reader.iter_metadata()] == ["cloth_sim", "cloth_sim_end"]


def test_rosbags_agrees(session: Path) -> None:
    with AnyReader([session]) as reader:
        got = [
            (connection.topic, connection.msgtype, bytes(data), time) for connection, time, data in reader.messages()
        ]
        assert got == samples.plain(CONTENT)
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    with BagReader(session) as bag:
        assert bag.message_count == len(CONTENT)


def test_indexes_counts_and_declarations_agree_with_the_data(session: Path) -> None:
    samples.check_structure(session)


def test_cloud_is_paired_with_its_frame_only(tmp_path: Path) -> None:
    frames = [item for item in CONTENT if item.topic in (samples.FRAME, samples.POINTS)]
    del frames[6]  # The record of frame 3.
    path = samples.write_session(tmp_path, frames)
    with SessionReader(path) as reader:
        numbers = [None if item.frame is None else item.frame.frame for item in reader.clouds()]
    assert numbers == [0, 1, 2, None, *range(4, 90)]


def test_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    files = [samples.write_session(tmp_path / name, CONTENT) for name in ("a", "b")]
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("name", ["out.npz", "out.parquet"])
def test_session_is_exported_while_it_grows(tmp_path: Path, name: str) -> None:
    if name.endswith(".parquet"):
        pytest.importorskip("pyarrow")
    writer = SessionWriter(
        tmp_path, snapshot=samples.SNAPSHOT, stem="live", log_time=samples.START, options=samples.SMALL_CHUNKS
    )
    content = iter([sample for sample in samples.samples(200) if sample.topic in (samples.FRAME, samples.POINTS)])
    for topic, kind in ((samples.FRAME, "std_msgs/msg/String"), (samples.POINTS, "sensor_msgs/msg/PointCloud2")):
        writer.declare(topic, kind)

    def record(n_messages: int) -> None:
        for sequence, sample in enumerate(itertools.islice(content, n_messages)):
            times = {"log_time": sample.log_time, "publish_time": sample.log_time}
            writer.add(sample.topic, sample.data, **times, sequence=sequence)

    record(200)
    with SessionReader(writer.path) as reader:
        assert 90 <= export(reader, tmp_path / name, on_progress=lambda: record(1)) <= 200
    assert (tmp_path / name).exists()
    writer.abandon()


def test_filters_by_topic_and_time(session: Path) -> None:
    start, end = CONTENT[100].log_time, CONTENT[200].log_time
    expected = [item for item in CONTENT if item.topic == samples.FRAME and start <= item.log_time < end]
    assert expected
    with SessionReader(session) as reader:
        assert samples.plain(list(reader.messages([samples.FRAME], start=start, end=end))) == samples.plain(expected)
        # Chunks outside of the time range are not read.
        assert all(chunk.location.offset > 5000 for chunk in reader.parts[0].chunks(start=end))


def test_a_chunk_closes_by_size_and_by_age(tmp_path: Path) -> None:
    now = [0.0]
    options = WriterOptions(chunk_bytes=100_000, chunk_seconds=0.5, sync_seconds=0)
    writer = SessionWriter(
        tmp_path, snapshot=samples.SNAPSHOT, stem="aged", log_time=0, options=options, clock=lambda: now[0]
    )
    writer.declare(samples.FRAME, "std_msgs/msg/String")
    assert writer.seconds_until_due() is None

    def add(size: int) -> None:
        writer.add(samples.FRAME, bytes(size), log_time=1, publish_time=1, sequence=0)

    add(10)
    now[0] = 0.4
    writer.maintain()
    assert writer.message_count == 0
    assert writer.seconds_until_due() == pytest.approx(0.1)
    now[0] = 0.5
    writer.maintain()
    assert writer.message_count == 1
    add(100_000)
    assert writer.message_count == 2
    writer.finish(reason="stopped")


def test_power_loss_costs_at_most_the_sync_period(tmp_path: Path) -> None:
    now, synced = [0.0], []
    options = WriterOptions(chunk_seconds=0.5, sync_seconds=2.0)
    writer = SessionWriter(
        tmp_path, snapshot=samples.SNAPSHOT, stem="synced", log_time=0, options=options, clock=lambda: now[0]
    )
    # private: counts calls of fsync
    writer._file.sync = lambda: synced.append(now[0])  # type: ignore[method-assign]
    writer.declare(samples.FRAME, "std_msgs/msg/String")
    for tick in range(100):
        now[0] = tick * 0.1
        writer.add(samples.FRAME, bytes(10), log_time=1, publish_time=1, sequence=0)
        writer.maintain()
    assert len(synced) >= 3
    assert max(b - a for a, b in zip([0.0, *synced], [*synced, now[0]], strict=True)) <= 0.5 + 2.0 + 0.11
    writer.finish(reason="stopped")


def test_a_file_is_never_overwritten(tmp_path: Path) -> None:
    first = samples.write_session(tmp_path, CONTENT[:10])
    before = first.read_bytes()
    second = samples.write_session(tmp_path, CONTENT[:20])
    third = samples.write_session(tmp_path, CONTENT[:30])
    assert [path.name for path in (first, second, third)] == [
        "session_000.mcap",
        "session_000-2.mcap",
        "session_000-3.mcap",
    ]
    assert first.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in (first, second, third))


def test_hidden_leftovers_of_killed_process_are_removed(tmp_path: Path) -> None:
    old = tmp_path / ".session_000.mcap.0123abcd.unfinished"
    used = tmp_path / ".session_000.mcap.1123abcd.unfinished"
    young = tmp_path / ".session_000.mcap.2123abcd.unfinished"
    unrelated = tmp_path / ".notes"
    for path in (old, used, young, unrelated):
        path.touch()
        if path != young:
            os.utime(path, (0, 0))
    with used.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        samples.write_session(tmp_path, [])
    assert [path.exists() for path in (old, used, young, unrelated)] == [False, True, True, True]


def test_session_without_messages_is_complete(tmp_path: Path) -> None:
    path = samples.write_session(tmp_path, [])
    with SessionReader(path) as reader:
        assert list(reader.messages()) == []
        assert reader.complete
    with AnyReader([path]) as bag:
        assert bag.message_count == 0


def test_other_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("not an mcap at all")
    (tmp_path / "empty.mcap").touch()
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    with (tmp_path / "ros1.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        writer.finish()
    for name, said in [
        ("text.mcap", "is not an MCAP file"),
        ("empty.mcap", "is not an MCAP file"),
        ("other.mcap", "cloth_sim did not record it"),
        ("ros1.mcap", "profile 'ros1'"),
        ("absent.mcap", "does not exist"),
        (".", "is a folder"),
    ]:
        with pytest.raises(SessionError, match=said):
            SessionReader(tmp_path / name)


def test_wrong_settings_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"chunks of 0\.0 s"):
        WriterOptions(chunk_seconds=0.0)
    with pytest.raises(RecordingError, match="chunk of 0 bytes"):
        WriterOptions(chunk_bytes=0)
    with pytest.raises(SessionError, match="none, lz4 or zstd"):
        samples.write_session(tmp_path, [], options=WriterOptions(compression="gzip"))  # type: ignore[arg-type]


def test_parts_are_accepted_in_order_only(tmp_path: Path) -> None:
    parts = []
    for index in range(3):
        writer = SessionWriter(tmp_path, snapshot=samples.SNAPSHOT, stem="s", part=index, log_time=0)
        writer.finish(reason="split")
        parts.append(writer.path)
    second_session = samples.write_session(tmp_path, [], stem="other")
    SessionReader(parts).close()
    SessionReader(parts[1:]).close()
    for wrong, said in [
        (parts[::-1], "part 1 of its session and follows part 2"),
        ([parts[0], parts[2]], "part 2 of its session and follows part 0"),
        ([parts[0], second_session], "belongs to session other"),
        ([], "no session file"),
    ]:
        with pytest.raises(SessionError, match=said):
            SessionReader(wrong)


def test_session_imports_no_other_room() -> None:
    script = (
        "import sys\n"
        "import cloth_sim_ros.session.recorder, cloth_sim_ros.session.reader, cloth_sim_ros.session.recover\n"
        "import cloth_sim_ros.session.info, cloth_sim_ros.session.export, cloth_sim_ros.session.main\n"
        "names = set(sys.modules)\n"
        "walls = ('rclpy', 'std_msgs', 'sensor_msgs', 'rerun', 'scipy', 'cloth_sim_ros.engine',\n"
        "         'cloth_sim_ros.physics', 'cloth_sim_ros.scene', 'cloth_sim_ros.simulation', 'cloth_sim_ros.ros')\n"
        "late = ('rosbags', 'pyarrow', 'lz4', 'zstandard', 'tqdm')\n"
        "print(sorted(name for name in names if name in walls or name in late))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
