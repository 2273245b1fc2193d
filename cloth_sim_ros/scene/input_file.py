# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounded reading of input files of any origin."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import BinaryIO

#: Largest configuration file [bytes]: a scene, a study, a script, or code that a study names.
MAX_TEXT = 1 << 24
#: Size of a chunk for files that hold more than they claim [bytes].
_CHUNK_BYTES = 1 << 20


class InputFileError(ValueError):
    """Error: an input file is too large, not a regular file, or no UTF-8; the message names the file and the reason."""


def read_bytes(path: str | Path, *, max_bytes: int = MAX_TEXT) -> bytes:
    """Read a whole regular file; raise InputFileError above `max_bytes` and for a device, pipe or socket, else OSError.

    Args:
        path: path of the file.
        max_bytes: largest accepted size [bytes].

    Raises:
        InputFileError: for a larger file, and for a device, a pipe or a socket, which might never end.
        OSError: if the file can't be read.
        ValueError: if the path is no file name.
    """
    path = Path(path)
    status = path.stat()
    # Opening a folder raises an error of its own.
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise InputFileError(f"'{path}' is a device or a pipe; name a file on disk")
    if status.st_size > max_bytes:
        raise InputFileError(f"'{path}' has {status.st_size} bytes; at most {max_bytes} are read")
    with path.open("rb") as file:
        content = _read_bounded(file, status.st_size, max_bytes)
    if content is None:
        raise InputFileError(f"'{path}' has more than {max_bytes} bytes; at most {max_bytes} are read")
    return content


def read_text(path: str | Path, *, max_bytes: int = MAX_TEXT) -> str:
    """Read a whole regular file as UTF-8 text; raise InputFileError if it is none, and the errors of `read_bytes`."""
    try:
        return read_bytes(path, max_bytes=max_bytes).decode()
    except UnicodeDecodeError as error:
        raise InputFileError(f"'{path}' is no text in UTF-8: {error}") from error


def _read_bounded(file: BinaryIO, size: int, max_bytes: int) -> bytes | None:
    """Read an open file of expected `size` to its end; return its bytes, or None if there are more than `max_bytes`."""
    chunks = [file.read(size + 1)]
    n_bytes = len(chunks[0])
    while n_bytes <= max_bytes and (chunk := file.read(_CHUNK_BYTES)):
        chunks.append(chunk)
        n_bytes += len(chunk)
    return b"".join(chunks) if n_bytes <= max_bytes else None
