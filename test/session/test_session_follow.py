# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Following a session during its recording: every message once, in order."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import session_samples as samples

from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recorder import Recorder, RecorderOptions
from cloth_sim_ros.session.recover import recover
from cloth_sim_ros.session.writer import WriterOptions

CONTENT = list(samples.samples(30))
QUICK = RecorderOptions(writer=WriterOptions(chunk_bytes=4096, chunk_seconds=0.02, sync_seconds=0))


def _record(recorder: Recorder, content: list[samples.Sample]) -> None:
    for item in content:
        recorder.record(item.topic, item.type_name, item.data, log_time=item.log_time, droppable=item.droppable)


def _start(folder: Path) -> Recorder:
    return Recorder(folder, snapshot=samples.SNAPSHOT, log_time=samples.START, stem="live", options=QUICK)


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    new_recorder = _start(tmp_path)
    yield new_recorder
    new_recorder.close()


def test_messages_come_while_they_are_recorded(recorder: Recorder) -> None:
    with SessionReader(recorder.wait_until_open()) as reader:
        assert "still being recorded" in str(reader.missing)
        coming = reader.follow(poll=0.005)
        got = []
        for item in CONTENT:
            # Each message is read before the next is recorded; therefore none comes from the finished file.
            _record(recorder, [item])
            got.append(next(coming))
        assert samples.plain(got) == samples.plain(CONTENT)
        recorder.close()
        assert list(coming) == []
        assert reader.complete
        assert reader.missing is None


def test_split_session_is_followed_into_next_files(recorder: Recorder) -> None:
    got: list[Message] = []
    with SessionReader(recorder.wait_until_open()) as reader:
        thread = threading.Thread(target=lambda: got.extend(reader.follow(poll=0.005)))
        thread.start()
        for index in range(3):
            _record(recorder, CONTENT[30 * index : 30 * index + 30])
            recorder.split(samples.SNAPSHOT, log_time=CONTENT[30 * index + 30].log_time)
        recorder.close()
        thread.join(30.0)
        assert not thread.is_alive()
        assert samples.plain(got) == samples.plain(CONTENT[:90])
        assert len(reader.parts) == 4
        assert reader.complete


def test_follow_ends_with_death_of_recording_process(tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "sys.path[:0] = sys.argv[2:]\n"
        "import test_session_follow as t\n"
        "from pathlib import Path\n"
        "recorder = t._start(Path(sys.argv[1]))\n"
        "t._record(recorder, t.CONTENT)\n"
        "print(recorder.wait_until_open(), flush=True)\n"
        "sys.stdin.read()\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path), *map(str, Path(__file__).parents[:2])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout is not None
        with SessionReader(child.stdout.readline().strip()) as reader:
            coming = reader.follow(poll=0.005)
            got = [next(coming) for _ in CONTENT]
            child.send_signal(signal.SIGKILL)
            assert list(coming) == []
            assert samples.plain(got) == samples.plain(CONTENT)
            assert "cut off" in str(reader.missing)
    finally:
        child.kill()
        child.communicate()


def test_follow_ends_on_request(recorder: Recorder) -> None:
    _record(recorder, CONTENT[:5])
    answers = iter([True, True, False])
    with SessionReader(recorder.wait_until_open()) as reader:
        list(reader.follow(poll=0.001, keep_waiting=lambda: next(answers)))
        assert list(answers) == []


def test_a_file_being_recorded_is_not_recovered(recorder: Recorder) -> None:
    from cloth_sim_ros.session.errors import SessionError

    path = recorder.wait_until_open()
    with pytest.raises(SessionError, match="still being recorded"):
        recover(path)
    part = SessionPart(path)
    assert part.is_being_written()
    recorder.close()
    assert not part.is_being_written()
    part.close()
