# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages in a pipe between two processes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO

#: Lengths of topic and contents [bytes].
_HEAD = struct.Struct("<HI")


def pack(topic: str, data: bytes) -> bytes:
    """Return a message as bytes for the pipe: lengths, topic and contents, which `unpack` reads."""
    name = topic.encode()
    return b"".join((_HEAD.pack(len(name), len(data)), name, data))


def unpack(stream: BinaryIO) -> Iterator[tuple[str, bytes]]:
    """Yield (topic, contents) of each message; blocks until the pipe ends. A message that was cut off is left out."""
    while len(head := stream.read(_HEAD.size)) == _HEAD.size:
        name_length, length = _HEAD.unpack(head)
        body = stream.read(name_length + length)
        if len(body) < name_length + length:
            return
        yield body[:name_length].decode(), body[name_length:]
