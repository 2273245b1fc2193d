# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a file that is not a session, such as a robot's bag."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from cloth_sim_ros.session import ros1_bag
from cloth_sim_ros.session.errors import DamagedSessionError, SessionError
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
    read_summary,
)
from cloth_sim_ros.session.opening import open_file

#: Type of snapshots, and the end of their topics.
SNAPSHOT_TYPE, SNAPSHOT_LEAF = "std_msgs/msg/UInt8MultiArray", "/snapshot"
#: Number of messages of an unfinished file in which snapshots are searched.
_MAX_PROBED_MESSAGES = 10_000
#: Endings of the files of a bag: MCAP, and SQLite, the default of ROS 2 Humble.
_SQLITE = ".db3"
_ENDINGS = (".mcap", _SQLITE)


def bag_files(path: Path) -> list[Path]:
    """Return a bag folder's .mcap and .db3 files in recording order; of a file, a list of it. Raises SessionError.

    Raises:
        SessionError: for a folder without such files.
    """
    if not path.is_dir():
        return [path]
    files = [file for file in path.iterdir() if file.suffix in _ENDINGS]
    if not files:
        raise SessionError(f"{path} is a folder without {' or '.join(_ENDINGS)} files: no bag is in it")
    # Rosbag2 counts the files of a split bag: bag_0, bag_1, ... bag_10.
    return sorted(files, key=lambda file: [int(part) for part in re.findall(r"\d+", file.stem)[-1:]])


def is_bag(path: Path) -> bool:
    """Return True if a file, or one in a folder, has snapshots of a cloth or is SQLite; False if it cannot be read."""
    if path.is_dir():
        return any(file.suffix in _ENDINGS and not file.is_dir() and is_bag(file) for file in path.iterdir())
    if path.suffix == _SQLITE:
        return True
    try:
        with open_file(path) as file:
            summary = read_summary(file) if path.stat().st_size > len(MAGIC) else None
            if summary is not None and summary.channels:
                channels = ((entry.topic, summary.schemas.get(entry.schema_id)) for entry in summary.channels.values())
                return any(is_snapshot(topic, schema.name) for topic, schema in channels if schema is not None)
        first_messages = itertools.islice(bag_messages(path), _MAX_PROBED_MESSAGES)
        return any(is_snapshot(topic, kind) for topic, kind, _, _ in first_messages)
    except (SessionError, DamagedRecordError):
        return False


def is_snapshot(topic: str, type_name: str) -> bool:
    """Return True if a topic's name and message type are those of a cloth's snapshots."""
    return topic.endswith(SNAPSHOT_LEAF) and type_name == SNAPSHOT_TYPE


def bag_messages(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield (topic, type, log time [ns], CDR bytes) of a bag file's `cdr` messages, as recorded. Raises SessionError.

    A file that ends with .db3 is SQLite, one that ends with .bag is a bag of ROS 1, any other one is MCAP.

    Raises:
        SessionError: if the file cannot be read, or is damaged.
    """
    if path.suffix == _SQLITE:
        yield from _sqlite_messages(path)
        return
    if path.suffix == ros1_bag.ENDING:
        yield from ros1_bag.ros1_messages(path)
        return
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


def _sqlite_messages(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    try:
        from rosbags.rosbag2 import Reader
    except ImportError as error:
        raise SessionError(f"{path} needs {error.name}, which is not installed: pip install rosbags") from error

    # Refuses pipes and devices.
    open_file(path).close()
    count = 0
    try:
        with Reader(path) as reader:
            for connection, log_time, data in reader.messages():
                topic, kind = connection.topic, connection.msgtype
                # Columns of SQLite hold values of any type.
                if not (isinstance(topic, str) and isinstance(kind, str) and isinstance(data, bytes | memoryview)):
                    raise DamagedSessionError(f"{path} has a message whose topic, type or data is of a wrong type")
                yield topic, kind, log_time, bytes(data)
                count += 1
    except SessionError:
        raise
    except Exception as error:  # Errors of several libraries.
        error_class = DamagedSessionError if count else SessionError
        raise error_class(f"{path} can't be read as a bag of SQLite: {error}") from error
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise DamagedSessionError(
            f"{log} holds messages that are not read, because the recorder did not end: run "
            f"`sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'`"
        )


def _records(file: BinaryIO) -> Iterator[Schema | Channel | RawMessage]:
    """Yield the schemas, channels and messages of an MCAP file, in or outside chunks. Raises DamagedRecordError."""
    position = len(MAGIC)
    if file.read(position) != MAGIC:
        raise DamagedRecordError("it does not begin as one")
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
