# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Copies of a session by the mcap library's reader and writer, like those of other tools."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.writer import Writer


class CopiedMessage(NamedTuple):
    """A message to copy."""

    topic: str
    data: bytes
    log_time: int
    publish_time: int
    sequence: int


def copy_by_tool(
    source: Path,
    target: Path,
    *,
    metadata: Callable[[str], bool] = lambda _name: True,
    attachments: Callable[[str], bool] = lambda _name: True,
    topics: Callable[[str], bool] = lambda _topic: True,
    contents_last: bool = False,
    more: tuple[Path, ...] = (),
    profile: str = "ros2",
    extra: Mapping[str, int] = MappingProxyType({}),
    **options: Any,
) -> Path:
    """Copy a session, and `more` behind it, with other channel numbers.

    Args:
        source: the session.
        target: its copy.
        metadata: returns True if the metadata record of a name is copied.
        attachments: returns True if the attachment of a name is copied.
        topics: returns True if a topic is copied.
        contents_last: True to write metadata and attachments after the messages.
        more: further files, as for `mcap merge`.
        profile: profile of the copy.
        extra: number of messages of other topics that are added at the end.
        options: options of the library's writer.
    """
    with target.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile=profile, library="a tool")
        # Other tools renumber schemas and channels.
        writer.register_schema(name="std_msgs/msg/Empty", encoding="ros2msg", data=b"")
        for path in (source, *more):
            if contents_last:
                _copy_messages(path, writer, topics)
            _copy_contents(path, writer, metadata, attachments)
            if not contents_last:
                _copy_messages(path, writer, topics)
        for topic, count in extra.items():
            schema = writer.register_schema("std_msgs/msg/Bool", "ros2msg", b"bool data")
            channel = writer.register_channel(topic, "cdr", schema)
            for sequence in range(count):
                writer.add_message(channel, sequence, b"\x00\x01\x00\x00\x01", sequence, sequence)
        writer.finish()
    return target


def _copy_contents(
    path: Path, writer: Writer, metadata: Callable[[str], bool], attachments: Callable[[str], bool]
) -> None:
    with path.open("rb") as stream:
        for record in make_reader(stream).iter_metadata():
            if metadata(record.name):
                writer.add_metadata(record.name, record.metadata)
    with path.open("rb") as stream:
        for attachment in make_reader(stream).iter_attachments():
            if attachments(attachment.name):
                writer.add_attachment(
                    attachment.create_time,
                    attachment.log_time,
                    attachment.name,
                    attachment.media_type,
                    attachment.data,
                )


def _copy_messages(path: Path, writer: Writer, topics: Callable[[str], bool]) -> None:
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is None or not topics(channel.topic):
                continue
            if schema.name not in schemas:
                schemas[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.name], dict(channel.metadata)
                )
            writer.add_message(
                channels[channel.topic],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
