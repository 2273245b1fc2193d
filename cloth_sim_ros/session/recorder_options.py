# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options and status of a recorder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cloth_sim_ros.session.writer import WriterOptions

RecorderState = Literal["opening", "recording", "closed", "failed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderStatus:
    """Status of a recording at one time: state, file, sizes, counts of messages, queue and error."""

    state: RecorderState
    path: Path | None
    """The current or last file; None before it exists."""
    bytes_written: int
    """Size of all files of the session [bytes]."""
    messages: int
    """Number of messages in the files."""
    dropped: int
    """Number of messages dropped because the queue was full."""
    queue_depth: int
    """Number of queued messages."""
    queue_bytes: int
    error: str
    """Reason of an early end, in one sentence; empty if there was none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderOptions:
    """Options of a recorder: limits of its queue [bytes] and of a file [bytes, s]; file format in `writer`."""

    writer: WriterOptions = field(default_factory=WriterOptions)
    queue_bytes: int = 256 << 20
    """Queue size above which droppable messages are dropped [bytes]."""
    backlog_bytes: int = 512 << 20
    """Queue size above which the recording ends after the queued messages, to bound memory without gaps [bytes]."""
    split_bytes: int = 0
    """Size at which a new file is requested [bytes]; 0 for never."""
    split_seconds: float = 0.0
    """Span of session time at which a new file is requested [s]; 0 for never."""
