# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Standard output and error of a command: characters that the terminal lacks or obeys are escaped."""

from __future__ import annotations

import io
import sys


def escape_unencodable() -> None:
    """Make standard output and error escape characters that their encoding lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def printable(text: str, *, keep: str = "") -> str:
    """Return a text with its unprintable characters escaped, because names in a file may control the terminal.

    Args:
        text: the text.
        keep: unprintable characters that stay.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)
