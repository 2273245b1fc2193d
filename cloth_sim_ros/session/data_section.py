# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data section of an MCAP file that another tool wrote.

MCAP allows messages without chunks, chunks without indexes, and metadata and attachments anywhere in the data section.
The recorder writes none of these; the mcap library and the tools that copy, filter, sort or merge files do.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from cloth_sim_ros.session.bag import is_snapshot
from cloth_sim_ros.session.errors import NotASessionError, StrippedSessionError
from cloth_sim_ros.session.mcap_scan import (
    MESSAGE_HEADER_SIZE,
    RECORD_HEADER_SIZE,
    Chunk,
    DamagedRecordError,
    RecordLocation,
    Summary,
    locate_record,
    parse_record,
    read_body,
)
from cloth_sim_ros.session.writer import METADATA_NAME, SCENE_NAME, STATE_NAME

_UNCHUNKED_OPCODES = (int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE))
_CONTENT_OPCODES = (Opcode.METADATA, Opcode.ATTACHMENT)
_RECORD_HEADER = struct.Struct("<BQ")
#: Size of a DataEnd record [bytes].
_DATA_END_SIZE = RECORD_HEADER_SIZE + 4
#: Size of the records outside of chunks that are returned as one chunk; a larger record stands alone [bytes].
_READ_SIZE = 1 << 20
#: Upper bound of the offsets in a message index: a chunk is smaller [bytes].
_MAX_CHUNK_OFFSET = 1 << 31
_STRING = "std_msgs/msg/String"


def is_fully_indexed(file: BinaryIO, summary: Summary, data_start: int) -> bool:
    """Return True if a file's indexes name all records of its data section but message indexes, with right lengths.

    The lengths in the indexes are checked: one that is too large would hide a chunk.
    """
    position, end = data_start, summary.start - _DATA_END_SIZE
    records = dict(summary.records)
    while position < end:
        file.seek(position)
        header = file.read(RECORD_HEADER_SIZE)
        if len(header) < RECORD_HEADER_SIZE:
            return False
        opcode, size = _RECORD_HEADER.unpack(header)
        length = RECORD_HEADER_SIZE + size
        if opcode == Opcode.CHUNK:
            index = summary.chunks.get(position)
            known = index is not None and index.chunk_length == length
        else:
            known = opcode == Opcode.MESSAGE_INDEX or (opcode in _CONTENT_OPCODES and records.get(position) == length)
        if not known:
            return False
        position += length
    return position == end


def has_content_index(summary: Summary | None) -> bool:
    """Return True if the summary names every metadata record and attachment; False without summary or statistics."""
    statistics = None if summary is None else summary.statistics
    if summary is None or statistics is None:
        return False
    return len(summary.records) == statistics.metadata_count + statistics.attachment_count


def opening_records(file: BinaryIO, data_start: int) -> Iterator[RecordLocation]:
    """Yield the locations of metadata and attachments before the first chunk or message. Raises DamagedRecordError."""
    position = data_start
    while (location := locate_record(file, position)) is not None and location.opcode not in (
        Opcode.CHUNK,
        Opcode.MESSAGE,
    ):
        if location.opcode in _CONTENT_OPCODES:
            yield location
        if location.opcode == Opcode.DATA_END:
            return
        position = location.end


def content_records(file: BinaryIO, data_start: int) -> Iterator[RecordLocation]:
    """Yield locations of all metadata and attachments, up to the data section's end or its first damaged record."""
    position = data_start
    try:
        while (location := locate_record(file, position)) is not None and location.opcode != Opcode.DATA_END:
            if location.opcode in _CONTENT_OPCODES:
                yield location
            position = location.end
    except DamagedRecordError:
        # Reading the messages reports the damage.
        return


def read_unchunked(file: BinaryIO, location: RecordLocation) -> Chunk | None:
    """Read schemas, channels and messages outside of chunks, from `location` on (1 MiB), as a chunk; None for others.

    None if `location` holds none of these. Raises DamagedRecordError if a record does not parse.
    """
    if location.opcode not in _UNCHUNKED_OPCODES:
        return None
    _check_unchunked(location, read_body(file, location))
    file.seek(location.offset)
    raw = file.read(max(_READ_SIZE, location.end - location.offset))
    end = 0
    while end + RECORD_HEADER_SIZE <= len(raw):
        opcode, size = _RECORD_HEADER.unpack_from(raw, end)
        start, next_start = end + RECORD_HEADER_SIZE, end + RECORD_HEADER_SIZE + size
        if opcode not in _UNCHUNKED_OPCODES or next_start > len(raw):
            break
        try:
            _check_unchunked(RecordLocation(opcode, location.offset + end, size), raw[start:next_start])
        except DamagedRecordError:
            # The next call reads this record first, and raises.
            break
        end = next_start
    location = RecordLocation(location.opcode, location.offset, end - RECORD_HEADER_SIZE)
    raw = raw[:end]
    return Chunk(location=location, compression="", payload=raw, raw=raw, crc=0, has_checksum=False)


def check_data_end(file: BinaryIO, location: RecordLocation) -> None:
    """Check the data section's checksum, if it has one, by reading the file up to there. Raises DamagedRecordError.

    A file without this checksum passes.
    """
    expected_crc = int.from_bytes(read_body(file, location), "little")
    if not expected_crc:
        return
    file.seek(0)
    remaining, crc = location.offset, 0
    while remaining:
        piece = file.read(min(remaining, _READ_SIZE))
        crc, remaining = zlib.crc32(piece, crc), remaining - len(piece)
    if crc != expected_crc:
        raise DamagedRecordError("the data section fails its checksum: a message outside of chunks may be damaged")


def check_not_stripped(
    path: Path, metadata: Mapping[str, str], attachments: Container[str], channels: Mapping[str, str]
) -> None:
    """Raise NotASessionError for another recorder's bag, StrippedSessionError for a session copied without its opening.

    Args:
        path: the file.
        metadata: of its opening; empty if absent.
        attachments: their names.
        channels: message types by topic.

    Raises:
        NotASessionError: for a bag with frames and snapshots.
        StrippedSessionError: if the file has the frames of a session but not its opening.
    """
    if not metadata and any(is_snapshot(topic, kind) for topic, kind in channels.items()):
        raise NotASessionError(f"{path} is a bag of another recorder; cloth_verify alone reads it")
    is_recorded = bool(metadata) or any(
        kind == _STRING and topic.endswith("/frame") and f"{topic[:-6]}/topology" in channels
        for topic, kind in channels.items()
    )
    files = [name for name in (SCENE_NAME, STATE_NAME) if name not in attachments]
    missing_parts = [] if metadata else [f"the metadata record '{METADATA_NAME}'"]
    if files:
        missing_parts.append(f"the attachment{'s' * (len(files) > 1)} {' and '.join(files)}")
    if is_recorded and missing_parts:
        raise StrippedSessionError(
            f"{path} was recorded by cloth_sim, but it lacks its opening, {' and '.join(missing_parts)}, as after a "
            f"copy by a "
            "tool that leaves these out: nothing can be run again; give the original file, or copy it with metadata "
            "and attachments (mcap filter --include-metadata --include-attachments; ros2 bag convert keeps neither)"
        )


def _check_unchunked(location: RecordLocation, body: bytes) -> None:
    if location.opcode == Opcode.SCHEMA:
        parse_record(Schema, body, location.offset)
    elif location.opcode == Opcode.CHANNEL:
        parse_record(Channel, body, location.offset)
    elif len(body) < MESSAGE_HEADER_SIZE or _is_message_index(body):
        raise DamagedRecordError(f"the message at byte {location.offset} does not parse")


def _is_message_index(body: bytes) -> bool:
    """Return True if a record's body has the layout of a message index: one flipped bit makes its opcode a message's.

    In a message the same bytes are an arbitrary sequence number and a publish time, which is larger than any offset.
    """
    size = int.from_bytes(body[2:6], "little")
    offset = int.from_bytes(body[14:22], "little")
    return size % 16 == 0 and len(body) == 6 + size and offset < _MAX_CHUNK_OFFSET
