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

from cloth_sim_ros.session.errors import StrippedSessionError
from cloth_sim_ros.session.mcap_scan import (
    MESSAGE_HEAD,
    RECORD_HEAD,
    Chunk,
    DamagedRecordError,
    RecordPlace,
    Summary,
    parse_record,
    place_at,
    read_body,
)
from cloth_sim_ros.session.writer import METADATA_NAME, SCENE_NAME, STATE_NAME

_BARE = (int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE))
_CONTENTS = (Opcode.METADATA, Opcode.ATTACHMENT)
_HEAD = struct.Struct("<BQ")
#: Size of a DataEnd record [bytes].
_DATA_END = RECORD_HEAD + 4
#: Size of the records outside of chunks that are returned as one chunk; a larger record stands alone [bytes].
_TOGETHER = 1 << 20
#: Upper bound of the offsets in a message index: a chunk is smaller [bytes].
_LARGEST_OFFSET = 1 << 31
_STRING = "std_msgs/msg/String"


def covers_all(file: BinaryIO, summary: Summary, data_start: int) -> bool:
    """Return True if the indexes name everything in the data section except the message indexes.

    The lengths in the indexes are checked: one that is too large would hide a chunk.
    """
    position, end = data_start, summary.start - _DATA_END
    records = dict(summary.records)
    while position < end:
        file.seek(position)
        head = file.read(RECORD_HEAD)
        if len(head) < RECORD_HEAD:
            return False
        opcode, size = _HEAD.unpack(head)
        length = RECORD_HEAD + size
        if opcode == Opcode.CHUNK:
            index = summary.chunks.get(position)
            known = index is not None and index.chunk_length == length
        else:
            known = opcode == Opcode.MESSAGE_INDEX or (opcode in _CONTENTS and records.get(position) == length)
        if not known:
            return False
        position += length
    return position == end


def indexes_contents(summary: Summary | None) -> bool:
    """Return True if the indexes name every metadata record and every attachment of the file."""
    statistics = None if summary is None else summary.statistics
    if summary is None or statistics is None:
        return False
    return len(summary.records) == statistics.metadata_count + statistics.attachment_count


def opening_places(file: BinaryIO, data_start: int) -> Iterator[RecordPlace]:
    """Yield metadata and attachments before the first chunk or message. Raises DamagedRecordError."""
    position = data_start
    while (place := place_at(file, position)) is not None and place.opcode not in (Opcode.CHUNK, Opcode.MESSAGE):
        if place.opcode in _CONTENTS:
            yield place
        if place.opcode == Opcode.DATA_END:
            return
        position = place.end


def further_places(file: BinaryIO, data_start: int) -> Iterator[RecordPlace]:
    """Yield metadata and attachments of the whole data section, up to its end or to the first damaged record."""
    position = data_start
    try:
        while (place := place_at(file, position)) is not None and place.opcode != Opcode.DATA_END:
            if place.opcode in _CONTENTS:
                yield place
            position = place.end
    except DamagedRecordError:
        # Reading the messages reports the damage.
        return


def read_bare(file: BinaryIO, place: RecordPlace) -> Chunk | None:
    """Return schemas, channels and messages outside of chunks, from `location` on, as one chunk without a checksum.

    None if `location` holds none of these. Raises DamagedRecordError if a record does not parse.
    """
    if place.opcode not in _BARE:
        return None
    _check_bare(place, read_body(file, place))
    file.seek(place.offset)
    raw = file.read(max(_TOGETHER, place.end - place.offset))
    end = 0
    while end + RECORD_HEAD <= len(raw):
        opcode, size = _HEAD.unpack_from(raw, end)
        start, following = end + RECORD_HEAD, end + RECORD_HEAD + size
        if opcode not in _BARE or following > len(raw):
            break
        try:
            _check_bare(RecordPlace(opcode, place.offset + end, size), raw[start:following])
        except DamagedRecordError:
            # The next call reads this record first, and raises.
            break
        end = following
    return Chunk(
        place=RecordPlace(place.opcode, place.offset, end - RECORD_HEAD),
        compression="",
        payload=raw[:end],
        raw=raw[:end],
        crc=0,
        checked=False,
    )


def check_data_end(file: BinaryIO, place: RecordPlace) -> None:
    """Check the checksum of the data section, the only one of messages outside of chunks. Raises DamagedRecordError.

    A file without this checksum passes.
    """
    wanted = int.from_bytes(read_body(file, place), "little")
    if not wanted:
        return
    file.seek(0)
    left, found = place.offset, 0
    while left:
        piece = file.read(min(left, _TOGETHER))
        found, left = zlib.crc32(piece, found), left - len(piece)
    if found != wanted:
        raise DamagedRecordError("the data section fails its checksum: a message outside of chunks may be damaged")


def check_stripped(
    path: Path, metadata: Mapping[str, str], attachments: Container[str], channels: Mapping[str, str]
) -> None:
    """Refuse a copy of a session from which a tool left out the opening.

    Args:
        path: the file.
        metadata: of its opening; empty if absent.
        attachments: their names.
        channels: message types by topic.

    Raises:
        StrippedSessionError: if the file has the frames of a session but not its opening.
    """
    recorded = bool(metadata) or any(
        kind == _STRING and topic.endswith("/frame") and f"{topic[:-6]}/topology" in channels
        for topic, kind in channels.items()
    )
    files = [name for name in (SCENE_NAME, STATE_NAME) if name not in attachments]
    absent = [] if metadata else [f"the metadata record '{METADATA_NAME}'"]
    if files:
        absent.append(f"the attachment{'s' * (len(files) > 1)} {' and '.join(files)}")
    if recorded and absent:
        raise StrippedSessionError(
            f"{path} was recorded by cloth_sim, but it lacks its opening, {' and '.join(absent)}, as after a copy by a "
            "tool that leaves these out: nothing can be run again; give the original file, or copy it with metadata "
            "and attachments (mcap filter --include-metadata --include-attachments; ros2 bag convert keeps neither)"
        )


def _check_bare(place: RecordPlace, body: bytes) -> None:
    if place.opcode == Opcode.SCHEMA:
        parse_record(Schema, body, place.offset)
    elif place.opcode == Opcode.CHANNEL:
        parse_record(Channel, body, place.offset)
    elif len(body) < MESSAGE_HEAD or _is_index(body):
        raise DamagedRecordError(f"the message at byte {place.offset} does not parse")


def _is_index(body: bytes) -> bool:
    """Return True for the body of a message index: one flipped bit turns its opcode into that of a message.

    In a message the same bytes are an arbitrary sequence number and a publish time, which is larger than any offset.
    """
    size = int.from_bytes(body[2:6], "little")
    offset = int.from_bytes(body[14:22], "little")
    return size % 16 == 0 and len(body) == 6 + size and offset < _LARGEST_OFFSET
