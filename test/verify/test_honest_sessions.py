# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions with legitimately missing messages, or from other writers, are accepted."""

from __future__ import annotations

import contextlib
import errno
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from support.mcap_copies import copy_by_tool
from support.random_sessions import make_random_session
from support.session_maker import NODE, make_grasp

from cloth_sim_ros.session.channel_description import Qos
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.recorder import Recorder, RecorderOptions, RecorderStatus
from cloth_sim_ros.session.recover import recover
from cloth_sim_ros.session.storage import AppendFile
from cloth_sim_ros.session.writer import STATE_NAME, SessionSnapshot, WriterOptions
from cloth_sim_ros.verify.main import describe, status_of
from cloth_sim_ros.verify.run import Verdict, verify

FRAMES = 30
DROPPABLE = (f"{NODE}/points", f"{NODE}/gripper/wrench")
QUICK = WriterOptions(chunk_bytes=2048, chunk_seconds=0.05, sync_seconds=0, compression="none")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_grasp(tmp_path_factory.mktemp("session"), seconds=FRAMES / 60.0, cloth__resolution=[5, 6])


def record_again(
    source: Path,
    folder: Path,
    *,
    open_file: Callable[[Path, str, str], AppendFile] = AppendFile,
    after: Callable[[int], object] = lambda _number: None,
    **options: Any,
) -> tuple[Path, RecorderStatus]:
    """Record a session's messages like a node; call `after` with the index of each."""
    part = SessionPart(source)
    messages: Sequence[Message] = list(part.messages())
    recorder = Recorder(
        folder,
        snapshot=SessionSnapshot(
            scene_yaml=part.scene_yaml, state=part.state, metadata=part.metadata, files=part.files
        ),
        log_time=part.attachments[STATE_NAME].log_time,
        options=RecorderOptions(writer=QUICK, **options),
        open_file=open_file,
    )
    path = recorder.wait_until_open()
    for index, message in enumerate(messages):
        latched = message.topic == f"{NODE}/topology"
        recorder.record(
            message.topic,
            message.type_name,
            message.data,
            log_time=message.publish_time,
            droppable=message.topic in DROPPABLE,
            qos=Qos(durability="transient_local", depth=1) if latched else None,
        )
        after(index)
    status = recorder.close()
    part.close()
    return path, status


def check(verdict: Verdict) -> None:
    assert verdict.same, describe(verdict)
    assert status_of(verdict) == 0
    assert verdict.frames


def test_clouds_dropped_by_a_slow_disk_are_no_difference(session: Path, tmp_path: Path) -> None:
    gate = threading.Event()

    class Gated(AppendFile):
        def _write(self, view: memoryview) -> int:
            if self.size:
                gate.wait()
            return super()._write(view)

    path, status = record_again(
        session,
        tmp_path,
        open_file=Gated,
        queue_bytes=30_000,
        after=lambda index: gate.set() if index == 100 else None,
    )
    verdict = verify([path])
    check(verdict)
    assert status.dropped > 3
    assert verdict.compared["cloud"] + verdict.compared["wrench"] == 2 * FRAMES - status.dropped
    assert f"{status.dropped} clouds were dropped" in describe(verdict)


def test_recording_ended_by_full_disk_reruns_equally(session: Path, tmp_path: Path) -> None:
    class Full(AppendFile):
        def _write(self, view: memoryview) -> int:
            if self.size > 30_000 and len(view) > 1500:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super()._write(view)

    path, status = record_again(session, tmp_path, open_file=Full)
    assert status.state == "failed"
    verdict = verify([path])
    check(verdict)
    assert verdict.frames < FRAMES


@pytest.mark.parametrize("share", [0.55, 0.7, 0.8, 0.9, 0.97])
def test_recovered_session_reruns_equally(session: Path, tmp_path: Path, share: float) -> None:
    path, _ = record_again(session, tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    check(verify([path]))
    verdict = verify([recover(path).path])
    check(verdict)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_copies_of_random_sessions_rerun_equally(tmp_path: Path, seed: int) -> None:
    paths = make_random_session(tmp_path, seed, frames=30)
    copies = []
    for index, path in enumerate(paths):
        with contextlib.closing(SessionPart(path)) as part:
            finished = part.finished
        if finished:
            copies.append(copy_by_tool(path, tmp_path / f"copy{index}.mcap", use_chunking=bool(index % 2)))
    if copies:
        check(verify(copies))


def test_copy_without_a_topic_is_found_by_message_count(session: Path, tmp_path: Path) -> None:
    copy = copy_by_tool(session, tmp_path / "copy.mcap", topics=lambda topic: not topic.endswith("/wrench"))
    verdict = verify([copy])
    assert f"{NODE}/gripper/wrench" in verdict.absent
    assert "the end record of copy.mcap: it counts" in verdict.first_reason


def test_other_messages_merged_into_a_session_are_listed(session: Path, tmp_path: Path) -> None:
    path, _ = record_again(session, tmp_path)
    copy = copy_by_tool(path, tmp_path / "copy.mcap", extra={"/camera/info": 7})
    verdict = verify([copy])
    check(verdict)
    assert verdict.not_compared["/camera/info", "not the node's"] == 7
