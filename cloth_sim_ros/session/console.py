# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The streams of a command."""

from __future__ import annotations

import io
import sys


def escape_unencodable() -> None:
    """Write as escapes what the terminal's encoding lacks: a file's name may be of bytes that are no text."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
