# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One session file, read from front to back, whether it is finished, was cut off anywhere, or is still growing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Schema

from cloth_sim_ros.session.errors import DamagedSessionError, NotASessionError, SessionError
from cloth_sim_ros.session.mcap_builder import MAGIC
from cloth_sim_ros.session.mcap_scan import (
    Chunk,
    DamagedRecordError,
    RecordPlace,
    Summary,
    chunk_records,
    parse_record,
    place_at,
    read_attachment,
    read_body,
    read_chunk,
    read_metadata,
    read_summary,
)
from cloth_sim_ros.session.storage import is_being_written
from cloth_sim_ros.session.writer import (
    END_METADATA_NAME,
    FORMAT_VERSION,
    METADATA_NAME,
    SCENE_NAME,
    STATE_NAME,
    metadata_checksum,
)


class Message(NamedTuple):
    """A recorded message."""

    topic: str
    type_name: str
    data: bytes
    """CDR bytes."""
    log_time: int
    """Nanoseconds since the epoch."""
    publish_time: int
    sequence: int
    """Number of the message on its topic, counting those that were dropped."""


class SessionPart:
    """One file of a session.

    `chunks` may be called again while the file grows; it goes on where it stopped. Damage is skipped and noted in
    `damage`, or raised where `strict`.
    """

    def __init__(self, path: Path | str, *, strict: bool = False) -> None:
        """Open a file and read its beginning. Raises NotASessionError or DamagedSessionError with the reason."""
        self.path = Path(path)
        self._strict = strict
        self._data_start = 0
        self._position = 0
        self._file = _open(self.path)
        try:
            self._read_beginning()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Give the file back."""
        self._file.close()

    @property
    def number(self) -> int:
        """Place of this file among those of its session, from 0."""
        return int(self.metadata.get("part", "0"))

    @property
    def session(self) -> str:
        """What all files of one session have in common."""
        return self.metadata.get("session", self.path.stem)

    @property
    def finished(self) -> bool:
        """Whether the file was closed properly, its indexes intact."""
        return self._summary is not None

    @property
    def summary(self) -> Summary | None:
        """The indexes of a finished file."""
        return self._summary

    def is_being_written(self) -> bool:
        """Whether a living process is recording into it."""
        return is_being_written(self._file.fileno())

    def size(self) -> int:
        """Bytes of the file now."""
        return os.fstat(self._file.fileno()).st_size

    @property
    def position(self) -> int:
        """Bytes read so far."""
        return self._position

    @property
    def at_end(self) -> bool:
        """Whether the end of the data was read: nothing more will come."""
        return self._at_end

    @property
    def damage(self) -> tuple[str, ...]:
        """What was found damaged and left out, as far as the file has been read."""
        return tuple(self._damage)

    @property
    def end_notes(self) -> Mapping[str, str]:
        """Why the file ends where it ends, and how many messages were dropped; empty before its end has been read."""
        return MappingProxyType(self._end_notes)

    def rewind(self) -> None:
        """Start over with the first chunk."""
        self._position = self._data_start
        self._at_end = False
        self._damage.clear()

    def missing(self) -> str | None:
        """What the file lacks, as far as it has been read, in one sentence; None if nothing."""
        found = list(self._damage)
        if not self.finished and not self._at_end:
            left = self.size() - self._position
            cut = f", {left} bytes of an unfinished chunk are left out" if left and self._position else ""
            if self.is_being_written():
                found.insert(0, "it is still being recorded")
            else:
                found.insert(0, f"the recording was cut off (at most its last second is lost){cut}")
        elif self._end_notes.get("dropped", "0") != "0":
            found.append(f"{self._end_notes['dropped']} clouds were dropped because the disk was too slow")
        return f"{self.path.name}: {'; '.join(found)}" if found else None

    def chunks(self, *, start: int | None = None, end: int | None = None) -> Iterator[Chunk]:
        """The chunks from the present position to the end of what is whole.

        With `start` or `end` (log times in ns, half open) the chunks of a finished file that lie outside are passed
        over.
        """
        while not self._at_end:
            try:
                place = place_at(self._file, self._position)
                if place is None:
                    return
                chunk = self._step(place, start, end)
            except DamagedRecordError as error:
                if not self._skip_damage(error):
                    return
                continue
            self._position = place.end
            if chunk is not None:
                yield chunk

    def messages(
        self, *, topics: frozenset[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Message]:
        """The messages from the present position to the end of what is whole, in the order they were recorded."""
        for chunk in self.chunks(start=start, end=end):
            wanted: dict[int, tuple[str, str] | None] = {}
            for item in chunk_records(chunk):
                if not isinstance(item, tuple):
                    self._declare(item)
                    wanted.clear()
                    continue
                raw = item[1]
                if raw.channel not in wanted:
                    wanted[raw.channel] = self._topic(raw.channel, topics, chunk.place)
                known = wanted[raw.channel]
                if (
                    known is None
                    or (start is not None and raw.log_time < start)
                    or (end is not None and raw.log_time >= end)
                ):
                    continue
                yield Message(known[0], known[1], raw.data, raw.log_time, raw.publish_time, raw.sequence)

    def _read_beginning(self) -> None:
        self.metadata: Mapping[str, str] = {}
        self.scene_yaml = ""
        self.state = b""
        self._damage: list[str] = []
        self._end_notes: dict[str, str] = {}
        self._at_end = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._summary: Summary | None = None
        self._check_header()
        try:
            self._summary = read_summary(self._file)
        except DamagedRecordError as error:
            self._note(error)
        if self._summary is not None:
            self._schemas.update(self._summary.schemas)
            self._channels.update(self._summary.channels)
        try:
            self._read_contents()
        except DamagedRecordError as error:
            raise DamagedSessionError(f"{self.path}: {error}; the session cannot be read without it") from error
        if METADATA_NAME not in self._seen:
            raise NotASessionError(
                f"{self.path} is an MCAP without the metadata record {METADATA_NAME!r}: cloth_sim did not record it"
            )
        if self.metadata.get("checksum") != metadata_checksum(self.metadata):
            raise DamagedSessionError(f"{self.path}: the metadata record {METADATA_NAME!r} fails its checksum")
        if self.metadata.get("format") != FORMAT_VERSION:
            raise NotASessionError(
                f"{self.path} has session format {self.metadata.get('format')!r}, "
                f"this version reads {FORMAT_VERSION!r}; use the version that recorded it"
            )
        if not self.scene_yaml or not self.state:
            raise DamagedSessionError(f"{self.path} ends inside its opening: nothing was recorded")

    def _check_header(self) -> None:
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            raise NotASessionError(f"{self.path} is not an MCAP file")
        try:
            place = place_at(self._file, len(MAGIC))
            header = None if place is None else parse_record(Header, read_body(self._file, place), place.offset)
        except DamagedRecordError as error:
            raise DamagedSessionError(f"{self.path}: {error}") from error
        if place is None or header is None:
            raise DamagedSessionError(f"{self.path} ends inside its opening: nothing was recorded")
        if place.opcode != Opcode.HEADER or header.profile != "ros2":
            raise NotASessionError(f"{self.path} has MCAP profile {header.profile!r}, a session has 'ros2'")
        self._data_start = place.end
        self._position = place.end

    def _read_contents(self) -> None:
        """Metadata and attachments: by the index of a finished file (tools may move them), else before the chunks."""
        self._seen: set[str] = set()
        if self._summary is not None and self._summary.records:
            for offset, _ in self._summary.records:
                place = place_at(self._file, offset)
                if place is not None:
                    self._read_content(place)
            return
        position = self._data_start
        while (place := place_at(self._file, position)) is not None and place.opcode != Opcode.CHUNK:
            self._read_content(place)
            position = place.end

    def _read_content(self, place: RecordPlace) -> None:
        if place.opcode == Opcode.METADATA:
            record = read_metadata(self._file, place)
            self._seen.add(record.name)
            if record.name == METADATA_NAME:
                self.metadata = MappingProxyType(record.metadata)
            elif record.name == END_METADATA_NAME:
                self._end_notes = record.metadata
        elif place.opcode == Opcode.ATTACHMENT:
            attachment = read_attachment(self._file, place)
            if attachment.name == SCENE_NAME:
                self.scene_yaml = attachment.data.decode()
            elif attachment.name == STATE_NAME:
                self.state = attachment.data

    def _step(self, place: RecordPlace, start: int | None, end: int | None) -> Chunk | None:
        """Deal with one record of the data section."""
        if place.opcode == Opcode.CHUNK:
            return None if self._lies_outside(place, start, end) else read_chunk(self._file, place)
        if place.opcode == Opcode.METADATA:
            self._read_content(place)
        elif place.opcode in (Opcode.DATA_END, Opcode.FOOTER):
            self._at_end = True
            if self._summary is None and not self._damage:
                self._summary = read_summary(self._file)
        return None

    def _lies_outside(self, place: RecordPlace, start: int | None, end: int | None) -> bool:
        """By the checked index alone: the chunk's own head has no checksum."""
        if self._summary is None or (start is None and end is None):
            return False
        index = next((index for index in self._summary.chunks if index.chunk_start_offset == place.offset), None)
        return index is not None and (
            (start is not None and index.message_end_time < start)
            or (end is not None and index.message_start_time >= end)
        )

    def _skip_damage(self, error: DamagedRecordError) -> bool:
        """Note it and go on with the next chunk that the indexes, or the damaged record's own length, lead to."""
        if self._strict:
            raise DamagedSessionError(f"{self.path}: {error}") from error
        self._note(error)
        following: int | None = None
        if self._summary is not None:
            following = next(
                (
                    index.chunk_start_offset
                    for index in self._summary.chunks
                    if index.chunk_start_offset > self._position
                ),
                None,
            )
            if following is None:
                self._at_end = True
                return False
        else:
            try:
                place = place_at(self._file, self._position)
            except DamagedRecordError:
                place = None
            following = None if place is None else place.end
        if following is None:
            self._at_end = True
            return False
        self._position = following
        return True

    def _note(self, error: DamagedRecordError) -> None:
        self._damage.append(str(error))

    def _declare(self, record: Schema | Channel) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record

    def _topic(self, channel: int, topics: frozenset[str] | None, place: RecordPlace) -> tuple[str, str] | None:
        """Topic and type of a channel, None where it is not wanted or its declaration was lost with a damaged chunk."""
        record = self._channels.get(channel)
        schema = None if record is None else self._schemas.get(record.schema_id)
        if record is None or schema is None:
            self._note(DamagedRecordError(f"the chunk at byte {place.offset} has messages of an undeclared channel"))
            return None
        return None if topics is not None and record.topic not in topics else (record.topic, schema.name)


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except FileNotFoundError:
        raise SessionError(f"{path} does not exist") from None
    except IsADirectoryError:
        raise SessionError(f"{path} is a folder; give the .mcap file in it") from None
    except OSError as error:
        raise SessionError(f"cannot read {path}: {error.strerror}") from error
