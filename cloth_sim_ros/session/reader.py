# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recorded session, of one file or of several, finished or not."""

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
    from cloth_sim_ros.session.cdr import Cloud, Surface


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedCloud:
    """A cloud and the frame it shows."""

    frame: FrameRecord | None
    """None where the frame's record is missing."""
    cloud: Cloud
    log_time: int
    """Nanoseconds since the epoch."""


class SessionReader:
    """Reads a session as a stream: memory holds one chunk at a time, whatever the size of the files.

    Messages are given in the order in which they were recorded. What is damaged is left out and told in `missing` (or
    raised as DamagedSessionError where `strict`); no message is given whose chunk fails its checksum.
    """

    def __init__(self, path: Path | str | Sequence[Path | str], *, strict: bool = False) -> None:
        """Open one file, or the files of one split session in their order. Raises SessionError with the reason."""
        paths = [path] if isinstance(path, Path | str) else list(path)
        if not paths:
            raise SessionError("no session file was given")
        opened: list[SessionPart] = []
        try:
            for item in paths:
                opened.append(SessionPart(item, strict=strict))
            _check_order(opened)
        except BaseException:
            for part in opened:
                part.close()
            raise
        self._parts = opened
        self._strict = strict

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the files back."""
        for part in self._parts:
            part.close()

    @property
    def parts(self) -> tuple[SessionPart, ...]:
        """The files, each with the snapshot it opens with."""
        return tuple(self._parts)

    @property
    def metadata(self) -> Mapping[str, str]:
        """Versions, machine, node, period ... of the first file."""
        return self._parts[0].metadata

    @property
    def scene_yaml(self) -> str:
        """The parameters in force at the first file's snapshot, a ROS parameter file."""
        return self._parts[0].scene_yaml

    @property
    def state(self) -> bytes:
        """The full state before the first frame, the bytes of an .npz."""
        return self._parts[0].state

    @property
    def files(self) -> Mapping[str, bytes]:
        """Content of the files that the parameters name, by that name."""
        return self._parts[0].files

    @property
    def node(self) -> str:
        """Resolved name of the node, the beginning of its topics' names."""
        return self.metadata.get("node", "/cloth_sim")

    @property
    def complete(self) -> bool:
        """Whether every file is finished and, as far as it has been read, undamaged."""
        return all(part.finished and not part.damage for part in self._parts)

    @property
    def missing(self) -> str | None:
        """What the session lacks, in a sentence, as far as it has been read; None if nothing."""
        found = [sentence for part in self._parts if (sentence := part.missing()) is not None]
        return "; ".join(found) or None

    def messages(
        self, topics: Iterable[str] | None = None, *, start: int | None = None, end: int | None = None
    ) -> Iterator[Message]:
        """All messages, or those of some topics, with log times in [start, end) ns, in the order they were recorded."""
        wanted = None if topics is None else frozenset(topics)
        for part in self._parts:
            part.rewind()
            yield from part.messages(topics=wanted, start=start, end=end)

    def frames(self, *, start: int | None = None, end: int | None = None) -> Iterator[FrameRecord]:
        """The frames' records."""
        for message in self.messages([f"{self.node}/frame"], start=start, end=end):
            yield read_frame(message)

    def clouds(self, *, start: int | None = None, end: int | None = None) -> Iterator[RecordedCloud]:
        """The clouds, each with the record of its frame, which lies before it and has the same publish time."""
        topics = [f"{self.node}/frame", f"{self.node}/points"]
        yield from pair_clouds(self.messages(topics, start=start, end=end), self.node)

    def topology(self) -> Surface | None:
        """The cloth's triangles and rest shape; None if the session holds none."""
        from cloth_sim_ros.session.cdr import decode_surface

        for message in self.messages([f"{self.node}/topology"]):
            return decode_surface(message.data)
        return None

    def follow(
        self,
        topics: Iterable[str] | None = None,
        *,
        poll: float = 0.1,
        keep_waiting: Callable[[], bool] = lambda: True,
    ) -> Iterator[Message]:
        """The messages of a session that may still be recorded: what is there, then what comes.

        Looks again every `poll` seconds. Ends when the recording has ended, by itself or by the death of its process,
        or when `keep_waiting` says so; further files of a split session are opened as they appear.
        """
        wanted = None if topics is None else frozenset(topics)
        for part in self._parts:
            part.rewind()
        index = 0
        while True:
            part = self._parts[index]
            # Asked before reading: what was written before the writer ended is then read in this round.
            alive = part.is_being_written()
            yield from part.messages(topics=wanted)
            if index + 1 < len(self._parts):
                index += 1
            elif part.at_end:
                following = _following_part(part, strict=self._strict)
                if following is None:
                    return
                self._parts.append(following)
                index += 1
            elif not alive or not keep_waiting():
                return
            else:
                time.sleep(poll)


def read_frame(message: Message) -> FrameRecord:
    """The frame record that a message of the ``<node>/frame`` channel holds."""
    from cloth_sim_ros.session.cdr import decode_string

    return FrameRecord.from_json(decode_string(message.data))


def pair_clouds(messages: Iterable[Message], node: str) -> Iterator[RecordedCloud]:
    """Clouds with their frames, from a stream that holds both."""
    from cloth_sim_ros.session.cdr import decode_cloud

    frame: Message | None = None
    for message in messages:
        if message.topic == f"{node}/frame":
            frame = message
        elif message.topic == f"{node}/points":
            same = frame is not None and frame.publish_time == message.publish_time
            yield RecordedCloud(
                frame=read_frame(frame) if same and frame is not None else None,
                cloud=decode_cloud(message.data),
                log_time=message.log_time,
            )


def _check_order(parts: Sequence[SessionPart]) -> None:
    first = parts[0]
    for before, after in itertools.pairwise(parts):
        if after.session != first.session:
            raise SessionError(
                f"{after.path} belongs to session {after.session}, {first.path} to {first.session}; "
                "give the files of one session at a time"
            )
        if after.number != before.number + 1:
            raise SessionError(
                f"{after.path} is part {after.number} of its session and follows part {before.number}; "
                "give all parts, in order"
            )


def session_files(path: Path | str) -> list[Path]:
    """All files of the session that a file belongs to, in order, as far as they lie in the same folder.

    Raises SessionError where the file is no session.
    """
    with contextlib.closing(SessionPart(path)) as given:
        found = {given.number: given.path}
        for sibling in _siblings(given):
            found.setdefault(sibling.number, sibling.path)
            sibling.close()
    return [found[number] for number in sorted(found)]


def by_session(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Split files into sessions: parts of one session that follow each other stay together.

    A file that cannot be read stays alone, so that whoever reads it says why.
    """
    together: list[Path] = []
    follows: tuple[str, int] | None = None
    for path in paths:
        try:
            with contextlib.closing(SessionPart(path)) as part:
                place = (part.session, part.number)
        except SessionError:
            place = None
        if together and (place is None or place != follows):
            yield together
            together = []
        together.append(path)
        follows = None if place is None else (place[0], place[1] + 1)
    yield together


def _following_part(part: SessionPart, *, strict: bool) -> SessionPart | None:
    """The next file of a split session, open; None where there is none."""
    if part.end_notes.get("reason") != "split":
        return None
    following = None
    for sibling in _siblings(part):
        if sibling.number == part.number + 1 and following is None:
            following = SessionPart(sibling.path, strict=strict)
        sibling.close()
    return following


def _siblings(part: SessionPart) -> Iterator[SessionPart]:
    """The other files of the same session in the same folder, open."""
    for path in sorted(part.path.parent.glob(f"*{part.path.suffix}")):
        if path == part.path:
            continue
        try:
            sibling = SessionPart(path)
        except SessionError:
            # Anything may lie in the folder of sessions.
            continue
        if sibling.session == part.session:
            yield sibling
        else:
            sibling.close()
