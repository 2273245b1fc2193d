# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the opening of a session file."""

from __future__ import annotations

import stat
from collections.abc import Container, Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Header

from cloth_sim_ros.session.errors import DamagedSessionError, NotASessionError, SessionError
from cloth_sim_ros.session.mcap_builder import MAGIC
from cloth_sim_ros.session.mcap_scan import DamagedRecordError, locate_record, parse_record, read_body
from cloth_sim_ros.session.writer import FORMAT_VERSION, METADATA_NAME, SCENE_NAME, STATE_NAME, metadata_checksum

#: Limit of the digits of a file's index.
_MAX_PART_DIGITS = 10


def open_file(path: Path) -> BinaryIO:
    """Open a file on disk to read bytes. Raises SessionError if it is absent, unreadable, a folder, device or pipe."""
    try:
        mode = path.stat().st_mode
        # Opening a pipe would wait for its writer, and a device may never end.
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise SessionError(f"{path} is a device or a pipe; give a file on disk")
        return path.open("rb")
    except FileNotFoundError:
        raise SessionError(f"{path} does not exist") from None
    except IsADirectoryError:
        raise SessionError(f"{path} is a folder; give the .mcap file in it") from None
    except OSError as error:
        raise SessionError(f"cannot read {path}: {error.strerror}") from error


def check_header(file: BinaryIO, path: Path) -> int:
    """Check magic and header; return the offset of the next record. Raises NotASessionError or DamagedSessionError."""
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotASessionError(f"{path} is not an MCAP file")
    try:
        location = locate_record(file, len(MAGIC))
        header = None if location is None else parse_record(Header, read_body(file, location), location.offset)
    except DamagedRecordError as error:
        raise DamagedSessionError(f"{path}: {error}") from error
    if location is None or header is None:
        raise DamagedSessionError(f"{path} ends inside its opening: nothing was recorded")
    if location.opcode != Opcode.HEADER or header.profile not in ("ros2", ""):
        raise NotASessionError(f"{path} has MCAP profile {header.profile!r}, a session has 'ros2'")
    return location.end


def check_contents(path: Path, metadata: Mapping[str, str], attachments: Container[str]) -> None:
    """Raise NotASessionError or DamagedSessionError for an opening with absent or damaged metadata, scene or state."""
    if not metadata:
        cause = f"an MCAP without the metadata record {METADATA_NAME!r}"
        raise NotASessionError(f"{path} is {cause}: cloth_sim did not record it")
    if metadata.get("checksum") != metadata_checksum(metadata):
        raise DamagedSessionError(f"{path}: the metadata record {METADATA_NAME!r} fails its checksum")
    if metadata.get("format") != FORMAT_VERSION:
        formats = f"session format {metadata.get('format')!r}, this version reads {FORMAT_VERSION!r}"
        raise NotASessionError(f"{path} has {formats}; use the version that recorded it")
    part_text = metadata.get("part", "")
    is_part = part_text.isascii() and part_text.isdecimal() and len(part_text) < _MAX_PART_DIGITS
    if "session" not in metadata or not is_part:
        cause = f"does not tell which file of which session it is: its part is {part_text[:_MAX_PART_DIGITS]!r}"
        raise DamagedSessionError(f"{path}: the metadata record {METADATA_NAME!r} {cause}")
    absent = [name for name in (SCENE_NAME, STATE_NAME) if name not in attachments]
    if absent:
        raise DamagedSessionError(f"{path} lacks its {' and '.join(absent)}: nothing can be run again")
