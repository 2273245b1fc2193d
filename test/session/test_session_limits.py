# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording without free descriptors, threads or memory: a reason, no partial files, and a working retry."""

from __future__ import annotations

import errno
import os
import resource
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from support.session_samples import SNAPSHOT

from cloth_sim_ros.session.errors import RecordingError
from cloth_sim_ros.session.recorder import Recorder
from cloth_sim_ros.session.recorder_options import RecorderOptions
from cloth_sim_ros.session.storage import AppendFile

STEPS = ["open", "append", "sync", "publish", "sync_name"]
FAILURES = [OSError(errno.EMFILE, "Too many open files"), OSError(errno.ENOSPC, "No space left"), MemoryError()]


def failing_file(step: str, error: Exception) -> type[AppendFile]:
    """AppendFile of which one method fails after its work."""

    class FailingFile(AppendFile):
        def __init__(self, folder: Path, stem: str, suffix: str) -> None:
            if step == "open":
                raise error
            super().__init__(folder, stem, suffix)

        def append(self, parts: Sequence[bytes]) -> None:
            super().append(parts)
            self._fail("append")

        def sync(self) -> None:
            super().sync()
            self._fail("sync")

        def publish(self) -> Path:
            path = super().publish()
            self._fail("publish")
            return path

        def sync_name(self) -> None:
            super().sync_name()
            self._fail("sync_name")

        def _fail(self, at: str) -> None:
            if at == step:
                raise error

    return FailingFile


def recorder(folder: Path, **options: Any) -> Recorder:
    """Return a recorder of a session that begins now."""
    return Recorder(folder, snapshot=SNAPSHOT, log_time=1, stem="cloth", **options)


@pytest.mark.parametrize("error", FAILURES, ids=["files", "space", "memory"])
@pytest.mark.parametrize("step", STEPS)
def test_recording_that_fails_to_begin_leaves_nothing(
    tmp_path: Path, wait_until: Callable[..., object], step: str, error: Exception
) -> None:
    threads, descriptors = threading.active_count(), len(os.listdir("/proc/self/fd"))
    failed = recorder(tmp_path, open_file=failing_file(step, error))
    with pytest.raises(RecordingError, match=r"cannot write|no memory"):
        failed.wait_until_open()
    assert failed.status().state == "failed"
    assert failed.close().state == "failed"
    assert list(tmp_path.iterdir()) == []
    wait_until(lambda: threading.active_count() == threads, description="the recorder's thread to end")
    assert len(os.listdir("/proc/self/fd")) == descriptors
    again = recorder(tmp_path)
    assert again.wait_until_open().exists()
    assert again.close().state == "closed"


def test_recording_without_descriptors_names_the_limit(tmp_path: Path) -> None:
    recorder(tmp_path / "warm").close()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(int(name) for name in os.listdir("/proc/self/fd")), hard))
    spare = []
    try:
        while True:
            try:
                spare.append(os.dup(0))
            except OSError:
                break
        failed = recorder(tmp_path)
        with pytest.raises(RecordingError, match=r"Too many open files; .*ulimit -n"):
            failed.wait_until_open()
    finally:
        for descriptor in spare:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert list(tmp_path.glob("*.mcap")) == list(tmp_path.glob(".*")) == []
    assert recorder(tmp_path).close().state == "closed"


def test_recording_without_threads_names_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RecordingError, match=r"can't start new thread; .*ulimit -u"):
            recorder(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert recorder(tmp_path).close().state == "closed"


@pytest.mark.parametrize("error", FAILURES, ids=["files", "space", "memory"])
def test_failed_split_ends_a_complete_recording(
    tmp_path: Path, wait_until: Callable[..., object], error: Exception
) -> None:
    files = iter([AppendFile, failing_file("sync_name", error)])
    recording = recorder(tmp_path, options=RecorderOptions(split_bytes=1), open_file=lambda *place: next(files)(*place))
    path = recording.wait_until_open()
    wait_until(lambda: recording.wants_split, description="the file's limit")
    recording.split(SNAPSHOT, log_time=2)
    wait_until(lambda: recording.status().state == "failed", description="the recording's end")
    assert recording.status().error
    assert list(tmp_path.iterdir()) == [path]
    from cloth_sim_ros.session.reader import SessionReader

    with SessionReader(path) as reader:
        assert reader.parts[0].summary is not None
