# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of an MCAP file that is not a session, such as a robot's bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from cloth_sim_ros.session.errors import DamagedSessionError
from cloth_sim_ros.session.mcap_builder import MAGIC
from cloth_sim_ros.session.mcap_scan import (
    DamagedRecordError,
    RawMessage,
    chunk_records,
    locate_record,
    parse_message,
    parse_record,
    read_body,
    read_chunk,
)
from cloth_sim_ros.session.opening import open_file


def bag_messages(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield topic, type, log time [ns] and CDR bytes of each message with encoding `cdr`, in the order of the file.

    Raises:
        SessionError: if the file cannot be read, or is damaged.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with open_file(path) as file:
        try:
            for record in _records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                else:
                    channel = channels.get(record.channel)
                    schema = None if channel is None else schemas.get(channel.schema_id)
                    if channel is not None and schema is not None and channel.message_encoding == "cdr":
                        yield channel.topic, schema.name, record.log_time, record.data
        except DamagedRecordError as error:
            raise DamagedSessionError(f"{path} can't be read as MCAP: {error}; repair it first") from error


def _records(file: BinaryIO) -> Iterator[Schema | Channel | RawMessage]:
    """Yield declarations and messages, in chunks or outside of them."""
    position = len(MAGIC)
    while (location := locate_record(file, position)) is not None:
        position = location.end
        if location.opcode == Opcode.CHUNK:
            for _, record in chunk_records(read_chunk(file, location)):
                yield record
        elif location.opcode == Opcode.MESSAGE:
            yield parse_message(read_body(file, location), location.offset)
        elif location.opcode == Opcode.SCHEMA:
            yield parse_record(Schema, read_body(file, location), location.offset)
        elif location.opcode == Opcode.CHANNEL:
            yield parse_record(Channel, read_body(file, location), location.offset)
        elif location.opcode == Opcode.DATA_END:
            return
    raise DamagedRecordError(f"it ends at byte {position} or later, without the end of its data")
