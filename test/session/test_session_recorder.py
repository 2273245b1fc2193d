# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorder: never blocks, drops clouds only, and ends cleanly on every disk error."""

from __future__ import annotations

import dataclasses
import errno
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import SeekingReader
from support import session_samples as samples

from cloth_sim_ros.session.errors import RecordingError
from cloth_sim_ros.session.reader import SessionReader, session_files
from cloth_sim_ros.session.recorder import Recorder, RecorderOptions, RecorderStatus
from cloth_sim_ros.session.storage import AppendFile
from cloth_sim_ros.session.writer import SessionWriter, WriterOptions

CONTENT = list(samples.samples(60))
# Uncompressed, for known sizes on the disk.
QUICK = WriterOptions(chunk_bytes=8192, chunk_seconds=0.05, sync_seconds=0, compression="none")


def _record(recorder: Recorder, content: list[samples.Sample]) -> None:
    for item in content:
        recorder.record(
            item.topic,
            item.type_name,
            item.data,
            log_time=item.log_time,
            droppable=item.droppable,
            qos=samples.LATCHED if item.topic == samples.TOPOLOGY else None,
        )


def _start(folder: Path, **options: object) -> Recorder:
    open_file = options.pop("open_file", AppendFile)
    return Recorder(
        folder,
        snapshot=samples.SNAPSHOT,
        log_time=samples.START,
        stem="session",
        options=RecorderOptions(**{"writer": QUICK, **options}),  # type: ignore[arg-type]
        open_file=open_file,  # type: ignore[arg-type]
    )


def _until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)


class GatedFile(AppendFile):
    """Disk that blocks while its gate is closed."""

    gate = threading.Event()

    def _write(self, view: memoryview) -> int:
        self.gate.wait(30.0)
        return super()._write(view)


class SmallDisk(AppendFile):
    """Disk that is full after some bytes, in the middle of a write."""

    room = 40_000
    error = errno.ENOSPC

    def _write(self, view: memoryview) -> int:
        left = self.room - os.lseek(self._descriptor, 0, os.SEEK_CUR)
        if left <= 0:
            raise OSError(self.error, os.strerror(self.error))
        return super()._write(view[:left])


def _plain(path: Path) -> list[tuple[str, str, bytes, int]]:
    return samples.plain(samples.read_all(path))


def test_recorded_messages_are_in_the_file(tmp_path: Path) -> None:
    recorder = _start(tmp_path / "new" / "folder")
    path = recorder.wait_until_open()
    _record(recorder, CONTENT)
    status = recorder.close()
    assert status == RecorderStatus(
        state="closed",
        path=path,
        bytes_written=path.stat().st_size,
        messages=len(CONTENT),
        dropped=0,
        queue_depth=0,
        queue_bytes=0,
        error="",
    )
    with SessionReader(path, strict=True) as reader:
        assert samples.plain(list(reader.messages())) == samples.plain(CONTENT)
        assert reader.complete
    assert recorder.close() == status
    assert not recorder.record(samples.FRAME, "std_msgs/msg/String", b"", log_time=0, droppable=False)


def test_files_are_named_by_their_start(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, snapshot=samples.SNAPSHOT, log_time=0)
    path = recorder.wait_until_open()
    recorder.close()
    assert path.match("cloth_sim_20[0-9][0-9]-[0-9][0-9]-[0-9][0-9]T[0-9][0-9]-[0-9][0-9]-[0-9][0-9]_000.mcap")


def test_stuck_disk_drops_clouds_only_and_never_blocks(tmp_path: Path) -> None:
    class Gated(GatedFile):
        gate = threading.Event()

    cloud_size = len(next(item.data for item in CONTENT if item.droppable))
    recorder = _start(tmp_path, queue_bytes=30 * cloud_size, open_file=Gated)
    # The disk is blocked: a call that waited for it would never return.
    _record(recorder, CONTENT)
    status = recorder.status()
    assert status.state == "opening"
    assert status.dropped > 10
    assert status.queue_bytes < 30 * cloud_size + 200_000
    Gated.gate.set()
    done = recorder.close()
    assert (done.state, done.dropped) == ("closed", status.dropped)
    assert done.path is not None
    messages = samples.read_all(done.path)
    undroppable = [item for item in messages if item.topic != samples.POINTS]
    assert samples.plain(undroppable) == [item for item in samples.plain(CONTENT) if item[0] != samples.POINTS]
    clouds = [item for item in messages if item.topic == samples.POINTS]
    assert len(clouds) == 60 - status.dropped
    # The sequence numbers show the missing messages.
    everything = [item.data for item in CONTENT if item.topic == samples.POINTS]
    assert all(everything[item.sequence] == item.data for item in clouds)
    with SessionReader(done.path) as reader:
        assert f"{status.dropped} clouds were dropped" in str(reader.missing)


def test_backlog_of_undroppable_messages_ends_recording(tmp_path: Path) -> None:
    class Gated(GatedFile):
        gate = threading.Event()

    recorder = _start(tmp_path, backlog_bytes=50_000, open_file=Gated)
    _record(recorder, CONTENT)
    status = recorder.status()
    assert status.state == "failed"
    assert "stuck or too slow" in status.error
    assert status.queue_bytes < 52_000
    assert not recorder.record(samples.FRAME, "std_msgs/msg/String", b"", log_time=0, droppable=False)
    Gated.gate.set()
    status = recorder.close()
    assert (status.state, status.queue_depth, status.dropped) == ("failed", 0, 0)
    assert status.path is not None
    with SessionReader(status.path, strict=True) as reader:
        got = samples.plain(list(reader.messages()))
        assert got == samples.plain(CONTENT)[: len(got)]
        assert len(got) > 20
        assert reader.complete
        assert "stuck or too slow" in reader.parts[0].end_notes["reason"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_full_or_broken_disk_ends_recording_with_written_part(tmp_path: Path, code: int) -> None:
    by_size = dataclasses.replace(QUICK, chunk_bytes=20_000, chunk_seconds=30.0)
    with samples.write_session(tmp_path, CONTENT, options=by_size, stem="like").open("rb") as file:
        third = SeekingReader(file).get_summary().chunk_indexes[2].chunk_start_offset

    class Failing(SmallDisk):
        error = code
        # Almost the whole third chunk: after its removal the indexes fit.
        room = third + 19_000

    recorder = _start(tmp_path, open_file=Failing, writer=by_size)
    _record(recorder, CONTENT)
    _until(lambda: recorder.status().state == "failed")
    status = recorder.close()
    assert os.strerror(code) in status.error
    assert status.path is not None
    assert str(status.path) in status.error
    assert not recorder.wants_split
    with SessionReader(status.path, strict=True) as reader:
        got = samples.plain(list(reader.messages()))
        assert got == samples.plain(CONTENT)[: len(got)]
        assert len(got) == status.messages > 20
        assert reader.complete
        assert os.strerror(code) in reader.parts[0].end_notes["reason"]
    samples.check_structure(status.path)


def test_declarations_of_lost_chunk_are_not_in_the_indexes(tmp_path: Path) -> None:
    class Full(SmallDisk):
        room = 1 << 30

    writer = SessionWriter(tmp_path, snapshot=samples.SNAPSHOT, stem="s", log_time=0, options=QUICK, open_file=Full)
    writer.declare("/a", "std_msgs/msg/String")
    writer.add("/a", bytes(9000), log_time=1, publish_time=1, sequence=0)
    Full.room = writer.bytes_written + 8500
    writer.declare("/b", "std_msgs/msg/Bool")
    with pytest.raises(OSError, match="No space"):
        writer.add("/b", bytes(9000), log_time=2, publish_time=2, sequence=0)
    with pytest.raises(OSError, match="No space"):
        writer.finish(reason="full")
    samples.check_structure(writer.path)
    with SessionReader(writer.path, strict=True) as reader:
        assert [item.topic for item in reader.messages()] == ["/a"]
        assert reader.complete


def test_file_without_space_for_indexes_is_intact(tmp_path: Path) -> None:
    class Full(SmallDisk):
        """Disk that refuses every byte after it was full."""

        full = False

        def _write(self, view: memoryview) -> int:
            if self.full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            try:
                return super()._write(view)
            except OSError:
                type(self).full = True
                raise

    recorder = _start(tmp_path, open_file=Full)
    _record(recorder, CONTENT)
    _until(lambda: recorder.status().state == "failed")
    status = recorder.close()
    assert status.path is not None
    assert status.path.stat().st_size == status.bytes_written
    with SessionReader(status.path) as reader:
        got = samples.plain(list(reader.messages()))
        assert got == samples.plain(CONTENT)[: len(got)]
        assert len(got) == status.messages > 20
        assert "cut off" in str(reader.missing)
        assert "torn" not in str(reader.missing)


def test_file_size_limit_of_the_system(tmp_path: Path) -> None:
    script = (
        "import resource, sys\n"
        "sys.path[:0] = sys.argv[2:]\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))\n"
        "import test_session_recorder as t\n"
        "from pathlib import Path\n"
        "recorder = t._start(Path(sys.argv[1]))\n"
        "t._record(recorder, t.CONTENT)\n"
        "t._until(lambda: recorder.status().state == 'failed')\n"
        "print(recorder.close().error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path), *map(str, Path(__file__).parents[:2])],
        capture_output=True,
        text=True,
        check=True,
    )
    assert os.strerror(errno.EFBIG) in done.stdout
    (path,) = tmp_path.glob("*.mcap")
    assert path.stat().st_size <= 60_000
    got = _plain(path)
    assert got == samples.plain(CONTENT)[: len(got)]
    assert len(got) > 20


def test_low_free_space_ends_recording_before_disk_is_full(tmp_path: Path) -> None:
    class Shrinking(AppendFile):
        def free_space(self) -> int:
            return 1_000_000 - self.size

    options = dataclasses.replace(QUICK, min_free_space=950_000)
    recorder = _start(tmp_path, writer=options, open_file=Shrinking)
    _record(recorder, CONTENT)
    _until(lambda: recorder.status().state == "failed")
    status = recorder.close()
    assert "least_free_space" in status.error
    assert status.path is not None
    with SessionReader(status.path, strict=True) as reader:
        assert reader.complete
        assert samples.plain(list(reader.messages())) == samples.plain(CONTENT)[: status.messages]
    assert 40_000 < status.path.stat().st_size < 70_000


def test_a_folder_removed_while_recording_ends_it(tmp_path: Path) -> None:
    recorder = _start(tmp_path / "sessions")
    recorder.wait_until_open()
    _record(recorder, CONTENT[:100])
    shutil.rmtree(tmp_path / "sessions")
    _record(recorder, CONTENT[100:])
    _until(lambda: recorder.status().state == "failed")
    assert "was removed while it was being recorded" in recorder.close().error


@pytest.mark.parametrize("kind", ["file", "below a file", "read only"])
def test_unusable_folder_is_reported_at_once(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "sessions"
    if kind == "read only":
        if os.geteuid() == 0:
            pytest.skip("nothing is read only for root")
        folder.mkdir(mode=0o500)
    else:
        folder.touch()
        folder = folder / "below" if kind == "below a file" else folder
    recorder = _start(folder)
    with pytest.raises(RecordingError, match=r"record\.folder"):
        recorder.wait_until_open()
    assert not recorder.record(samples.FRAME, "std_msgs/msg/String", b"", log_time=0, droppable=False)
    assert recorder.close().state == "failed"


def test_unknown_types_end_the_recording_with_their_name(tmp_path: Path) -> None:
    recorder = _start(tmp_path)
    _record(recorder, CONTENT[:50])
    recorder.record("/x", "my_msgs/msg/Thing", b"", log_time=0, droppable=False)
    _until(lambda: recorder.status().state == "failed")
    status = recorder.close()
    assert "my_msgs/msg/Thing" in status.error
    assert status.path is not None
    assert _plain(status.path) == samples.plain(CONTENT[:50])


def test_invalid_times_are_refused_at_the_call(tmp_path: Path) -> None:
    recorder = _start(tmp_path)
    for wrong in (-1, 1 << 63):
        with pytest.raises(ValueError, match="nanoseconds"):
            recorder.record(samples.FRAME, "std_msgs/msg/String", b"", log_time=wrong, droppable=False)
    assert recorder.close().state == "closed"


def test_log_times_keep_the_order_of_recording(tmp_path: Path) -> None:
    recorder = _start(tmp_path)
    second = 10**9
    # A command precedes the frame that was due earlier; then the clock is set back by an hour.
    log_times = [5 * second, 5 * second + 700, 5 * second + 300, 5 * second + 800, 5 * second - second // 2]
    log_times += [7200 * second, 3600 * second, 3600 * second - 1]
    for log_time in log_times:
        recorder.record(samples.FRAME, "std_msgs/msg/String", b"", log_time=log_time, droppable=False)
    status = recorder.close()
    assert status.path is not None
    messages = samples.read_all(status.path)
    last = 5 * second + 800
    raised = [5 * second, last - 100, last - 100, last, last, 7200 * second, 3600 * second, 3600 * second]
    assert [item.log_time for item in messages] == raised
    assert [item.publish_time for item in messages] == log_times


def test_close_on_stuck_disk_ends_in_time(tmp_path: Path) -> None:
    class Gated(GatedFile):
        gate = threading.Event()

    Gated.gate.set()
    recorder = _start(tmp_path, open_file=Gated)
    recorder.wait_until_open()
    Gated.gate.clear()
    _record(recorder, CONTENT)
    status = recorder.close(timeout=0.2)
    assert status.state == "failed"
    assert "is the disk stuck?" in status.error
    # The disk was only slow.
    Gated.gate.set()
    assert recorder.close().state == "closed"
    assert status.path is not None
    assert _plain(status.path) == samples.plain(CONTENT)


def test_split_files_each_open_with_their_snapshot(tmp_path: Path) -> None:
    recorder = _start(tmp_path, split_bytes=20_000)
    later = samples.SessionSnapshot(scene_yaml="later: 1\n", state=b"later", metadata=samples.SNAPSHOT.metadata)
    expected: list[list[samples.Sample]] = [[]]
    for frame in range(120):
        content = list(samples.samples(1, first=frame))
        _record(recorder, content)
        expected[-1] += content
        if frame % 10 == 9:
            count = sum(map(len, expected)) + len(expected) - 1
            _until(lambda count=count: recorder.status().messages >= count)  # type: ignore[misc]
        if recorder.wants_split:
            recorder.split(later, log_time=content[-1].log_time + 1)
            assert not recorder.wants_split
            expected.append([])
    status = recorder.close()
    paths = sorted(tmp_path.glob("*.mcap"))
    assert len(paths) == len(expected) > 2
    assert [path.name for path in paths] == [f"session_{index:03d}.mcap" for index in range(len(paths))]
    assert status.bytes_written == sum(path.stat().st_size for path in paths)
    latched = samples.plain(expected[0][:1])[0]
    for index, (path, content) in enumerate(zip(paths, expected, strict=True)):
        with SessionReader(path, strict=True) as reader:
            got = samples.plain(list(reader.messages()))
            assert reader.complete
            assert reader.parts[0].index == index
            assert reader.topology() is not None
            if index == 0:
                assert got == samples.plain(content)
                assert reader.state == samples.SNAPSHOT.state
            else:
                # Every file has the last transient local message, logged at the split.
                assert got[0][:3] == latched[:3]
                assert got[1:] == samples.plain(content)
                assert reader.state == b"later"
        samples.check_structure(path)
    assert session_files(paths[1]) == paths
    with SessionReader(paths, strict=True) as reader:
        assert [frame.frame for frame in reader.frames()] == list(range(120))
        assert reader.complete


def test_each_file_counts_its_own_dropped_clouds(tmp_path: Path) -> None:
    class Gated(GatedFile):
        gate = threading.Event()

    cloud_size = len(next(item.data for item in CONTENT if item.droppable))
    recorder = _start(tmp_path, queue_bytes=20 * cloud_size, open_file=Gated)
    _record(recorder, CONTENT[:120])
    first = recorder.status().dropped
    assert first > 0
    recorder.split(samples.SessionSnapshot(scene_yaml="-", state=b"-"), log_time=CONTENT[119].log_time)
    _record(recorder, CONTENT[120:])
    Gated.gate.set()
    status = recorder.close()
    counted = []
    for path in sorted(tmp_path.glob("*.mcap")):
        with SessionReader(path) as reader:
            counted.append(int(reader.parts[0].end_notes["dropped"]))
    assert counted == [first, status.dropped - first]
    assert counted[1] > 0


def test_split_by_session_time(tmp_path: Path) -> None:
    recorder = _start(tmp_path, split_seconds=0.5)
    _record(recorder, CONTENT[:20])
    _until(lambda: recorder.status().messages == 20)
    assert not recorder.wants_split
    _record(recorder, CONTENT[20:])
    _until(lambda: recorder.wants_split)
    recorder.close()
    assert not recorder.wants_split


def test_failed_split_finishes_first_file(tmp_path: Path) -> None:
    class OneFile(AppendFile):
        def __init__(self, folder: Path, stem: str, suffix: str) -> None:
            if not stem.endswith("_000"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            super().__init__(folder, stem, suffix)

    recorder = _start(tmp_path, open_file=OneFile)
    _record(recorder, CONTENT[:50])
    recorder.split(samples.SNAPSHOT, log_time=CONTENT[50].log_time)
    _record(recorder, CONTENT[50:])
    _until(lambda: recorder.status().state == "failed")
    status = recorder.close()
    assert status.path is not None
    with SessionReader(status.path, strict=True) as reader:
        assert reader.complete
        assert samples.plain(list(reader.messages())) == samples.plain(CONTENT[:50])


def test_many_threads_record_concurrently(tmp_path: Path) -> None:
    recorder = _start(tmp_path)

    def work(name: str) -> None:
        for index in range(300):
            recorder.record(f"/{name}", "std_msgs/msg/String", str(index).encode(), log_time=index, droppable=False)

    threads = [threading.Thread(target=work, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    status = recorder.close()
    assert status.messages == 1200
    assert status.path is not None
    for name in "abcd":
        with SessionReader(status.path) as reader:
            got = list(reader.messages([f"/{name}"]))
        assert [int(item.data) for item in got] == [item.sequence for item in got] == list(range(300))


def test_low_free_space_refuses_the_file(tmp_path: Path) -> None:
    class AlmostFull(AppendFile):
        def free_space(self) -> int:
            return 6_000_000

    options = dataclasses.replace(QUICK, min_free_space=100_000_000)
    recorder = _start(tmp_path, writer=options, open_file=AlmostFull)
    with pytest.raises(RecordingError, match=r"6 MB are left on the disk .*least_free_space is 100 MB"):
        recorder.wait_until_open()
    recorder.close()
    assert not list(tmp_path.iterdir())
