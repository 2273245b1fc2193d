# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of a session of one or several files, finished or not."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message, SessionPart

if TYPE_CHECKING:
    from cloth_sim_ros.session.cdr import Cloud, MeshMessage

#: Reason of the end of a file that another one of the session follows.
SPLIT = "split"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedCloud:
    """Cloud with the record of its frame (None if that is missing) and its log time [ns]."""

    frame: FrameRecord | None
    """None if the frame's record is missing."""
    cloud: Cloud
    log_time: int
    """Nanoseconds since the epoch."""


class SessionReader:
    """Reader of a session's files as a stream, a context manager, with one chunk in memory at a time.

    Messages come in the order of recording. Damaged chunks are skipped and reported in `missing`, or raised as
    DamagedSessionError if `strict`. No message of a chunk with a wrong checksum is returned.
    """

    def __init__(self, path: Path | str | Sequence[Path | str], *, strict: bool = False) -> None:
        """Open one file, or the files of one split session in their order. Raises SessionError with the reason."""
        paths = [path] if isinstance(path, Path | str) else list(path)
        if not paths:
            raise SessionError("no session file was given")
        parts: list[SessionPart] = []
        try:
            for file_path in paths:
                parts.append(SessionPart(file_path, strict=strict))
            _check_order(parts)
        except BaseException:
            for part in parts:
                part.close()
            raise
        self._parts = parts
        self._strict = strict

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        for part in self._parts:
            part.close()

    @property
    def parts(self) -> tuple[SessionPart, ...]:
        """The files, each with its opening snapshot."""
        return tuple(self._parts)

    @property
    def metadata(self) -> Mapping[str, str]:
        """Versions, machine, node, period ... of the first file."""
        return self._parts[0].metadata

    @property
    def scene_yaml(self) -> str:
        """Effective parameters at the first file's beginning, as a ROS parameter file. Raises UnicodeDecodeError."""
        return self._parts[0].scene_yaml

    @property
    def state(self) -> bytes:
        """Full state before the first frame, as the bytes of an .npz."""
        return self._parts[0].state

    @property
    def files(self) -> Mapping[str, bytes]:
        """Contents (bytes) of the files that parameters name, such as a mesh, by that name."""
        return self._parts[0].files

    @property
    def node(self) -> str:
        """Resolved name of the node, the prefix of its topics."""
        return self.metadata.get("node", "/cloth_sim")

    @property
    def complete(self) -> bool:
        """True if every file is finished and no damage was found so far."""
        return all(part.finished and not part.damage for part in self._parts)

    @property
    def missing(self) -> str | None:
        """Deficits found so far, in one sentence; None if there are none."""
        deficits = [sentence for part in self._parts if (sentence := part.missing()) is not None]
        return "; ".join(deficits) or None

    def with_missing(self, cause: str) -> str:
        """Return the cause of an error with the deficits found so far, which may explain it."""
        return "; ".join(part for part in (cause, self.missing) if part)

    def messages(
        self, topics: Iterable[str] | None = None, *, start: int | None = None, end: int | None = None
    ) -> Iterator[Message]:
        """Yield messages from the session's start, in order: of all or some topics, log times in [start, end) [ns]."""
        selected_topics = None if topics is None else frozenset(topics)
        for part in self._parts:
            part.rewind()
            yield from part.messages(topics=selected_topics, start=start, end=end)

    def frames(self, *, start: int | None = None, end: int | None = None) -> Iterator[FrameRecord]:
        """Yield the frame records with log times in [start, end) [ns]. Raises SessionError for an invalid record."""
        for message in self.messages([f"{self.node}/frame"], start=start, end=end):
            yield read_frame(message)

    def clouds(self, *, start: int | None = None, end: int | None = None) -> Iterator[RecordedCloud]:
        """Yield the clouds with log times in [start, end) [ns], each with its frame's record, if that precedes it."""
        topics = [f"{self.node}/frame", f"{self.node}/points"]
        yield from pair_clouds(self.messages(topics, start=start, end=end), self.node)

    def topology(self) -> MeshMessage | None:
        """Return triangles and rest shape from the first topology message; None if the session holds none."""
        from cloth_sim_ros.session.cdr import decode_mesh

        for message in self.messages([f"{self.node}/topology"]):
            return decode_mesh(message.data)
        return None

    def follow(
        self, topics: Iterable[str] | None = None, *, poll: float = 0.1, keep_waiting: Callable[[], bool] = lambda: True
    ) -> Iterator[Message]:
        """Yield the messages of a session during its recording: existing ones, then new ones; blocks until it ends.

        Polls the file every `poll` seconds and opens further files of a split session when they appear. Ends with the
        recording, with the death of its process, or if `keep_waiting` returns False.
        """
        selected_topics = None if topics is None else frozenset(topics)
        for part in self._parts:
            part.rewind()
        index = 0
        while True:
            part = self._parts[index]
            # Checked before reading, so that this pass reads everything that a writer wrote before it ended.
            is_recording = part.is_being_written()
            yield from part.messages(topics=selected_topics)
            if index + 1 < len(self._parts):
                index += 1
            elif part.at_end:
                next_part = _open_next_part(part, strict=self._strict)
                if next_part is None:
                    return
                self._parts.append(next_part)
                index += 1
            elif not is_recording or not keep_waiting():
                return
            else:
                time.sleep(poll)


def read_frame(message: Message) -> FrameRecord:
    """Decode the frame record in a message of the ``<node>/frame`` channel. Raises SessionError if it is invalid."""
    from cloth_sim_ros.session.cdr import decode_string

    return FrameRecord.from_json(decode_string(message.data))


def pair_clouds(messages: Iterable[Message], node: str) -> Iterator[RecordedCloud]:
    """Yield a `RecordedCloud` for each cloud, with the frame record before it if their publish times are equal."""
    from cloth_sim_ros.session.cdr import decode_cloud

    frame: Message | None = None
    for message in messages:
        if message.topic == f"{node}/frame":
            frame = message
        elif message.topic == f"{node}/points":
            is_same_frame = frame is not None and frame.publish_time == message.publish_time
            frame_record = read_frame(frame) if is_same_frame and frame is not None else None
            cloud = decode_cloud(message.data)
            yield RecordedCloud(frame=frame_record, cloud=cloud, log_time=message.log_time)


def _check_order(parts: Sequence[SessionPart]) -> None:
    first = parts[0]
    for before, after in itertools.pairwise(parts):
        if after.session != first.session:
            sessions = f"belongs to session {after.session}, {first.path} to {first.session}"
            raise SessionError(f"{after.path} {sessions}; give the files of one session at a time")
        if after.index != before.index + 1:
            order = f"is part {after.index} of its session and follows part {before.index}"
            raise SessionError(f"{after.path} {order}; give all parts, in order")


def session_files(path: Path | str) -> list[Path]:
    """Return all files of a file's session in its folder, in order. Raises SessionError if it is not a session.

    Raises SessionError if the file is not a session.
    """
    with contextlib.closing(SessionPart(path)) as first_part:
        paths = {first_part.index: first_part.path}
        for sibling in _siblings(first_part):
            paths.setdefault(sibling.index, sibling.path)
            sibling.close()
    return [paths[index] for index in sorted(paths)]


def by_session(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Yield lists of consecutive files of one session each, in the given order.

    An unreadable file forms its own group; reading it later raises the reason.
    """
    group: list[Path] = []
    next_key: tuple[str, int] | None = None
    for path in paths:
        try:
            with contextlib.closing(SessionPart(path)) as part:
                part_key = (part.session, part.index)
        except SessionError:
            part_key = None
        if group and (part_key is None or part_key != next_key):
            yield group
            group = []
        group.append(path)
        next_key = None if part_key is None else (part_key[0], part_key[1] + 1)
    yield group


def absent_files(paths: Sequence[Path], *, whole: bool) -> list[str]:
    """Return a sentence for each gap between the given files of a split session, which is not among them.

    Args:
        paths: files of one session or of several. Unreadable ones are left out.
        whole: True to miss also the files before the first and after the last one.
    """
    sessions: dict[str, dict[int, tuple[Path, bool]]] = {}
    for path in paths:
        with contextlib.suppress(SessionError), contextlib.closing(SessionPart(path)) as part:
            is_split = part.end_notes.get("reason") == SPLIT
            sessions.setdefault(part.session, {})[part.index] = path, is_split
    sentences = []
    for files in sessions.values():
        indices = sorted(files)
        before = [-1, *indices] if whole else indices
        for previous, index in itertools.pairwise(before):
            if index > previous + 1:
                absent = f"part {previous + 1} to {index - 1}" if index > previous + 2 else f"part {previous + 1}"
                sentences.append(f"{absent} of the session, before {files[index][0]}, is not among its files")
        last, is_split = files[indices[-1]]
        if whole and is_split:
            sentences.append(f"part {indices[-1] + 1} of the session, after {last}, is not among its files")
    return sentences


def _open_next_part(part: SessionPart, *, strict: bool) -> SessionPart | None:
    """Open the file that continues a split part; None if the part did not end by a split, or the file is absent."""
    if part.end_notes.get("reason") != SPLIT:
        return None
    next_part = None
    for sibling in _siblings(part):
        if sibling.index == part.index + 1 and next_part is None:
            next_part = SessionPart(sibling.path, strict=strict)
        sibling.close()
    return next_part


def _siblings(part: SessionPart) -> Iterator[SessionPart]:
    """Yield open readers of the session's other files in the same folder; the caller closes them."""
    for path in sorted(part.path.parent.glob(f"*{part.path.suffix}")):
        if path == part.path:
            continue
        try:
            sibling = SessionPart(path)
        except SessionError:
            # The folder may hold other files.
            continue
        if sibling.session == part.session:
            yield sibling
        else:
            sibling.close()
