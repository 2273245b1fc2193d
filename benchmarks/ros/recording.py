# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of recording, measured on the clouds of a session.

python -m benchmarks recording session.mcap
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.mcap_builder import Compression
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recorder import Recorder, RecorderOptions
from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter, WriterOptions
from validation.report import Report

_MEMORY = 256 << 20
"""Size of the part of the session that is loaded and written repeatedly [bytes]."""
_SNAPSHOT = SessionSnapshot(scene_yaml="/**: {}\n", state=b"-", metadata={"node": "/measure"})


class _Timing(NamedTuple):
    late: list[float]
    """Lateness of each frame start [s]."""
    cost: list[float]
    """Time of the caller to hand over a frame [s]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("session", type=Path)
    parser.add_argument("--folder", type=Path, help="where to write; by default a temporary folder")
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each run of the second table")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each setting, in turns")


def run(options: argparse.Namespace) -> Report:
    """Measure size and work of each setting, and a timer with and without recording."""
    report = Report("Recording")
    try:
        frames = _frames(_load(options.session))
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            _measure_size(report, frames, Path(folder), options.rate)
            _measure_timer(report, frames, Path(folder), options)
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


def _measure_timer(
    report: Report, frames: Sequence[Sequence[Message]], folder: Path, options: argparse.Namespace
) -> None:
    rate, seconds = options.rate, options.seconds
    settings: tuple[Compression | None, ...] = (None, "none", "lz4", "zstd")
    timings: dict[Compression | None, _Timing] = {setting: _Timing([], []) for setting in settings}
    dropped = dict.fromkeys(settings, 0)
    # In turns, so that background load affects all settings alike.
    for _ in range(options.rounds):
        for setting in settings:
            recorder = None
            if setting is not None:
                recording = RecorderOptions(writer=dataclasses.replace(WriterOptions(), compression=setting))
                recorder = Recorder(folder, snapshot=_SNAPSHOT, log_time=0, options=recording)
                recorder.wait_until_open()
            _run_timer(frames, recorder, rate, int(seconds * rate), timings[setting])
            if recorder is not None:
                status = recorder.close(timeout=60.0)
                dropped[setting] += status.dropped
                if status.path is not None:
                    status.path.unlink()
    columns = ["recording", "late median", "late p99", "late most", "handing over median", "p99", "most", "dropped"]
    table = report.add_table(f"{options.rounds} x {seconds:g} s at {rate:g} Hz, microseconds", columns)
    for setting in settings:
        late, cost = (np.array(values) * 1e6 for values in timings[setting])
        percentiles = [*np.percentile(late, (50, 99, 100)), *np.percentile(cost, (50, 99, 100))]
        table.rows.append([setting or "no", *(round(value) for value in percentiles), dropped[setting]])


def _run_timer(
    frames: Sequence[Sequence[Message]], recorder: Recorder | None, rate: float, count: int, timing: _Timing
) -> None:
    start = time.perf_counter() + 0.1
    for index in range(count):
        deadline = start + index / rate
        time.sleep(max(deadline - time.perf_counter(), 0.0))
        began = time.perf_counter()
        frame = frames[index % len(frames)]
        # Fresh bytes, as from a serializer, are not in the caches.
        fresh = [bytes(memoryview(message.data)) for message in frame]
        handed = time.perf_counter()
        if recorder is not None:
            for message, data in zip(frame, fresh, strict=True):
                is_cloud = message.topic.endswith("/points")
                recorder.record(message.topic, message.type_name, data, log_time=index, droppable=is_cloud)
        timing.cost.append(time.perf_counter() - handed)
        timing.late.append(began - deadline)
