# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Archives of arrays (.npz) from bytes that may be anything."""

from __future__ import annotations

import io
import lzma
import struct
import tokenize
import zipfile
import zlib

import numpy as np

#: What numpy's and Python's readers raise for damaged archives: numpy parses an array's header as Python text.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    tokenize.TokenError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    EOFError,
    OSError,
    OverflowError,
    MemoryError,
    # Also NotImplementedError, for a compression that is not known, and RecursionError, for a header.
    RuntimeError,
)


def read(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name; objects are refused.

    Raises:
        ValueError: if the bytes are no .npz file of arrays.
    """
    if data[:2] != b"PK":
        raise ValueError("it is no .npz file: it does not start as one")
    arrays: dict[str, np.ndarray] = {}
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            for name in stored.files:
                arrays[name] = stored[name]
    except _DAMAGE as error:
        raise ValueError(f"it is no .npz file: {error}") from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):
            raise ValueError(f"it is no .npz file: its entry '{name}' is no array")
    return arrays
