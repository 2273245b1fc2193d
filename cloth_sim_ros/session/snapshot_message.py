# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Snapshot of a cloth as one message, from which a bag runs again.

A std_msgs/UInt8MultiArray holds the opening of a session file: MCAP with the metadata, the scene and the state.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.opcode import Opcode

from cloth_sim_ros.session.data_section import opening_records
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.mcap_builder import McapBuilder
from cloth_sim_ros.session.mcap_scan import DamagedRecordError, read_attachment, read_metadata
from cloth_sim_ros.session.opening import check_contents, check_header
from cloth_sim_ros.session.writer import (
    FILE_PREFIX,
    METADATA_NAME,
    SCENE_NAME,
    STATE_NAME,
    SessionSnapshot,
    encode_opening,
)

#: Key of the metadata: number of the first frame record behind the snapshot.
_SEQUENCE = "sequence"
#: CDR header, an empty layout (no dimensions, offset 0), and the number of bytes that follow.
_HEADER = struct.Struct("<4sIII")
_LITTLE = b"\x00\x01\x00\x00"
#: Limit of the digits of a sequence number.
_MAX_DIGITS = 19


@dataclass(frozen=True, slots=True, kw_only=True)
class BagSnapshot:
    """Snapshot of a cloth in a bag, with its node's run and the number of the next frame record."""

    session: str
    """Identifier of the node's run."""
    sequence: int
    """Number of the first frame record behind the snapshot."""
    snapshot: SessionSnapshot


def snapshot_bytes(snapshot: SessionSnapshot, *, session: str, sequence: int, stamp: int) -> bytes:
    """Encode a snapshot as a std_msgs/UInt8MultiArray, in CDR bytes.

    Args:
        snapshot: parameters and state before a frame.
        session: identifier of the node's run.
        sequence: number of that frame's record.
        stamp: ROS time [ns].
    """
    numbered = dataclasses.replace(snapshot, metadata={**snapshot.metadata, _SEQUENCE: str(sequence)})
    content = encode_opening(McapBuilder(compression="none"), numbered, session=session, part=0, log_time=stamp)
    return _HEADER.pack(_LITTLE, 0, 0, len(content)) + content


def read_snapshot(data: bytes) -> BagSnapshot:
    """Decode a snapshot from the bytes of its message. Raises SessionError for other or damaged bytes."""
    if len(data) < _HEADER.size:
        raise SessionError(f"a snapshot of {len(data)} bytes is cut off")
    header, dimensions, offset, size = _HEADER.unpack_from(data)
    if (header, dimensions, offset) != (_LITTLE, 0, 0) or size > len(data) - _HEADER.size:
        raise SessionError(f"a snapshot of {len(data)} bytes has no readable head")
    label, file = Path("a snapshot"), BytesIO(data[_HEADER.size : _HEADER.size + size])
    metadata: Mapping[str, str] = {}
    attachments: dict[str, bytes] = {}
    try:
        for location in opening_records(file, check_header(file, label)):
            if location.opcode == Opcode.ATTACHMENT:
                attachment = read_attachment(file, location)
                attachments[attachment.name] = attachment.data
            elif (record := read_metadata(file, location)).name == METADATA_NAME:
                metadata = record.metadata
    except DamagedRecordError as error:
        raise SessionError(f"a snapshot is damaged: {error}") from error
    check_contents(label, metadata, attachments)
    digits = metadata.get(_SEQUENCE, "")
    if not (digits.isascii() and digits.isdecimal() and len(digits) < _MAX_DIGITS):
        raise SessionError(f"a snapshot has the sequence number {digits[:_MAX_DIGITS]!r}; it must be a whole number")
    try:
        scene_yaml = attachments[SCENE_NAME].decode()
    except UnicodeDecodeError as error:
        raise SessionError(f"the parameters of a snapshot are no text: {error}") from error
    return BagSnapshot(
        session=metadata["session"],
        sequence=int(digits),
        snapshot=SessionSnapshot(
            scene_yaml=scene_yaml,
            state=attachments[STATE_NAME],
            metadata=metadata,
            files={
                name.removeprefix(FILE_PREFIX): content
                for name, content in attachments.items()
                if name.startswith(FILE_PREFIX)
            },
        ),
    )
