# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files that a scene names: read once, their content carried with the scene, so that a recording can hold it too."""

from __future__ import annotations

import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from cloth_sim_ros.scene.parameters import ParameterError

#: Parameters that name a file.
NAMES = ("cloth.mesh", "cloth.springs", "initial_state")
#: The end of the name of a parameter that names an obstacle's file.
_OF_OBSTACLES = ".mesh"
#: A file larger than this is a mistake [bytes].
MOST_BYTES = 1 << 30
#: What is read at a time where a file holds more than it claims [bytes].
_PIECE = 1 << 20


def read(values: Mapping[str, Any], known: Mapping[str, bytes], folder: str | Path) -> dict[str, bytes]:
    """Return the content of every file that the values name, by the name they give it.

    Args:
        values: parameters by full name.
        known: content that is there already; it is not read again.
        folder: where relative names start.

    Raises:
        ParameterError: for a file that can't be read.
    """
    content: dict[str, bytes] = {}
    of_obstacles = [name for name in values if name.endswith(_OF_OBSTACLES) and name not in NAMES]
    for parameter in (*NAMES, *of_obstacles):
        name = values.get(parameter)
        if not isinstance(name, str) or not name:
            continue
        content[name] = known[name] if name in known else _content(parameter, Path(folder) / name)
    return content


def _content(parameter: str, path: Path) -> bytes:
    content = None
    try:
        status = path.stat()
        # To open a pipe would wait for its writer, and a device may never end. A folder says so when it is opened.
        on_disk = stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)
        if on_disk and status.st_size <= MOST_BYTES:
            with path.open("rb") as file:
                content = _bounded(file, status.st_size)
    except ValueError as error:
        # A null character, or one that the file system's encoding lacks.
        raise ParameterError(f"{parameter} {str(path)!r} is no file name: {error}") from error
    except OSError as error:
        raise ParameterError(f"{parameter}: cannot read '{path}': {error.strerror}") from error
    if content is not None:
        return content
    if not on_disk:
        raise ParameterError(f"{parameter} '{path}' is a device or a pipe; name a file on disk")
    size = str(status.st_size) if status.st_size > MOST_BYTES else f"more than {MOST_BYTES}"
    raise ParameterError(f"{parameter} '{path}' has {size} bytes; at most {MOST_BYTES} are read")


def _bounded(file: BinaryIO, size: int) -> bytes | None:
    """All of a file that claims so many bytes; None where it holds more than are read, whatever it claims."""
    pieces = [file.read(size + 1)]
    count = len(pieces[0])
    while count <= MOST_BYTES and (piece := file.read(_PIECE)):
        pieces.append(piece)
        count += len(piece)
    return b"".join(pieces) if count <= MOST_BYTES else None
