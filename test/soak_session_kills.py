# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kills of recording processes at random times, and checks of their files.

    python test/soak_session_kills.py --count 500

Each child records like a node, with random splits and stops, and counts the queued messages in shared memory. After
SIGKILL every file in its folder must open. Its messages must be recorded ones, in order and without a gap. Only
messages of the last second may be missing.
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from support import session_samples as samples

from cloth_sim_ros.session import cdr
from cloth_sim_ros.session.channel_description import standard_types
from cloth_sim_ros.session.reader import SessionReader, session_files
from cloth_sim_ros.session.recorder import Recorder, RecorderOptions
from cloth_sim_ros.session.recover import recover
from cloth_sim_ros.session.writer import WriterOptions

LIMIT = 20_000
NOTE = struct.Struct("<QQ")
"""Index of the session and its number of queued frames, followed by the time of each frame of the child [ns]."""


def record(folder: Path, seed: int, notes: mmap.mmap) -> None:
    """Record sessions in the child process until it is killed."""
    generator = random.Random(seed)
    points = generator.choice([10, 900, 16_000])
    # Some children mostly begin, end or split sessions, so that kills hit these operations.
    lengths = generator.choice([[1], [1, 50, 300], [LIMIT]])
    splits = generator.choice([[0.0], [0.02], [0.0, 0.1, 0.3]])
    frame = 0
    while True:
        options = RecorderOptions(
            writer=WriterOptions(
                compression=generator.choice(["none", "lz4", "zstd"]),  # type: ignore[arg-type]
                sync_seconds=generator.choice([0.0, 0.3]),
            ),
            split_seconds=generator.choice(splits),
        )
        recorder = Recorder(folder, snapshot=samples.SNAPSHOT, log_time=time.monotonic_ns(), options=options)
        for _ in range(generator.choice(lengths)):
            now = time.monotonic_ns()
            NOTE.pack_into(notes, NOTE.size * frame, frame, now)
            text = samples.frame_record(frame).to_json()
            recorder.record(
                samples.FRAME, "std_msgs/msg/String", cdr.encode_string(text), log_time=now, droppable=False
            )
            cloud = samples.cloud(samples.positions(frame, points), now)
            recorder.record(samples.POINTS, "sensor_msgs/msg/PointCloud2", cloud, log_time=now, droppable=False)
            if recorder.wants_split:
                recorder.split(samples.SNAPSHOT, log_time=now)
            frame += 1
            time.sleep(1 / 240)
        recorder.close()


def check(folder: Path, notes: mmap.mmap, killed: int, within: float) -> tuple[str, float]:
    """Check the child's files; return the state of the last one and the missing time at its end [s]."""
    files = sorted(folder.glob("*.mcap"))
    sessions = sorted({tuple(session_files(path)) for path in files}, key=lambda paths: _first_frame(paths))
    expected = 0
    for paths in sessions:
        with SessionReader(paths) as reader:
            for recorded in reader.clouds():
                assert recorded.frame is not None, f"{paths}: a cloud without its frame"
                frame_index = recorded.frame.frame
                assert frame_index == expected, f"{paths}: frame {frame_index} where {expected} was recorded"
                assert recorded.frame == samples.frame_record(frame_index)
                assert recorded.log_time == NOTE.unpack_from(notes, NOTE.size * frame_index)[1]
                assert np.array_equal(recorded.cloud.xyz, samples.positions(frame_index, len(recorded.cloud.xyz)))
                expected += 1
            damage = [sentence for part in reader.parts for sentence in part.damage]
            assert not damage, damage
    handed = [
        NOTE.unpack_from(notes, NOTE.size * frame_index)[1]
        for frame_index in range(expected, LIMIT)
        if NOTE.unpack_from(notes, NOTE.size * frame_index)[1]
    ]
    missing_seconds = (killed - handed[0]) * 1e-9 if handed else 0.0
    assert missing_seconds <= within, f"what was handed over {missing_seconds:.3f} s before the kill is missing"
    state = "nothing visible yet"
    for paths in sessions:
        for path in paths:
            with SessionReader(path) as reader:
                list(reader.messages())
                state = "finished" if reader.complete else "unfinished"
            if state == "unfinished":
                mended = recover(path, path.with_name("mended.mcap"))
                with SessionReader(mended.path, strict=True) as reader:
                    list(reader.messages())
                    assert reader.complete
                mended.path.unlink()
    return state, missing_seconds


def _first_frame(paths: tuple[Path, ...]) -> float:
    with SessionReader(list(paths)) as reader:
        return next((frame.frame for frame in reader.frames()), float("inf"))


def main() -> int:
    """Run the kills; return 0 on success."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=float, default=2.0, help="latest time of the kill [s]")
    parser.add_argument("--within", type=float, default=1.0, help="maximum missing time at the end [s]")
    parser.add_argument(
        "--folder", type=Path, help="folder of the recordings; by default the system's temporary folder"
    )
    options = parser.parse_args()
    # Imported once, before the children are forked.
    standard_types()
    states: Counter[str] = Counter()
    worst = 0.0
    leftovers = 0
    for seed in range(options.seed, options.seed + options.count):
        folder = Path(tempfile.mkdtemp(prefix="kill_", dir=options.folder))
        notes = mmap.mmap(-1, NOTE.size * LIMIT)
        wait = random.Random(f"kill {seed}").uniform(0.0, options.longest)
        child = os.fork()
        if child == 0:
            try:
                record(folder, seed, notes)
            finally:
                os._exit(3)
        time.sleep(wait)
        killed = time.monotonic_ns()
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            print(f"kill {seed}: the child ended by itself, status {status}", file=sys.stderr)
            return 1
        try:
            state, missing_seconds = check(folder, notes, killed, options.within)
        except Exception as error:
            print(f"kill {seed} after {wait:.3f} s, files kept in {folder}: {error!r}", file=sys.stderr)
            return 1
        states[state] += 1
        worst = max(worst, missing_seconds)
        leftovers += len(list(folder.glob(".*")))
        shutil.rmtree(folder)
    print(
        f"{options.count} kills: last file {dict(states)}; at most {worst:.3f} s missing; {leftovers} hidden leftovers"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
