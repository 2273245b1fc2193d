# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scanner of MCAP records that accepts only complete, checked ones."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Footer, McapRecord, Metadata, Schema, Statistics

from cloth_sim_ros.session.decompression import MAX_CHUNK_BYTES, DecompressionError, decompress
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.mcap_builder import MAGIC

_RECORD_HEADER = struct.Struct("<BQ")
RECORD_HEADER_SIZE = _RECORD_HEADER.size
"""Size of opcode and length before a record's body [bytes]."""
_CHUNK_HEADER = struct.Struct("<QQQI")
_MESSAGE = struct.Struct("<HIQQ")
MESSAGE_HEADER_SIZE = _MESSAGE.size
"""Size of a message's body before its payload [bytes]."""
_FOOTER_SIZE = 9 + 20 + len(MAGIC)
#: Maximum size of a record's body [bytes]: of an uncompressed chunk with its header, and of other records.
_MAX_CHUNK_BODY, _MAX_RECORD_BODY = MAX_CHUNK_BYTES + (1 << 10), 64 << 20
#: Size from which a record counts in addition to its chunk [bytes].
_LARGE_RECORD = 8 << 20
#: Maximum size of an attached file [bytes].
MAX_ATTACHMENT_BYTES = 128 << 20
_KNOWN_OPCODES = range(1, 16)
_PRIVATE_OPCODES = range(0x80, 0x100)
_CHUNK_OPCODES = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE), *_PRIVATE_OPCODES))

# Opcode, length below 4 GiB, times, sizes, checksum, name of the compression.
_CHUNK_PATTERN = re.compile(rb"(?=\x06.{4}\0{4}.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))", re.DOTALL)
_CHUNK_PATTERN_SIZE = 48
#: Maximum size of an attachment's times, name and type, before its content [bytes].
_MAX_ATTACHMENT_HEADER = 1 << 16
_SEARCH_WINDOW = 1 << 20
#: Maximum size that a search reads and unpacks at false chunk headers, in addition to the file's size [bytes].
_MAX_SEARCH_BYTES = 512 << 20

_Record = TypeVar("_Record", bound=McapRecord)


class DamagedRecordError(SessionError):
    """Error: a record's bytes do not parse or fail their checksum."""


class RawMessage(NamedTuple):
    """Message record of an MCAP file: channel id, sequence, log and publish time [ns], and data, not decoded."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RecordLocation:
    """Opcode, offset and body size [bytes] of a record in the file."""

    opcode: int
    offset: int
    """Offset of its opcode."""
    body_size: int

    @property
    def end(self) -> int:
        """Offset behind the record, where the next one begins [bytes]."""
        return self.offset + _RECORD_HEADER.size + self.body_size


@dataclass(frozen=True, slots=True)
class Chunk:
    """Contents of a chunk, decompressed, with their checksum verified if the file has one."""

    location: RecordLocation
    compression: str
    payload: bytes
    """Compressed contents."""
    raw: bytes
    crc: int
    has_checksum: bool
    """False if the file has no checksum for it."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Indexes at the end of a finished file: schemas, channels, chunks, attachments; their checksum is verified."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    statistics: Statistics | None
    chunks: dict[int, ChunkIndex]
    """By the offset of the chunk, ascending."""
    records: list[tuple[int, int]]
    """Offset and length of each attachment and metadata record."""
    start: int = 0
    """Offset at which the summary begins and the data section ends."""


def locate_record(file: BinaryIO, offset: int) -> RecordLocation | None:
    """Return the record's location at `offset`; None if the file ends before its end. Raises DamagedRecordError."""
    size = file.seek(0, 2)
    if offset >= size:
        return None
    file.seek(offset)
    header = file.read(_RECORD_HEADER.size)
    if not header:
        return None
    if header[0] not in _KNOWN_OPCODES and header[0] not in _PRIVATE_OPCODES:
        raise DamagedRecordError(f"byte {offset} begins no record (opcode {header[0]})")
    if len(header) < _RECORD_HEADER.size:
        return None
    opcode, body_size = _RECORD_HEADER.unpack(header)
    location = RecordLocation(opcode, offset, body_size)
    return location if location.end <= size else None


class ChunkSearch:
    """Search for the next intact chunk after a damaged record.

    The length of a damaged record does not lead to the next one. Therefore each byte sequence that resembles a chunk
    header is tried. The total work is limited, because a file may consist of such headers.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._searched_bytes = 0

    def find(self, offset: int) -> int | None:
        """Return the offset of the next intact chunk from `offset` on; None without one, or at a work limit."""
        size = self._file.seek(0, 2)
        while offset < size:
            self._file.seek(offset)
            window = self._file.read(_SEARCH_WINDOW)
            for match in _CHUNK_PATTERN.finditer(window):
                candidate = offset + match.start()
                if self._searched_bytes > _MAX_SEARCH_BYTES + size:
                    return None
                if self._is_chunk(candidate, window[match.start() : match.start() + _CHUNK_PATTERN_SIZE]):
                    return candidate
            # The next window overlaps, to find a header that straddles two windows.
            offset += max(len(window) - _CHUNK_PATTERN_SIZE, 1)
        return None

    def _is_chunk(self, offset: int, header: bytes) -> bool:
        try:
            location = locate_record(self._file, offset)
            if location is None or location.body_size < _CHUNK_HEADER.size:
                return False
            first, last, raw_size, _ = _CHUNK_HEADER.unpack_from(header, _RECORD_HEADER.size)
            if first > last or raw_size > MAX_CHUNK_BYTES:
                return False
            self._searched_bytes += location.body_size + raw_size
            return read_chunk(self._file, location).has_checksum
        except DamagedRecordError:
            return False


def check_index(file: BinaryIO, location: RecordLocation) -> None:
    """Check the layout of a message index record. Raises DamagedRecordError."""
    body = read_body(file, location)
    size = int.from_bytes(body[2:6], "little")
    if len(body) != 6 + size or size % 16:
        raise DamagedRecordError(f"the message index at byte {location.offset} does not parse")


def read_body(file: BinaryIO, location: RecordLocation) -> bytes:
    """Read the body of a record. Raises DamagedRecordError if it is cut off or too large."""
    _check_size(file, location, _MAX_CHUNK_BODY if location.opcode == Opcode.CHUNK else _MAX_RECORD_BODY)
    file.seek(location.offset + _RECORD_HEADER.size)
    body = file.read(location.body_size)
    if len(body) < location.body_size:
        raise DamagedRecordError(f"the record at byte {location.offset} is cut off")
    return body


def _check_size(file: BinaryIO, location: RecordLocation, limit: int) -> None:
    """Refuse a record that is cut off, or longer than a limit [bytes]. Raises DamagedRecordError."""
    if location.end > file.seek(0, 2):
        raise DamagedRecordError(f"the record at byte {location.offset} is cut off")
    if location.body_size > limit:
        sizes = f"{location.body_size} bytes, the limit is {limit}"
        raise DamagedRecordError(f"the record at byte {location.offset} has {sizes}")


def read_chunk(file: BinaryIO, location: RecordLocation) -> Chunk:
    """Read, decompress and verify a chunk. Raises DamagedRecordError; SessionError without a decompressor."""
    file.seek(location.offset)
    if file.read(RECORD_HEADER_SIZE) != _RECORD_HEADER.pack(Opcode.CHUNK, location.body_size):
        raise DamagedRecordError(f"byte {location.offset} begins no chunk of {location.body_size} bytes")
    body = read_body(file, location)
    try:
        _, _, raw_size, crc = _CHUNK_HEADER.unpack_from(body)
        (name_size,) = struct.unpack_from("<I", body, _CHUNK_HEADER.size)
        start = _CHUNK_HEADER.size + 4 + name_size
        compression = body[_CHUNK_HEADER.size + 4 : start].decode()
        (payload_size,) = struct.unpack_from("<Q", body, start)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedRecordError(f"the chunk at byte {location.offset} has no readable head: {error}") from error
    payload = body[start + 8 :]
    if len(payload) != payload_size:
        announced = f"the {payload_size} bytes it announces"
        raise DamagedRecordError(f"the chunk at byte {location.offset} does not hold {announced}")
    try:
        raw = decompress(payload, compression, raw_size)
    except DecompressionError as error:
        raise DamagedRecordError(f"the chunk at byte {location.offset} {error}") from error
    has_checksum = crc != 0
    if has_checksum and zlib.crc32(raw) != crc:
        raise DamagedRecordError(f"the chunk at byte {location.offset} fails its checksum")
    return Chunk(
        location=location, compression=compression, payload=payload, raw=raw, crc=crc, has_checksum=has_checksum
    )


def chunk_records(chunk: Chunk) -> Iterator[tuple[slice, Schema | Channel | RawMessage]]:
    """Yield (span in the chunk, record) of its schemas, channels and messages, in order. Raises DamagedRecordError."""
    raw = chunk.raw
    position = 0
    while position < len(raw):
        if position + _RECORD_HEADER.size > len(raw):
            raise DamagedRecordError(f"the chunk at byte {chunk.location.offset} ends inside a record")
        opcode, size = _RECORD_HEADER.unpack_from(raw, position)
        start = position + _RECORD_HEADER.size
        end = start + size
        if opcode not in _CHUNK_OPCODES:
            raise DamagedRecordError(f"the chunk at byte {chunk.location.offset} holds a record of opcode {opcode}")
        if end > len(raw) or (opcode == Opcode.MESSAGE and size < _MESSAGE.size):
            cause = f"a record of {size} bytes too many"
            raise DamagedRecordError(f"the chunk at byte {chunk.location.offset} holds {cause}")
        if len(raw) + size > MAX_CHUNK_BYTES and size > _LARGE_RECORD:
            sizes = f"{len(raw)} bytes and a record of {size}; together the limit is {MAX_CHUNK_BYTES}"
            raise DamagedRecordError(f"the chunk at byte {chunk.location.offset} has {sizes}")
        if opcode == Opcode.MESSAGE:
            fields = (*_MESSAGE.unpack_from(raw, start), raw[start + _MESSAGE.size : end])
            yield slice(position, end), RawMessage._make(fields)
        elif opcode == Opcode.SCHEMA:
            yield slice(position, end), parse_record(Schema, raw[start:end], chunk.location.offset)
        elif opcode == Opcode.CHANNEL:
            yield slice(position, end), parse_record(Channel, raw[start:end], chunk.location.offset)
        position = end


def parse_message(body: bytes, offset: int) -> RawMessage:
    """Parse a message record's body. `offset`: for the error message. Raises DamagedRecordError if it is cut off."""
    if len(body) < _MESSAGE.size:
        raise DamagedRecordError(f"the message at byte {offset} is cut off")
    return RawMessage._make((*_MESSAGE.unpack_from(body), body[_MESSAGE.size :]))


def read_metadata(file: BinaryIO, location: RecordLocation) -> Metadata:
    """Read a metadata record. Raises DamagedRecordError."""
    return parse_record(Metadata, read_body(file, location), location.offset)


def read_attachment(file: BinaryIO, location: RecordLocation) -> Attachment:
    """Read an attachment and verify its checksum, with one copy in memory. Raises DamagedRecordError."""
    _check_size(file, location, MAX_ATTACHMENT_BYTES + _MAX_ATTACHMENT_HEADER)
    file.seek(location.offset + RECORD_HEADER_SIZE)
    header = file.read(min(location.body_size, _MAX_ATTACHMENT_HEADER))
    try:
        times = struct.unpack_from("<QQ", header)
        name, position = _read_text(header, 16)
        media_type, position = _read_text(header, position)
        (size,) = struct.unpack_from("<Q", header, position)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedRecordError(f"the Attachment record at byte {location.offset} does not parse: {error}") from error
    start = position + 8
    if start + size + 4 != location.body_size:
        announced = f"the {size} bytes it announces"
        raise DamagedRecordError(f"the attachment at byte {location.offset} does not hold {announced}")
    file.seek(location.offset + RECORD_HEADER_SIZE + start)
    data = file.read(size)
    (crc,) = struct.unpack("<I", file.read(4))
    if crc and zlib.crc32(data, zlib.crc32(header[:start])) != crc:
        raise DamagedRecordError(f"the attachment at byte {location.offset} fails its checksum")
    return Attachment(log_time=times[0], create_time=times[1], name=name, media_type=media_type, data=data)


def _read_text(body: bytes, position: int) -> tuple[str, int]:
    """Return the text behind the length at `position`, and the offset of its end. Raises struct.error if cut off."""
    (size,) = struct.unpack_from("<I", body, position)
    text = body[position + 4 : position + 4 + size]
    if len(text) < size:
        raise struct.error("a text is cut off")
    return text.decode(), position + 4 + size


def read_summary(file: BinaryIO) -> Summary | None:
    """Read the indexes of a finished file; None if it is unfinished. Raises DamagedRecordError if they are damaged."""
    size = file.seek(0, 2)
    if size < len(MAGIC) + _FOOTER_SIZE:
        return None
    file.seek(size - _FOOTER_SIZE)
    tail = file.read(_FOOTER_SIZE)
    if tail[-len(MAGIC) :] != MAGIC or _RECORD_HEADER.unpack_from(tail) != (Opcode.FOOTER, 20):
        return None
    footer = parse_record(Footer, tail[9:29], size - _FOOTER_SIZE)
    if not footer.summary_start:
        return None
    if not len(MAGIC) <= footer.summary_start <= size - _FOOTER_SIZE:
        raise DamagedRecordError(f"the footer names byte {footer.summary_start} of a file of {size} bytes")
    if size - footer.summary_start > _MAX_RECORD_BODY:
        sizes = f"{size - footer.summary_start} bytes, the limit is {_MAX_RECORD_BODY}"
        raise DamagedRecordError(f"the indexes at the file's end have {sizes}")
    file.seek(footer.summary_start)
    raw = file.read(size - _FOOTER_SIZE - footer.summary_start)
    if footer.summary_crc and zlib.crc32(tail[:25], zlib.crc32(raw)) != footer.summary_crc:
        raise DamagedRecordError("the indexes at the file's end fail their checksum")
    return _collect_summary(raw, footer.summary_start)


def _collect_summary(raw: bytes, offset: int) -> Summary:
    from mcap.records import AttachmentIndex, MetadataIndex

    summary = Summary(schemas={}, channels={}, statistics=None, chunks={}, records=[])
    statistics = None
    position = 0
    while position + _RECORD_HEADER.size <= len(raw):
        opcode, size = _RECORD_HEADER.unpack_from(raw, position)
        if opcode == 0:
            raise DamagedRecordError(f"byte {offset + position} begins no record (opcode 0)")
        body = raw[position + _RECORD_HEADER.size : position + _RECORD_HEADER.size + size]
        record_offset = offset + position
        if opcode == Opcode.SCHEMA:
            schema = parse_record(Schema, body, record_offset)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse_record(Channel, body, record_offset)
            summary.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            index = parse_record(ChunkIndex, body, record_offset)
            summary.chunks[index.chunk_start_offset] = index
        elif opcode == Opcode.STATISTICS:
            statistics = parse_record(Statistics, body, record_offset)
        elif opcode == Opcode.ATTACHMENT_INDEX:
            attachment = parse_record(AttachmentIndex, body, record_offset)
            summary.records.append((attachment.offset, attachment.length))
        elif opcode == Opcode.METADATA_INDEX:
            metadata = parse_record(MetadataIndex, body, record_offset)
            summary.records.append((metadata.offset, metadata.length))
        position += _RECORD_HEADER.size + size
    return Summary(
        summary.schemas,
        summary.channels,
        statistics,
        dict(sorted(summary.chunks.items())),
        _without_overlaps(summary.records),
        offset,
    )


def _without_overlaps(records: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Sort records by offset and drop overlapping ones: a damaged index may repeat an entry a million times."""
    separate: list[tuple[int, int]] = []
    for offset, length in sorted(set(records)):
        if not separate or offset >= sum(separate[-1]):
            separate.append((offset, length))
    return separate


def parse_record(kind: type[_Record], body: bytes, offset: int) -> _Record:
    """Parse a record's body as an MCAP type. `offset`: for the error message. Raises DamagedRecordError."""
    stream = ReadDataStream(BytesIO(body))
    try:
        return kind.read(stream)  # type: ignore[attr-defined]
    except (McapError, ValueError, struct.error, OverflowError) as error:
        raise DamagedRecordError(f"the {kind.__name__} record at byte {offset} does not parse: {error}") from error
