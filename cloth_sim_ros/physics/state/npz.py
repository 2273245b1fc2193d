# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader of array archives (.npz) from untrusted bytes."""

from __future__ import annotations

import io
import lzma
import struct
import tokenize
import zipfile
import zlib

import numpy as np

from cloth_sim_ros.physics.arithmetic.deterministic_math import integer_sum

#: Largest size of all arrays together after decompression [bytes].
MAX_BYTES = 128 << 20
_MAX_ARRAYS = 1000
#: Signature of an array's entry in the archive's directory.
_ENTRY = b"PK\x01\x02"
#: Signature of the end of the directory, and the place of the number of entries in it.
_END, _END_COUNT = b"PK\x05\x06", 10
#: Exceptions of numpy's and Python's readers for damaged archives; numpy parses an array's header as Python text.
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
    # Includes NotImplementedError, for an unknown compression, and RecursionError, for a header.
    RuntimeError,
)


def read(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name, from its bytes; refuse damaged, large or pickled ones.

    Raises:
        ValueError: if the bytes are no .npz file, contain objects, or exceed `MAX_BYTES` or the number of arrays.
    """
    if data[:2] != b"PK":
        raise ValueError("it is no .npz file: it does not start as one")
    arrays: dict[str, np.ndarray] = {}
    if data.count(_ENTRY) > _MAX_ARRAYS:
        raise ValueError(f"it has more than {_MAX_ARRAYS} arrays; that is the limit")
    try:
        _check_sizes(data)
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            for name in stored.files:
                arrays[name] = stored[name]
    except _DAMAGE as error:
        raise ValueError(f"it is no .npz file: {error}") from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):
            raise ValueError(f"it is no .npz file: its entry '{name}' is no array")
    return arrays


def _check_sizes(data: bytes) -> None:
    """Raise ValueError if the arrays of an .npz file are too large or compressed unlike numpy's; read none."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
    # Python does not compare: a damaged length in the directory would hide the entries that follow.
    end = data.rfind(_END)
    (count,) = struct.unpack_from("<H", data, end + _END_COUNT)
    if count != len(entries):
        raise ValueError(f"its directory has {len(entries)} of {count} entries")
    size = integer_sum(entry.file_size for entry in entries)
    if size > MAX_BYTES:
        raise ValueError(f"its arrays have {size} bytes, the limit is {MAX_BYTES}")
    supported = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED
    unsupported = [entry.filename for entry in entries if entry.compress_type not in supported]
    if unsupported:
        raise ValueError(f"its entry '{unsupported[0]}' is compressed otherwise than numpy does")
