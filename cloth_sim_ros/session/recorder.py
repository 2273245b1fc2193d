# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Non-blocking recorder: a bounded queue and a writer thread."""

from __future__ import annotations

import contextlib
import datetime
import errno
import secrets
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from cloth_sim_ros.session.channel_description import Qos
from cloth_sim_ros.session.errors import RecordingError, SessionError
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.session.recorder_options import RecorderOptions, RecorderState, RecorderStatus
from cloth_sim_ros.session.storage import AppendFile
from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter

_POLL_SECONDS = 0.01
"""Poll interval of an idle recorder [s]. Waking its thread for each message would cost the caller more than the call
itself, and both threads would compete for the interpreter when a frame is due."""
_ITEM_OVERHEAD = 400
"""Python's memory overhead of a queued message, an upper estimate [bytes]."""

_RECORDING_ERRORS = (OSError, MemoryError, ImportError, SessionError)
"""Errors that end a recording: the disk, limits of the machine, and modules that cannot be loaded because of them."""
_REMEDIES = {
    errno.EMFILE: "; this process has too many open: raise its limit (ulimit -n)",
    errno.ENFILE: "; the machine has too many open: end other processes",
    errno.ENOSPC: "; make room, or set record.folder",
}
_MAX_TIME = 1 << 63
_CLOCK_JUMP = 1_000_000_000
"""Minimum step back of the log time that counts as a clock jump; smaller ones come from the order of callbacks [ns]."""


class _QueuedMessage(NamedTuple):
    topic: str
    type_name: str
    data: bytes
    log_time: int
    publish_time: int
    sequence: int
    qos: Qos | None


@dataclass(frozen=True, slots=True)
class _Split:
    snapshot: SessionSnapshot
    log_time: int
    dropped: int
    """Messages dropped since the recording began, up to the split."""


@dataclass(frozen=True, slots=True)
class _Stop:
    reason: str
    dropped: int
    error: str = ""


def session_stem(name: str, start: datetime.datetime) -> str:
    """Return the stem of a session's files from name and start time, e.g. ``cloth_sim_2026-11-21T05-14-00``."""
    return f"{name}_{start:%Y-%m-%dT%H-%M-%S}"


class Recorder:
    """Recorder of a session by its own thread: `record` and `split`, from any thread, only append to a queue.

    The recorder's thread does all disk work, including the creation of the file. If the disk is too slow, droppable
    messages are dropped and counted; the others are queued in at most ``backlog_bytes`` of memory. A disk error ends
    the recording and shows in `status`; the written part stays intact. The caller of `record` sees no exception.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        snapshot: SessionSnapshot,
        log_time: int,
        stem: str | None = None,
        options: RecorderOptions | None = None,
        open_file: Callable[[Path, str, str], AppendFile] = AppendFile,
    ) -> None:
        """Start recording into a new file in `folder` (created if absent); see `wait_until_open` for errors.

        `log_time` [ns]: time of the snapshot. `stem`: file name; by default ``cloth_sim_<start in UTC>``.
        Raises RecordingError if no thread can be started.
        """
        self._folder = Path(folder)
        self._options = options or RecorderOptions()
        self._open_file = open_file
        self._stem = stem or session_stem("cloth_sim", datetime.datetime.now(datetime.UTC))
        # The stem has a resolution of one second; the session's identifier is unique.
        self._session = f"{self._stem}_{secrets.token_hex(4)}"
        self._queue: deque[_QueuedMessage | _Split | _Stop] = deque()
        # Each counter has one writing thread; therefore no lock is needed.
        self._put_count = self._put_bytes = 0
        self._popped_count = self._popped_bytes = 0
        self._dropped = 0
        self._sequences: dict[str, int] = {}
        self._last_log_time = 0
        self._put_lock = threading.Lock()
        self._requested_splits = 0
        self._full_part = -1
        """Index of the newest part that has reached its limit."""
        self._is_stopping = False
        self._failure = ""
        self._opened = threading.Event()
        self._wake = threading.Event()
        """Set to make the recorder's thread read the queue at once."""
        self._status = RecorderStatus(
            state="opening", path=None, bytes_written=0, messages=0, dropped=0, queue_depth=0, queue_bytes=0, error=""
        )
        self._part = 0
        self._dropped_before = 0
        """Messages dropped before the current file began."""
        self._finished_bytes = self._finished_messages = 0
        self._latched: dict[str, _QueuedMessage] = {}
        self._thread = threading.Thread(target=self._run, args=(snapshot, log_time), name="recorder", daemon=True)
        try:
            self._thread.start()
        except (RuntimeError, MemoryError) as error:
            reason = str(error) or "no memory is left"
            remedy = "end other processes, or raise this one's limits of threads and memory (ulimit -u, ulimit -v)"
            raise RecordingError(f"cannot record into {self._folder}: {reason}; {remedy}") from error

    def wait_until_open(self, timeout: float = 10.0) -> Path:
        """Wait at most `timeout` [s] for the first file; return its path. Raises RecordingError with the reason."""
        if not self._opened.wait(timeout):
            raise RecordingError(f"{self._folder} did not take a new file within {timeout:g} s; is its disk stuck?")
        status = self.status()
        if status.path is None:
            raise RecordingError(status.error)
        return status.path

    def record(
        self,
        topic: str,
        type_name: str,
        data: bytes,
        *,
        log_time: int,
        publish_time: int | None = None,
        droppable: bool,
        qos: Qos | None = None,
    ) -> bool:
        """Queue a message (CDR bytes) without blocking. Return False if it was dropped or the recording has ended.

        Times are nanoseconds since the epoch (otherwise ValueError). `publish_time` is `log_time` by default. A log
        time less than a second before the last one is raised to it: sorting by log time keeps the order of recording.
        Larger clock jumps stay. `qos` is read with the first message of a topic. Each further file begins with the
        newest message of each transient local topic.
        """
        if publish_time is None:
            publish_time = log_time
        if not (0 <= log_time < _MAX_TIME and 0 <= publish_time < _MAX_TIME):
            raise ValueError(f"log time {log_time}, publish time {publish_time}: expected nanoseconds in [0, 2^63)")
        with self._put_lock:
            if self._is_stopping or self._status.state in ("failed", "closed"):
                return False
            log_time = self._monotonic_time(log_time)
            # Dropped messages count too, so that gaps show in the file.
            sequence = self._sequences.get(topic, 0)
            self._sequences[topic] = sequence + 1
            queued_bytes = self._put_bytes - self._popped_bytes
            if droppable and queued_bytes + len(data) > self._options.queue_bytes:
                self._dropped += 1
                return False
            if queued_bytes + len(data) > self._options.backlog_bytes:
                self._fail_on_backlog(queued_bytes)
                return False
            self._put(_QueuedMessage(topic, type_name, data, log_time, publish_time, sequence, qos))
            return True

    def _monotonic_time(self, log_time: int) -> int:
        if 0 < self._last_log_time - log_time < _CLOCK_JUMP:
            return self._last_log_time
        self._last_log_time = log_time
        return log_time

    @property
    def wants_split(self) -> bool:
        """True if the file has reached its limit: call `split` with a snapshot at the next frame boundary."""
        return self._full_part == self._requested_splits and not self._is_stopping

    def split(self, snapshot: SessionSnapshot, *, log_time: int) -> None:
        """Queue the change to a new file that opens with this snapshot, without blocking; ignored after the end."""
        with self._put_lock:
            if not self._is_stopping and self._status.state != "failed":
                self._requested_splits += 1
                self._put(_Split(snapshot, self._monotonic_time(log_time), self._dropped))

    def fail(self, reason: str) -> None:
        """End the recording after the queued messages, as failed; never blocks."""
        with self._put_lock:
            if not self._is_stopping and self._status.state != "failed":
                self._fail_with(reason)

    def status(self) -> RecorderStatus:
        """Return the current status of the recording."""
        queue_depth = self._put_count - self._popped_count
        queue_bytes = self._put_bytes - self._popped_bytes
        status = replace(self._status, dropped=self._dropped, queue_depth=queue_depth, queue_bytes=queue_bytes)
        if self._failure and status.state != "failed":
            return replace(status, state="failed", error=self._failure)
        if status.state in ("opening", "recording") and not self._thread.is_alive():
            # Read the status again: the thread may have ended properly in between.
            state = self._status.state
            if state in ("opening", "recording"):
                cause = "the recorder's thread ended unexpectedly, see its traceback"
                return replace(status, state="failed", error=cause)
            return self.status()
        return status

    def close(self, *, timeout: float = 10.0, reason: str = "stopped") -> RecorderStatus:
        """Write the queued messages, finish the file, and return the status; waits at most `timeout` [s]. Repeatable.

        If the disk is stuck for longer than `timeout` [s], the file stays intact but unfinished.
        """
        with self._put_lock:
            if not self._is_stopping and self._status.state != "failed":
                # In this order: an interruption between the two must not leave a thread without a stop request.
                self._put(_Stop(reason, self._dropped))
                self._is_stopping = True
        self._wake.set()
        self._thread.join(timeout)
        status = self.status()
        if self._thread.is_alive():
            message = f"{pluralize(status.queue_depth, 'message')} not written within {timeout:g} s; is the disk stuck?"
            return replace(status, state="failed", error=message)
        return status

    def _fail_on_backlog(self, queued_bytes: int) -> None:
        """End the recording as failed after the queued messages, because the queue has reached its limit."""
        backlog = f"{queued_bytes >> 20} MiB waited to be written, the limit is {self._options.backlog_bytes >> 20} MiB"
        self._fail_with(f"{backlog}: the disk of {self._folder} is stuck or too slow")

    def _fail_with(self, reason: str) -> None:
        self._failure = reason
        self._put(_Stop(self._failure, self._dropped, self._failure))
        self._is_stopping = True

    def _put(self, item: _QueuedMessage | _Split | _Stop) -> None:
        self._put_count += 1
        self._put_bytes += _memory_bytes(item)
        self._queue.append(item)

    # The methods below run in the recorder's thread.

    def _run(self, snapshot: SessionSnapshot, log_time: int) -> None:
        try:
            writer = self._new_writer(snapshot, log_time, 0)
        except _RECORDING_ERRORS as error:
            with self._put_lock:
                self._status = replace(self._status, state="failed", error=_describe_error(error, self._folder))
                self._empty_queue()
            self._opened.set()
            return
        self._update_status(writer, "recording")
        self._opened.set()
        self._write_until_stopped(writer)

    def _write_until_stopped(self, writer: SessionWriter) -> None:
        while True:
            try:
                item = self._next_item(writer)
                if isinstance(item, _QueuedMessage):
                    self._write(writer, item)
                elif isinstance(item, _Split):
                    writer = self._open_next_file(writer, item)
                elif isinstance(item, _Stop):
                    writer.finish(reason=item.reason, notes=self._end_notes(item.dropped))
                    self._update_status(writer, "failed" if item.error else "closed", item.error)
                    return
                writer.maintain()
            except _RECORDING_ERRORS as error:
                self._abort(writer, error)
                return
            self._update_status(writer, "recording")
            if self._is_full(writer):
                self._full_part = self._part

    def _next_item(self, writer: SessionWriter) -> _QueuedMessage | _Split | _Stop | None:
        """Remove and return the oldest queued item; None after a wait of at most 10 ms without one."""
        try:
            item = self._queue.popleft()
        except IndexError:
            due = writer.seconds_until_due()
            self._wake.wait(_POLL_SECONDS if due is None else min(max(due, 0.0), _POLL_SECONDS))
            return None
        self._popped_count += 1
        self._popped_bytes += _memory_bytes(item)
        return item

    def _write(self, writer: SessionWriter, item: _QueuedMessage) -> None:
        if not writer.is_declared(item.topic):
            writer.declare(item.topic, item.type_name, item.qos)
            if item.qos is not None and item.qos.durability == "transient_local":
                self._latched[item.topic] = item
        if item.topic in self._latched:
            self._latched[item.topic] = item._replace(qos=self._latched[item.topic].qos)
        log_time, publish_time = item.log_time, item.publish_time
        writer.add(item.topic, item.data, log_time=log_time, publish_time=publish_time, sequence=item.sequence)

    def _open_next_file(self, writer: SessionWriter, split: _Split) -> SessionWriter:
        # The new file first: a follower looks for it as soon as the old one ends with the reason "split".
        next_writer = self._new_writer(split.snapshot, split.log_time, self._part + 1)
        try:
            writer.finish(reason="split", notes=self._end_notes(split.dropped))
        except _RECORDING_ERRORS:
            next_writer.finish(reason="the file before it could not be finished")
            raise
        self._part += 1
        self._dropped_before = split.dropped
        self._finished_bytes += writer.bytes_written
        self._finished_messages += writer.message_count
        for item in list(self._latched.values()):
            self._write(next_writer, item._replace(log_time=split.log_time))
        return next_writer

    def _new_writer(self, snapshot: SessionSnapshot, log_time: int, part: int) -> SessionWriter:
        return SessionWriter(
            self._folder,
            snapshot=snapshot,
            stem=self._stem,
            session=self._session,
            part=part,
            log_time=log_time,
            options=self._options.writer,
            open_file=self._open_file,
        )

    def _is_full(self, writer: SessionWriter) -> bool:
        size, seconds = self._options.split_bytes, self._options.split_seconds
        return bool(size and writer.bytes_written >= size) or bool(seconds and writer.session_seconds >= seconds)

    def _abort(self, writer: SessionWriter, error: Exception) -> None:
        message = _describe_error(error, writer.path)
        # Writing the failed chunk fails again. The file is finished or, at worst, intact.
        with contextlib.suppress(*_RECORDING_ERRORS):
            writer.finish(reason=message, notes=self._end_notes(self._dropped))
        with self._put_lock:
            self._update_status(writer, "failed", message)
            self._empty_queue()

    def _empty_queue(self) -> None:
        """Release the memory of items that can no longer be written."""
        with contextlib.suppress(IndexError):
            while True:
                item = self._queue.popleft()
                self._popped_count += 1
                self._popped_bytes += _memory_bytes(item)

    def _end_notes(self, dropped: int) -> dict[str, str]:
        """Return the end record's note on messages dropped in the current file. `dropped`: number in all files."""
        return {"dropped": str(dropped - self._dropped_before)}

    def _update_status(self, writer: SessionWriter, state: RecorderState, error: str = "") -> None:
        self._status = replace(
            self._status,
            state=state,
            path=writer.path,
            bytes_written=self._finished_bytes + writer.bytes_written,
            messages=self._finished_messages + writer.message_count,
            error=error,
        )


def _memory_bytes(item: _QueuedMessage | _Split | _Stop) -> int:
    if isinstance(item, _QueuedMessage):
        return len(item.data) + _ITEM_OVERHEAD
    return len(item.snapshot.state) + _ITEM_OVERHEAD if isinstance(item, _Split) else _ITEM_OVERHEAD


def _describe_error(error: Exception, path: Path) -> str:
    if isinstance(error, OSError):
        remedy = _REMEDIES.get(error.errno or 0, "")
        return f"cannot write {path}: {error.strerror or error}{remedy}"
    if isinstance(error, MemoryError):
        return f"cannot write {path}: no memory is left; end other processes, or give this one more"
    if isinstance(error, ImportError):
        return f"cannot write {path}: {error}"
    return str(error)
