# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs of a replay: viewer, Rerun recording, picture."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.replay.accuracy import Accuracy, measure
from cloth_sim_ros.replay.blueprint import blueprint_of
from cloth_sim_ros.replay.plots import ACCURACY
from cloth_sim_ros.replay.stream import Stream
from cloth_sim_ros.replay.survey import Survey, survey
from cloth_sim_ros.replay.viewer import check_screen, open_window, save_screenshot
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.outputs import written_whole
from cloth_sim_ros.session.reader import SessionReader

if TYPE_CHECKING:
    import rerun as rr

    from cloth_sim_ros.session.part import Message

APPLICATION = "cloth_sim"
#: Poll interval of a session that is being recorded [s].
_POLL = 0.05


def save_recording(
    paths: Sequence[Path],
    out: Path,
    *,
    every: int = 1,
    strain_limit: float | None = None,
    follow: bool = False,
    accuracy: bool = False,
) -> None:
    """Write a session as a Rerun recording. Raises SessionError or OSError with the reason.

    The file appears when it is complete; with `follow` it appears at once and grows.
    """
    with SessionReader(list(paths)) as reader, contextlib.ExitStack() as stack:
        seen = _look(reader, strain_limit, follow)
        place = out if follow else stack.enter_context(written_whole(out))
        seen, measured = stack.enter_context(_measured(paths, seen, accuracy))
        recording = _recording(reader)
        recording.save(place, default_blueprint=blueprint_of(seen))
        _play(reader, Stream(recording, seen, node=reader.node, every=every, accuracy=measured), follow)
        recording.disconnect()
        _tell_missing(reader)


def open_viewer(
    paths: Sequence[Path],
    *,
    every: int = 1,
    strain_limit: float | None = None,
    follow: bool = False,
    accuracy: bool = False,
) -> None:
    """Show a session in a viewer's window. Raises SessionError, or ViewerError without a screen."""
    check_screen()
    with SessionReader(list(paths)) as reader, contextlib.ExitStack() as stack:
        seen = _look(reader, strain_limit, follow)
        seen, measured = stack.enter_context(_measured(paths, seen, accuracy))
        recording = _recording(reader)
        recording.connect_grpc(open_window(), default_blueprint=blueprint_of(seen, following=follow))
        _play(reader, Stream(recording, seen, node=reader.node, every=every, accuracy=measured), follow)
        recording.disconnect()
        _tell_missing(reader)


def save_picture(
    paths: Sequence[Path],
    out: Path,
    *,
    at: float | None = None,
    size: tuple[int, int] = (1600, 900),
    strain_limit: float | None = None,
    accuracy: bool = False,
) -> None:
    """Save a picture of a session at a simulated time [s]; by default at the end.

    Raises:
        SessionError: if the session cannot be shown, with the reason.
        ViewerError: if the viewer cannot render.
        OSError: if the picture cannot be written.
    """
    with (
        SessionReader(list(paths)) as reader,
        tempfile.TemporaryDirectory(prefix="cloth_replay_") as folder,
        contextlib.ExitStack() as stack,
    ):
        seen = survey(reader, strain_limit=strain_limit)
        picture = stack.enter_context(written_whole(out))
        seen, measured = stack.enter_context(_measured(paths, seen, accuracy))
        rrd = Path(folder) / "picture.rrd"
        recording = _recording(reader)
        recording.save(rrd, default_blueprint=blueprint_of(seen, picture=True))
        only = math.inf if at is None else at
        stream = Stream(recording, seen, node=reader.node, only=only, accuracy=measured)
        _play(reader, stream, follow=False)
        recording.disconnect()
        _tell_missing(reader)
        if not stream.clouds_seen:
            raise SessionError(f"{paths[0]} holds no clouds: there is nothing to draw")
        save_screenshot(rrd, picture, at=stream.time if at is None else at, size=size)


@contextlib.contextmanager
def _measured(paths: Sequence[Path], seen: Survey, wanted: bool) -> Iterator[tuple[Survey, Accuracy | None]]:
    """Yield the scan and, if requested, the accuracy, whose files exist until the end of the context."""
    if not wanted:
        yield seen, None
        return
    with tempfile.TemporaryDirectory(prefix="cloth_replay_") as folder:
        measured = measure(paths, Path(folder), len(seen.opening.positions))
        yield dataclasses.replace(seen, plots=ACCURACY, error_limit=measured.limit), measured


def _look(reader: SessionReader, strain_limit: float | None, follow: bool) -> Survey:
    if follow:
        _wait_for_surface(reader)
    return survey(reader, strain_limit=strain_limit, followed=follow)


def _wait_for_surface(reader: SessionReader) -> None:
    """Wait for the topology: a new recording has not written its first chunk yet."""
    while reader.topology() is None and reader.parts[-1].is_being_written():
        time.sleep(_POLL)


def _play(reader: SessionReader, stream: Stream, follow: bool) -> None:
    if not follow:
        stream.add_all(_with_progress(reader, reader.messages(stream.topics)))
        return

    def keep_waiting() -> bool:
        stream.flush()
        return True

    try:
        stream.add_all(reader.follow(stream.topics, poll=_POLL, keep_waiting=keep_waiting))
    except KeyboardInterrupt:
        stream.finish()


def _with_progress(reader: SessionReader, messages: Iterator[Message]) -> Iterator[Message]:
    """Yield the messages and show a progress bar of the bytes read, on a terminal and after one second."""
    from tqdm import tqdm

    total = sum(part.size() for part in reader.parts)
    with tqdm(total=total, unit="B", unit_scale=True, desc="replay", delay=1.0, disable=None) as bar:
        for message in messages:
            yield message
            read = sum(part.position for part in reader.parts)
            if read > bar.n:
                bar.update(read - bar.n)


def _recording(reader: SessionReader) -> rr.RecordingStream:
    import rerun as rr

    # Without strict mode, rerun only warns about an error, and the recording lacks the rows.
    rr.set_strict_mode(True)
    recording = rr.RecordingStream(APPLICATION)
    recording.send_recording_name(reader.parts[0].session)
    return recording


def _tell_missing(reader: SessionReader) -> None:
    if reader.missing:
        print(f"cloth_replay: {reader.missing}", file=sys.stderr)
