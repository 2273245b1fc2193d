# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a recorder is told, and what it tells."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cloth_sim_ros.session.writer import WriterOptions

RecorderState = Literal["opening", "recording", "closed", "failed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderStatus:
    """What a recording is doing, as of one moment."""

    state: RecorderState
    path: Path | None
    """The file being written, or written last; None before it exists."""
    bytes_written: int
    """Over all files of the session."""
    messages: int
    """That are in the files."""
    dropped: int
    """Droppable messages that found the queue full."""
    queue_depth: int
    """Messages waiting to be written."""
    queue_bytes: int
    error: str
    """Why the recording ended early, in one sentence; empty if it did not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderOptions:
    """How a session is recorded; the file's own layout is in `writer`."""

    writer: WriterOptions = field(default_factory=WriterOptions)
    queue_bytes: int = 256 << 20
    """Droppable messages are dropped while this much waits [bytes]."""
    backlog_bytes: int = 512 << 20
    """Where even the others pile up to this much, the recording ends behind them: bounded memory, and no holes."""
    split_bytes: int = 0
    """Ask for a new file when one holds this much [bytes]; 0 never."""
    split_seconds: float = 0.0
    """Ask for a new file when one spans this much session time [s]; 0 never."""
