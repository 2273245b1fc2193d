# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs of a replay: viewer, Rerun recording, picture."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.replay.accuracy import MeasuredAccuracy, measure
from cloth_sim_ros.replay.blueprint import make_blueprint
from cloth_sim_ros.replay.plots import ACCURACY
from cloth_sim_ros.replay.pre_scan import PreScan, scan_session
from cloth_sim_ros.replay.stream import ReplayStream
from cloth_sim_ros.replay.viewer import ViewerError, check_screen, open_window, save_screenshot
from cloth_sim_ros.session.console import printable
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.output_files import atomic_write
from cloth_sim_ros.session.reader import SessionReader

if TYPE_CHECKING:
    import rerun as rr

    from cloth_sim_ros.session.part import Message

APPLICATION = "cloth_sim"
#: Poll interval of a session that is being recorded [s].
_POLL = 0.05
#: Space that a recording needs at its beginning [bytes]: the viewer's layout is less.
_MIN_SPACE = 1 << 20
#: Mark at the end of a complete Rerun recording, and the number of bytes from it to the end [bytes].
_END_MARK, _END_SIZE = b"RRF2FOOT", 12


def save_recording(
    paths: Sequence[Path],
    out: Path,
    *,
    every: int = 1,
    strain_limit: float | None = None,
    follow: bool = False,
    accuracy: bool = False,
) -> None:
    """Write a session as a Rerun recording (.rrd); with `follow`, until its end. Raises SessionError or OSError.

    The file appears when it is complete; with `follow` it appears at once and grows.
    """
    with SessionReader(list(paths)) as reader, contextlib.ExitStack() as stack:
        scan = _scan(reader, strain_limit, follow)
        target = out if follow else stack.enter_context(atomic_write(out))
        scan, measured = stack.enter_context(_with_accuracy(paths, scan, accuracy))
        with saved_recording(_recording(reader), target, make_blueprint(scan), name=out) as recording:
            _play(reader, ReplayStream(recording, scan, node=reader.node, every=every, accuracy=measured), follow)
        _print_missing(reader)


def open_viewer(
    paths: Sequence[Path],
    *,
    every: int = 1,
    strain_limit: float | None = None,
    follow: bool = False,
    accuracy: bool = False,
) -> None:
    """Start a Rerun window and send it a session. Raises SessionError, or ViewerError without a screen."""
    with SessionReader(list(paths)) as reader, contextlib.ExitStack() as stack:
        check_screen(
            "use --screenshot out.png for a picture, or --save out.rrd and open that with `rerun` on a machine with a "
            "screen; or a virtual screen: apt-get install xvfb xauth, then xvfb-run cloth_replay"
        )
        scan = _scan(reader, strain_limit, follow)
        scan, measured = stack.enter_context(_with_accuracy(paths, scan, accuracy))
        recording, viewer = _recording(reader), open_window()
        try:
            recording.connect_grpc(viewer.address, default_blueprint=make_blueprint(scan, following=follow))
            _play(reader, ReplayStream(recording, scan, node=reader.node, every=every, accuracy=measured), follow)
            recording.disconnect()
        except RuntimeError as error:
            # Rerun's, from the connection.
            is_closed = viewer.process.poll() is not None
            raise ViewerError(
                "the viewer was closed" if is_closed else f"the viewer does not answer: {error}"
            ) from error
        _print_missing(reader)


def save_picture(
    paths: Sequence[Path],
    out: Path,
    *,
    at: float | None = None,
    size: tuple[int, int] = (1600, 900),
    strain_limit: float | None = None,
    accuracy: bool = False,
) -> None:
    """Write a PNG of a session at a simulated time [s]; by default at the end. Raises SessionError or ViewerError.

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
        scan = scan_session(reader, strain_limit=strain_limit)
        picture = stack.enter_context(atomic_write(out))
        scan, measured = stack.enter_context(_with_accuracy(paths, scan, accuracy))
        rrd = Path(folder) / "picture.rrd"
        with saved_recording(_recording(reader), rrd, make_blueprint(scan, picture=True), name=rrd) as recording:
            last_time = math.inf if at is None else at
            stream = ReplayStream(recording, scan, node=reader.node, last_time=last_time, accuracy=measured)
            _play(reader, stream, follow=False)
        _print_missing(reader)
        if not stream.clouds_seen:
            raise SessionError(f"{paths[0]} holds no clouds: there is nothing to draw")
        # Before the first cloud nothing would be drawn.
        save_screenshot(rrd, picture, at=stream.time if at is None else max(at, stream.shown_time), size=size)


@contextlib.contextmanager
def saved_recording(
    recording: rr.RecordingStream, target: Path, blueprint: object, *, name: Path
) -> Iterator[rr.RecordingStream]:
    """Save what is sent to a recording within the context as a file.

    Rerun writes in a thread of its own. Without space at the beginning it waits forever; at the end it only logs the
    error. Therefore space for the beginning is checked, and the mark at the file's end.

    Args:
        recording: Rerun stream.
        target: path of the file.
        blueprint: layout of the viewer.
        name: path for the error.

    Raises:
        OSError: if the file cannot be written.
    """
    is_file = target.is_file() or not target.exists()
    if is_file:
        try:
            with tempfile.TemporaryFile(dir=target.absolute().parent) as probe:
                os.posix_fallocate(probe.fileno(), 0, _MIN_SPACE)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(name)) from error
    try:
        recording.save(target, default_blueprint=blueprint)
        yield recording
        recording.disconnect()
    except RuntimeError as error:
        raise OSError(errno.EIO, f"cannot be written: {error}", str(name)) from error
    if is_file and not _ends_with_mark(target):
        raise OSError(errno.EIO, "its end could not be written; make room, or name another file", str(name))


def _ends_with_mark(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _END_SIZE))
        return file.read().startswith(_END_MARK)


@contextlib.contextmanager
def _with_accuracy(
    paths: Sequence[Path], scan: PreScan, is_requested: bool
) -> Iterator[tuple[PreScan, MeasuredAccuracy | None]]:
    """Context that measures the accuracy, if requested; yields scan and accuracy, whose files exist within it."""
    if not is_requested:
        yield scan, None
        return
    with tempfile.TemporaryDirectory(prefix="cloth_replay_") as folder:
        measured = measure(paths, Path(folder), len(scan.opening.positions))
        yield dataclasses.replace(scan, plots=ACCURACY, error_limit=measured.limit, deviation_limit=None), measured


def _scan(reader: SessionReader, strain_limit: float | None, follow: bool) -> PreScan:
    if follow:
        _wait_for_surface(reader)
    return scan_session(reader, strain_limit=strain_limit, is_followed=follow)


def _wait_for_surface(reader: SessionReader) -> None:
    """Wait until a session that is being recorded holds its topology."""
    while reader.topology() is None and reader.parts[-1].is_being_written():
        time.sleep(_POLL)


def _play(reader: SessionReader, stream: ReplayStream, follow: bool) -> None:
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


def _print_missing(reader: SessionReader) -> None:
    if reader.missing:
        print(f"cloth_replay: {printable(reader.missing)}", file=sys.stderr)
