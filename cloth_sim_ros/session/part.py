# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of one session file: finished, cut off, or still growing."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from cloth_sim_ros.session.data_section import (
    check_data_end,
    check_not_stripped,
    content_records,
    has_content_index,
    is_fully_indexed,
    opening_records,
    read_unchunked,
)
from cloth_sim_ros.session.decompression import MAX_CHUNK_BYTES
from cloth_sim_ros.session.errors import DamagedSessionError, SessionError
from cloth_sim_ros.session.mcap_scan import (
    RECORD_HEADER_SIZE,
    Chunk,
    ChunkSearch,
    DamagedRecordError,
    RawMessage,
    RecordLocation,
    Summary,
    check_index,
    chunk_records,
    locate_record,
    read_attachment,
    read_chunk,
    read_metadata,
    read_summary,
)
from cloth_sim_ros.session.opening import check_contents, check_header, open_file
from cloth_sim_ros.session.storage import is_being_written
from cloth_sim_ros.session.writer import (
    END_METADATA_NAME,
    FILE_PREFIX,
    METADATA_NAME,
    SCENE_NAME,
    STATE_NAME,
    metadata_checksum,
)

_REQUIRED_ATTACHMENTS = frozenset((SCENE_NAME, STATE_NAME))
#: Number of messages in which a session's topics are searched.
_MAX_PROBED_MESSAGES = 1000
#: Reason of the end of a recovered file.
RECOVERED = "recovered"
#: Limit of the times of messages: ROS holds seconds as int32 [ns].
_MAX_TIME = 10**9 << 31


class Message(NamedTuple):
    """Recorded message: topic, type, CDR bytes, log and publish time [ns], and index on the topic."""

    topic: str
    type_name: str
    data: bytes
    """CDR bytes."""
    log_time: int
    """Time of recording [ns since the epoch]."""
    publish_time: int
    """Time of the contents [ns since the epoch]; for outputs of a frame, the time when the frame was due."""
    sequence: int
    """Index of the message on its topic; dropped messages count."""


class SessionPart:
    """Reader of one session file, finished or still growing; it opens the file and reads metadata and attachments.

    Call `chunks` and `messages` again while the file grows; they continue at the current position. Damaged records are
    skipped and reported in `damage`, or raised as DamagedSessionError if `strict`.
    """

    def __init__(self, path: Path | str, *, strict: bool = False) -> None:
        """Open a file and read its opening. Raises SessionError: unreadable, not a session, or damaged."""
        self.path = Path(path)
        self.metadata: Mapping[str, str] = {}
        """Versions, machine, node, period ... at the start of the recording."""
        self.end_notes: Mapping[str, str] = {}
        """Reason of the end and number of dropped messages; empty until the end was read."""
        self.attachments: dict[str, Attachment] = {}
        """By name; always with ``scene.yaml`` and ``state.npz``."""
        self.foreign_metadata: set[str] = set()
        """Names of the metadata records of other tools, as far as they were read."""
        self._strict = strict
        self._attachment_offsets: dict[str, int] = {}
        self._summary: Summary | None = None
        self._fully_indexed: bool | None = None  # the summary names the whole contents; None if unknown
        self._summary_damage: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._data_start = self._position = 0
        self._at_end = False
        self._was_at_end = False  # in this pass or an earlier one
        self._furthest = 0  # largest offset that was read
        #: Descriptions of damaged records, each once, although several passes read them.
        self._damage: dict[str, None] = {}
        self._has_unchunked = False  # some messages lie outside of chunks
        self._file = open_file(self.path)
        self._search = ChunkSearch(self._file)
        try:
            self._data_start = check_header(self._file, self.path)
            self._read_summary()
            self._read_contents()
            if not self.metadata or not self.attachments.keys() >= _REQUIRED_ATTACHMENTS:
                check_not_stripped(self.path, self.metadata, self.attachments, self._read_channels())
            check_contents(self.path, self.metadata, self.attachments)
        except BaseException:
            self._file.close()
            raise
        self.rewind()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def index(self) -> int:
        """Index of this file in its session, from 0."""
        return int(self.metadata["part"])

    @property
    def session(self) -> str:
        """Identifier that all files of one session share."""
        return self.metadata["session"]

    @property
    def scene_yaml(self) -> str:
        """Effective parameters at the file's beginning, as a ROS parameter file. Raises UnicodeDecodeError."""
        return self.attachments[SCENE_NAME].data.decode()

    @property
    def state(self) -> bytes:
        """Full state before the file's first frame, as the bytes of an .npz."""
        return self.attachments[STATE_NAME].data

    @property
    def files(self) -> dict[str, bytes]:
        """Contents (bytes) of the files that parameters name, such as a mesh, by that name."""
        return {
            name.removeprefix(FILE_PREFIX): attachment.data
            for name, attachment in self.attachments.items()
            if name.startswith(FILE_PREFIX)
        }

    @property
    def finished(self) -> bool:
        """True if the file was closed properly with intact indexes; at the end of a grown file, reads them."""
        if self._summary is None and self._at_end and not self._summary_damage:
            # A file that was growing when it was opened may have its indexes now.
            self._read_summary()
        return self._summary is not None

    @property
    def summary(self) -> Summary | None:
        """Indexes of a finished file; None if unfinished or damaged."""
        return self._summary

    @property
    def indexed(self) -> bool:
        """True if the indexes name all contents (checked at the first access); else the file is read in full."""
        if self._summary is None:
            return False
        if self._fully_indexed is None:
            self._fully_indexed = is_fully_indexed(self._file, self._summary, self._data_start)
        return self._fully_indexed

    @property
    def position(self) -> int:
        """Offset up to which the file was read [bytes]."""
        return self._position

    @property
    def at_end(self) -> bool:
        """True if the end of the data section was read: no messages will follow."""
        return self._at_end

    @property
    def damage(self) -> tuple[str, ...]:
        """Descriptions of the damaged records that were skipped so far."""
        return (*self._summary_damage, *self._damage)

    def size(self) -> int:
        """Return the current size of the file [bytes]."""
        return os.fstat(self._file.fileno()).st_size

    def is_being_written(self) -> bool:
        """Return True if a living process is recording into the file."""
        return is_being_written(self._file.fileno())

    def rewind(self) -> None:
        """Go back to the first chunk. The damage that was found so far stays reported."""
        self._note_progress()
        self._position = self._data_start
        self._at_end = False

    def _note_progress(self) -> None:
        """Note how far the file was read: a later pass may stop earlier."""
        self._furthest = max(self._furthest, self._position)
        self._was_at_end = self._was_at_end or self._at_end

    def missing(self) -> str | None:
        """Return the deficits found so far in one sentence; None if there are none."""
        self._note_progress()
        deficits = (
            [] if self.finished or not self._was_at_end else ["its indexes are missing, its messages are all there"]
        )
        deficits += [*self._summary_damage, *self._missing_contents()]
        return f"{self.path.name}: {'; '.join(deficits)}" if deficits else None

    def missing_contents(self) -> str | None:
        """Return the deficits of the contents found so far in one sentence, without those of the indexes."""
        self._note_progress()
        return "; ".join(self._missing_contents()) or None

    def _missing_contents(self) -> list[str]:
        deficits = []
        if not self.finished and self.is_being_written():
            deficits.append("it is still being recorded")
        elif not self.finished and not self._was_at_end:
            n_bytes = self.size() - self._furthest
            torn = ""
            if n_bytes and self._furthest > self._data_start:
                torn = f" ({n_bytes} bytes of a torn chunk are left out)"
            deficits.append(f"the recording was cut off, what its last second held is lost{torn}")
        deficits += self._damage
        if self.end_notes.get("reason") == RECOVERED and self.end_notes.get("missing"):
            deficits.append(f"recovered, {self.end_notes['missing']}")
        dropped = self.end_notes.get("dropped", "0")
        if dropped != "0":
            clouds = "1 cloud was" if dropped == "1" else f"{dropped} clouds were"
            deficits.append(f"{clouds} dropped, the disk was too slow")
        return deficits

    def chunks(self, *, start: int | None = None, end: int | None = None) -> Iterator[Chunk]:
        """Yield the chunks from `position` to the last intact one; messages outside of chunks form one, too.

        In a finished file, chunks outside of the log times [`start`, `end`) [ns] are skipped.
        """
        if self._summary is not None and self.indexed:
            yield from self._indexed_chunks(self._summary, start, end)
        else:
            yield from self._scanned_chunks()

    def messages(
        self, *, topics: frozenset[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Message]:
        """Yield messages from `position` to the last intact chunk: of `topics`, log times in [start, end) [ns]."""
        for chunk in self.chunks(start=start, end=end):
            channels: dict[int, tuple[str, str] | None] = {}
            for _, raw in chunk_records(chunk):
                if not isinstance(raw, RawMessage):
                    self.declare(raw)
                    channels.clear()
                    continue
                if raw.channel not in channels:
                    channels[raw.channel] = self._select_channel(raw.channel, topics, chunk.location)
                channel = channels[raw.channel]
                if channel is None or _is_outside(raw.log_time, raw.log_time, start, end):
                    continue
                if max(raw.log_time, raw.publish_time) >= _MAX_TIME:
                    cause = f"the chunk at byte {chunk.location.offset} has a time of {channel[0]} beyond those of ROS"
                    self._report_damage(DamagedRecordError(cause))
                    continue
                yield Message(*channel, raw.data, raw.log_time, raw.publish_time, raw.sequence)

    def declare(self, record: Schema | Channel) -> None:
        """Register a schema or a channel from a chunk; for callers that iterate over `chunks`.

        Two different declarations of one id are damage: other readers may take the other one.
        """
        declared: dict[int, Any] = self._schemas if isinstance(record, Schema) else self._channels
        if declared.setdefault(record.id, record) != record:
            subject = f"{type(record).__name__.lower()} {record.id}"
            self._report_damage(DamagedRecordError(f"{subject} is declared twice, with different contents"))
            declared[record.id] = record

    def channel(self, channel_id: int) -> tuple[str, str] | None:
        """Return (topic, type) of a channel id; None if its declaration was lost or not yet read."""
        record = self._channels.get(channel_id)
        schema = None if record is None else self._schemas.get(record.schema_id)
        return None if record is None or schema is None else (record.topic, schema.name)

    def report_undeclared(self, channel_id: int, location: RecordLocation) -> None:
        """Add to `damage` that a chunk's messages are skipped because their channel's declaration is lost."""
        self._damage[f"the chunk at byte {location.offset} has messages of channel {channel_id}, never declared"] = None

    def declarations(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """Return copies of the schemas and channels read so far, two dicts by id."""
        return dict(self._schemas), dict(self._channels)

    def _read_summary(self) -> None:
        try:
            self._summary = read_summary(self._file)
        except DamagedRecordError as error:
            if self._strict:
                raise DamagedSessionError(f"{self.path}: {error}") from error
            self._summary_damage.append(str(error))
        if self._summary is not None:
            self._schemas.update(self._summary.schemas)
            self._channels.update(self._summary.channels)

    def _read_contents(self) -> None:
        """Read metadata and attachments into the attributes: by the indexes, or else before the chunks."""
        summary = self._summary
        try:
            if summary is not None and has_content_index(summary):
                for offset, _ in summary.records:
                    location = locate_record(self._file, offset)
                    if location is not None:
                        self._read_content(location)
                return
            for location in opening_records(self._file, self._data_start):
                self._read_content(location)
            if not self.metadata or not self.attachments.keys() >= _REQUIRED_ATTACHMENTS:
                for location in content_records(self._file, self._data_start):
                    self._read_content(location)
        except DamagedRecordError as error:
            consequence = "the session cannot be read without this record"
            raise DamagedSessionError(f"{self.path}: {error}; {consequence}") from error

    def _read_channels(self) -> dict[str, str]:
        """Rewind, and return message types by topic, from the file's indexes or from its first messages."""
        self.rewind()
        for _ in itertools.islice(self.messages(), 0 if self._channels else _MAX_PROBED_MESSAGES):
            pass
        channels = (self.channel(channel_id) for channel_id in self._channels)
        return {channel[0]: channel[1] for channel in channels if channel is not None}

    def _read_content(self, location: RecordLocation) -> None:
        if location.opcode == Opcode.METADATA:
            record = read_metadata(self._file, location)
            if record.name == METADATA_NAME:
                if self.metadata and self.metadata != record.metadata:
                    raise SessionError(
                        f"{self.path} holds the openings of two recordings, as after a merge: their messages "
                        "cannot be separated; give the files from before the merge, those of one session in order"
                    )
                self.metadata = MappingProxyType(record.metadata)
            elif record.name == END_METADATA_NAME:
                self._read_end_notes(record, location)
            else:
                self.foreign_metadata.add(record.name)
        elif location.opcode == Opcode.ATTACHMENT:
            attachment = read_attachment(self._file, location)
            self._check_attachment(attachment, location)
            self.attachments[attachment.name] = attachment
            n_bytes = sum(len(entry.data) for entry in self.attachments.values())
            if n_bytes > MAX_CHUNK_BYTES:
                sizes = f"{n_bytes} bytes, the limit is {MAX_CHUNK_BYTES}"
                raise DamagedRecordError(f"the attachments up to byte {location.end} have {sizes}")

    def _check_attachment(self, attachment: Attachment, location: RecordLocation) -> None:
        """Refuse a second attachment of one name with other contents, except of names that nothing here reads."""
        name, previous = attachment.name, self.attachments.get(attachment.name)
        is_read = name in _REQUIRED_ATTACHMENTS or name.startswith(FILE_PREFIX)
        if is_read and previous is not None and previous.data != attachment.data:
            offsets = f"at bytes {self._attachment_offsets[name]} and {location.offset}"
            raise DamagedSessionError(f"{self.path} has two different attachments {name!r}, {offsets}")
        self._attachment_offsets.setdefault(name, location.offset)

    def _read_end_notes(self, record: Metadata, location: RecordLocation) -> None:
        if record.metadata.get("checksum") != metadata_checksum(record.metadata):
            raise DamagedRecordError(f"the metadata record at byte {location.offset} fails its checksum")
        self.end_notes = MappingProxyType(record.metadata)

    def _indexed_chunks(self, summary: Summary, start: int | None, end: int | None) -> Iterator[Chunk]:
        """Yield the chunks of a finished file by its indexes, which have a checksum."""
        for offset, index in summary.chunks.items():
            if offset < self._position:
                continue
            self._position = offset + index.chunk_length
            if _is_outside(index.message_start_time, index.message_end_time, start, end):
                continue
            try:
                size = index.chunk_length - RECORD_HEADER_SIZE
                yield read_chunk(self._file, RecordLocation(int(Opcode.CHUNK), offset, size))
            except DamagedRecordError as error:
                self._report_damage(error)
        self._at_end = True

    def _scanned_chunks(self) -> Iterator[Chunk]:
        """Yield the chunks from record to record, up to the last intact one."""
        while not self._at_end:
            try:
                location = locate_record(self._file, self._position)
                chunk = None if location is None else self._read_record(location)
            except DamagedRecordError as error:
                self._report_damage(error)
                self._find_next_chunk()
                continue
            if location is not None:
                self._position = location.end if chunk is None else chunk.location.end
                if chunk is not None:
                    yield chunk
            elif self.is_being_written() or not self._skip_to_next_chunk():
                return

    def _read_record(self, location: RecordLocation) -> Chunk | None:
        """Return a chunk; register metadata, attachments or the end and return None. Raises DamagedRecordError."""
        if location.opcode == Opcode.CHUNK:
            return read_chunk(self._file, location)
        unchunked = read_unchunked(self._file, location)
        if unchunked is not None:
            self._has_unchunked = True
            return unchunked
        if location.opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            self._read_content(location)
        elif location.opcode == Opcode.MESSAGE_INDEX:
            check_index(self._file, location)
        elif location.opcode == Opcode.DATA_END and location.body_size == 4:
            self._at_end = True
            self._check_data_end(location)
        else:
            raise DamagedRecordError(f"byte {location.offset} begins a record that is not allowed there")
        return None

    def _check_data_end(self, location: RecordLocation) -> None:
        """Check messages outside of chunks by the data section's checksum; report a mismatch as damage."""
        if self._has_unchunked:
            try:
                check_data_end(self._file, location)
            except DamagedRecordError as error:
                self._report_damage(error)

    def _skip_to_next_chunk(self) -> bool:
        """Skip a record whose length exceeds the file, to the next intact chunk; return False without one."""
        if self._position >= self.size():
            return False
        next_chunk = self._search.find(self._position)
        if next_chunk is None:
            return False
        self._report_damage(DamagedRecordError(f"the record at byte {self._position} has a wrong length"))
        self._position = next_chunk
        return True

    def _find_next_chunk(self) -> None:
        next_chunk = self._search.find(self._position + 1)
        if next_chunk is None:
            n_bytes = self.size() - self._position
            self._damage[f"{n_bytes} bytes from byte {self._position} on cannot be read"] = None
            self._at_end = True
        else:
            self._position = next_chunk

    def _report_damage(self, error: DamagedRecordError) -> None:
        if self._strict:
            raise DamagedSessionError(f"{self.path}: {error}") from error
        self._damage[str(error)] = None

    def _select_channel(
        self, channel_id: int, topics: frozenset[str] | None, location: RecordLocation
    ) -> tuple[str, str] | None:
        channel = self.channel(channel_id)
        if channel is None:
            self.report_undeclared(channel_id, location)
            return None
        return None if topics is not None and channel[0] not in topics else channel


def _is_outside(first: int, last: int, start: int | None, end: int | None) -> bool:
    return (start is not None and last < start) or (end is not None and first >= end)
