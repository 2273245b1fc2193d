# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""MCAP encoder: the bytes of a file, chunk by chunk.

The layouts of the records come from the mcap package. A session needs three properties that its Writer lacks. A chunk
that could not be written leaves file, indexes and statistics unchanged: a full disk still ends in a finished file.
Large messages are not copied. The compression level can be chosen.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from cloth_sim_ros.session.errors import SessionError

MAGIC = b"\x89MCAP0\r\n"
Compression = Literal["none", "lz4", "zstd"]

_MESSAGE_HEADER = struct.Struct("<BQHIQQ")
_MESSAGE_HEADER_SIZE = _MESSAGE_HEADER.size
_CHUNK_HEADER = struct.Struct("<BQQQQI")
_INDEX_HEADER = struct.Struct("<BQHI")


def compressor(compression: str) -> Callable[[bytes], bytes]:
    """Return the function that compresses a chunk's bytes: none (or empty), lz4 or zstd. Raises SessionError otherwise.

    Raises SessionError for an unknown name or a missing package.
    """
    if compression in ("none", ""):
        return bytes
    if compression == "lz4":
        try:
            import lz4.frame
        except ImportError:
            raise SessionError("compression lz4 needs the Python package lz4; choose none, or install it") from None
        pack_lz4: Callable[[bytes], bytes] = lz4.frame.compress
        return pack_lz4
    if compression == "zstd":
        try:
            import zstandard
        except ImportError:
            remedy = "choose none, or install it"
            raise SessionError(f"compression zstd needs the Python package zstandard; {remedy}") from None
        # Level 1: on float32 positions level 3 saves another 8 % for 2.5 times the work (docs/session.md).
        return zstandard.ZstdCompressor(level=1).compress
    raise SessionError(f"compression {compression!r} is unknown; choose none, lz4 or zstd")


def encode_record(record: McapRecord) -> bytes:
    """Return the bytes of one MCAP record: opcode, length and body."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _encode_all(records: Sequence[McapRecord]) -> bytes:
    return b"".join(map(encode_record, records))


@dataclass(slots=True)
class _OpenChunk:
    """Declarations and messages since the last committed chunk, with their message index."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    message_count: int = 0
    first_time: int = 0
    last_time: int = 0
    indexes: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    """By channel: log time [ns], offset [bytes], log time, offset ..."""

    def add(self, raw: bytes) -> None:
        self.parts.append(raw)
        self.size += len(raw)


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """Encoded chunk: its bytes, its index entry with offsets relative to its start, and message counts by channel."""

    parts: tuple[bytes, ...]
    """Chunk record and message index records."""
    index: ChunkIndex
    """Offsets relative to the start of `parts`."""
    counts: dict[int, int]
    """Number of messages by channel."""


class McapBuilder:
    """Encoder of the records of one MCAP file, in order, with its indexes.

    The caller writes the bytes from `encode_opening`, `pack_chunk`, `encode_metadata` and `encode_closing`. It calls
    `commit` when a chunk is in the file. The builder touches no file.
    """

    def __init__(self, *, compression: Compression) -> None:
        self._pack = compressor(compression)
        self._compression = "" if compression == "none" else compression
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._declared_counts = (0, 0)
        """Number of schemas and channels that the committed chunks declare."""
        self._chunk = _OpenChunk()
        # Encoded at once, to save memory: an hour of large clouds has 100,000 chunks.
        self._chunk_indexes = bytearray()
        self._chunk_count = 0
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._counts: dict[int, int] = defaultdict(int)
        self._times: tuple[int, int] | None = None

    @property
    def chunk_size(self) -> int:
        """Size of the open chunk before compression [bytes]."""
        return self._chunk.size

    @property
    def chunk_messages(self) -> int:
        """Number of messages in the open chunk."""
        return self._chunk.message_count

    @property
    def message_times(self) -> tuple[int, int] | None:
        """Earliest and latest log time of the committed chunks [ns]; None before the first."""
        return self._times

    def encode_opening(self, *, library: str, metadata: list[Metadata], attachments: list[Attachment]) -> bytes:
        """Return the file's first bytes (magic, header, metadata, attachments), and register them for the indexes."""
        parts = [MAGIC, encode_record(Header(profile="ros2", library=library))]
        offset = sum(map(len, parts))
        for record in [*metadata, *attachments]:
            raw = encode_record(record)
            if isinstance(record, Metadata):
                self._metadata_indexes.append(MetadataIndex(offset=offset, length=len(raw), name=record.name))
            else:
                self._attachment_indexes.append(_attachment_index(record, offset, len(raw)))
            parts.append(raw)
            offset += len(raw)
        return b"".join(parts)

    def add_channel(
        self, *, topic: str, schema: tuple[str, str, bytes], encoding: str, metadata: dict[str, str]
    ) -> int:
        """Declare a channel and its schema in the open chunk; return its id. `schema`: name, encoding, definition."""
        name, schema_encoding, schema_data = schema
        if name not in self._schemas:
            schema_id = len(self._schemas) + 1
            self._schemas[name] = Schema(id=schema_id, name=name, encoding=schema_encoding, data=schema_data)
            self._chunk.add(encode_record(self._schemas[name]))
        channel_id, schema_id = len(self._channels) + 1, self._schemas[name].id
        channel = Channel(id=channel_id, topic=topic, message_encoding=encoding, metadata=metadata, schema_id=schema_id)
        self._channels[channel.id] = channel
        self._chunk.add(encode_record(channel))
        return channel.id

    def add_message(self, channel: int, data: bytes, *, log_time: int, publish_time: int, sequence: int) -> None:
        """Add a message to the open chunk. `channel`: id from `add_channel`; times in nanoseconds since the epoch."""
        chunk = self._chunk
        if not chunk.message_count or log_time < chunk.first_time:
            chunk.first_time = log_time
        if log_time > chunk.last_time:
            chunk.last_time = log_time
        length = len(data)
        chunk.indexes[channel] += (log_time, chunk.size)
        chunk.message_count += 1
        chunk.parts += (_MESSAGE_HEADER.pack(5, 22 + length, channel, sequence, log_time, publish_time), data)
        chunk.size += _MESSAGE_HEADER_SIZE + length

    def pack_chunk(self) -> PackedChunk:
        """Return the open chunk compressed, with checksum and indexes. The chunk stays open until `commit`."""
        chunk = self._chunk
        raw = b"".join(chunk.parts)
        return pack_chunk_record(
            payload=self._pack(raw),
            compression=self._compression,
            raw_size=len(raw),
            crc=zlib.crc32(raw),
            times=(chunk.first_time, chunk.last_time),
            indexes=chunk.indexes,
        )

    def commit(self, packed: PackedChunk, offset: int) -> None:
        """Register the packed chunk as written at `offset`, and open an empty one; changes `packed.index`."""
        self.add_chunk_index(packed, offset)
        self._declared_counts = (len(self._schemas), len(self._channels))
        self._chunk = _OpenChunk()

    def add_chunk_index(self, packed: PackedChunk, offset: int) -> None:
        """Add a chunk written at `offset`, e.g. a copied one, to the file's indexes; changes `packed.index`."""
        index = packed.index
        index.chunk_start_offset += offset
        index.message_index_offsets = {key: value + offset for key, value in index.message_index_offsets.items()}
        self._chunk_indexes += encode_record(index)
        self._chunk_count += 1
        for channel, count in packed.counts.items():
            self._counts[channel] += count
        if not packed.counts:
            # A chunk of declarations has no times.
            return
        first, last = index.message_start_time, index.message_end_time
        self._times = (first, last) if self._times is None else (min(first, self._times[0]), max(last, self._times[1]))

    def set_declarations(self, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
        """Replace the schemas and channels (by id) of the file's indexes by those that copied chunks declare."""
        self._schemas = {str(key): schema for key, schema in schemas.items()}
        self._channels = dict(channels)
        self._declared_counts = (len(schemas), len(channels))

    def encode_metadata(self, record: Metadata, offset: int) -> bytes:
        """Return a metadata record's bytes and register it for the indexes; the caller writes it at `offset`."""
        raw = encode_record(record)
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=len(raw), name=record.name))
        return raw

    def encode_closing(self, offset: int) -> bytes:
        """Return the file's last bytes, to be written at `offset`: end of the data section, indexes and footer.

        The contents of the open chunk are left out, including its declarations.
        """
        schemas = list(self._schemas.values())[: self._declared_counts[0]]
        channels = list(self._channels.values())[: self._declared_counts[1]]
        end = encode_record(DataEnd(data_section_crc=0))
        start = offset + len(end)
        first, last = self._times or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            message_start_time=first,
            message_end_time=last,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(schemas),
        )
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, _encode_all(schemas)),
            (Opcode.CHANNEL, _encode_all(channels)),
            (Opcode.STATISTICS, encode_record(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _encode_all(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _encode_all(self._metadata_indexes)),
        ]
        offset_start = start
        offsets: list[SummaryOffset] = []
        for opcode, records in groups:
            if records:
                length = len(records)
                offsets.append(SummaryOffset(group_opcode=int(opcode), group_start=offset_start, group_length=length))
                offset_start += len(records)
        raw = b"".join([*(records for _, records in groups), _encode_all(offsets)])
        # The summary's checksum covers the footer up to the checksum itself.
        footer_header = struct.pack("<BQQQ", int(Opcode.FOOTER), 20, start, offset_start)
        crc = zlib.crc32(footer_header, zlib.crc32(raw))
        footer = encode_record(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc))
        return b"".join((end, raw, footer, MAGIC))


def pack_chunk_record(
    *, payload: bytes, compression: str, raw_size: int, crc: int, times: tuple[int, int], indexes: dict[int, list[int]]
) -> PackedChunk:
    """Encode a chunk of compressed contents and its message indexes; the result's offsets count from its start.

    `indexes`: for each channel, log time [ns] and offset in the contents [bytes] of each message, in turns.
    """
    name = compression.encode()
    tail = struct.pack("<I", len(name)) + name + struct.pack("<Q", len(payload))
    body = _CHUNK_HEADER.size - 9 + len(tail) + len(payload)
    head = _CHUNK_HEADER.pack(6, body, *times, raw_size, crc) + tail
    index_parts = []
    index_offsets = {}
    length = len(head) + len(payload)
    position = length
    for channel, entries in indexes.items():
        size = 8 * len(entries)
        raw = _INDEX_HEADER.pack(7, 6 + size, channel, size) + struct.pack(f"<{len(entries)}Q", *entries)
        index_offsets[channel] = position
        index_parts.append(raw)
        position += len(raw)
    return PackedChunk(
        parts=(head, payload, b"".join(index_parts)),
        index=ChunkIndex(
            chunk_length=length,
            chunk_start_offset=0,
            compression=compression,
            compressed_size=len(payload),
            message_end_time=times[1],
            message_index_length=position - length,
            message_index_offsets=index_offsets,
            message_start_time=times[0],
            uncompressed_size=raw_size,
        ),
        counts={channel: len(entries) // 2 for channel, entries in indexes.items()},
    )


def _attachment_index(record: McapRecord, offset: int, length: int) -> AttachmentIndex:
    assert isinstance(record, Attachment)
    return AttachmentIndex(
        offset=offset,
        length=length,
        create_time=record.create_time,
        log_time=record.log_time,
        data_size=len(record.data),
        name=record.name,
        media_type=record.media_type,
    )
