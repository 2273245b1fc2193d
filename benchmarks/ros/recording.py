# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of recording, measured on the clouds of a session.

python -m benchmarks recording session.mcap
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.mcap_builder import Compression
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter, WriterOptions
from validation.report import Report

_MEMORY = 256 << 20
"""Size of the part of the session that is loaded and written repeatedly [bytes]."""
_SNAPSHOT = SessionSnapshot(scene_yaml="/**: {}\n", state=b"-", metadata={"node": "/measure"})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("session", type=Path)
    parser.add_argument("--folder", type=Path, help="where to write; by default a temporary folder")
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")


def run(options: argparse.Namespace) -> Report:
    """Measure size and work of each setting."""
    report = Report("Recording")
    try:
        frames = _frames(_load(options.session))
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            _measure_size(report, frames, Path(folder), options.rate)
    except (SessionError, OSError) as error:
        raise ValueError(str(error)) from error
    return report


def _load(path: Path) -> list[Message]:
    loaded: list[Message] = []
    size = 0
    with SessionReader(path) as reader:
        for message in reader.messages():
            loaded.append(message)
            size += len(message.data)
            if size > _MEMORY:
                break
    if not any(message.topic.endswith("/points") for message in loaded):
        raise SessionError(f"{path} has no clouds to measure with")
    return loaded


def _frames(messages: Sequence[Message]) -> list[list[Message]]:
    """Group the messages by frame."""
    frames: list[list[Message]] = []
    for message in messages:
        if message.topic.endswith("/frame") or not frames:
            frames.append([])
        frames[-1].append(message)
    return [frame for frame in frames if any(message.topic.endswith("/points") for message in frame)]


def _measure_size(report: Report, frames: Sequence[Sequence[Message]], folder: Path, rate: float) -> None:
    raw = sum(len(message.data) for frame in frames for message in frame)
    report.note(f"{len(frames)} frames, {raw / len(frames) / 1e3:,.1f} kB each")
    columns = ["compression", "chunk MiB", "GB an hour", "ratio", "ms of work a frame", "of a core %"]
    table = report.add_table(f"An hour at {rate:g} Hz", columns)
    names: tuple[Compression, ...] = ("none", "lz4", "zstd")
    for compression in names:
        for chunk in (1 << 20, 4 << 20):
            options = WriterOptions(compression=compression, chunk_bytes=chunk, sync_seconds=0)
            stem = f"{compression}{chunk}"
            writer = SessionWriter(folder, snapshot=_SNAPSHOT, stem=stem, log_time=0, options=options)
            begin = time.thread_time()
            for frame in frames:
                for message in frame:
                    _add(writer, message)
            writer.finish(reason="measured")
            work = (time.thread_time() - begin) / len(frames)
            size = writer.bytes_written
            writer.path.unlink()
            hour = size / len(frames) * rate * 3600
            share = 100.0 * work * rate
            table.rows.append([compression, chunk >> 20, hour / 1e9, raw / size, 1e3 * work, share])


def _add(writer: SessionWriter, message: Message) -> None:
    if not writer.is_declared(message.topic):
        writer.declare(message.topic, message.type_name)
    log_time, publish_time = message.log_time, message.publish_time
    writer.add(message.topic, message.data, log_time=log_time, publish_time=publish_time, sequence=message.sequence)
