# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of recording, measured on the clouds of a session.

python -m benchmarks recording session.mcap
"""

from __future__ import annotations

import argparse
import itertools
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

#: Size of the part of the session that is loaded and written repeatedly [bytes].
_MEMORY = 256 << 20
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
        messages = _load(options.session)
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            _measure(report, messages, Path(folder), options.rate)
    except (SessionError, OSError) as error:
        raise ValueError(str(error)) from error
    return report


def _load(path: Path) -> list[Message]:
    """Return the first messages of a session from its first frame on."""
    loaded, size = list[Message](), 0
    with SessionReader(path) as reader:
        for message in itertools.dropwhile(lambda entry: not entry.topic.endswith("/frame"), reader.messages()):
            loaded.append(message)
            size += len(message.data)
            if size > _MEMORY:
                break
    return loaded


def _measure(report: Report, messages: Sequence[Message], folder: Path, rate: float) -> None:
    n_frames = sum(message.topic.endswith("/points") for message in messages)
    if not n_frames:
        raise SessionError("the session has no clouds to measure with")
    raw = sum(len(message.data) for message in messages)
    report.note(f"{n_frames} frames, {raw / n_frames / 1e3:,.1f} kB each")
    columns = ["compression", "chunk MiB", "GB an hour", "ratio", "ms of work a frame", "of a core %"]
    table = report.add_table(f"An hour at {rate:g} Hz", columns)
    names: tuple[Compression, ...] = ("none", "lz4", "zstd")
    for compression, chunk in itertools.product(names, (1 << 20, 4 << 20)):
        options = WriterOptions(compression=compression, chunk_bytes=chunk, sync_seconds=0)
        stem = f"{compression}{chunk}"
        writer = SessionWriter(folder, snapshot=_SNAPSHOT, stem=stem, log_time=0, options=options)
        begin = time.thread_time()
        for message in messages:
            if not writer.is_declared(message.topic):
                writer.declare(message.topic, message.type_name)
            times = {"log_time": message.log_time, "publish_time": message.publish_time}
            writer.add(message.topic, message.data, **times, sequence=message.sequence)
        writer.finish(reason="measured")
        work = (time.thread_time() - begin) / n_frames
        hour = writer.bytes_written / n_frames * rate * 3600 / 1e9
        row = [compression, chunk >> 20, hour, raw / writer.bytes_written, 1e3 * work, 100.0 * work * rate]
        table.rows.append(row)
        writer.path.unlink()
