# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decompression of chunks that may ask for more memory than they deserve.

The compression ratio is no measure: the clouds of a cloth at rest compress a thousandfold. The size that the chunk
announces is: no more than that is ever unpacked, and no chunk may announce more than `MOST_BYTES`.
"""

from __future__ import annotations

import io

from cloth_sim_ros.session.errors import SessionError

#: Largest size of a chunk's content [bytes]. Recorders close chunks at some megabytes.
MOST_BYTES = 256 << 20
#: Largest window that a zstd frame may ask for, beside its content [bytes]; levels up to 19 take 8 MiB.
_MOST_WINDOW = 32 << 20
#: What lz4 is given, and what it gives, at a time [bytes].
_PIECE, _UNPACKED = 1 << 20, 8 << 20


class DecompressionError(ValueError):
    """Bytes that do not unpack to the size they announce, or announce too much."""


def decompress(payload: bytes, compression: str, size: int) -> bytes:
    """Return the content of a chunk.

    Args:
        payload: as it lies in the file.
        compression: name of the method: lz4, zstd, or empty for none.
        size: of the content, as the chunk announces it [bytes].

    Raises:
        DecompressionError: if it announces more than `MOST_BYTES`, or unpacks to another size.
        SessionError: if the library for the method is not installed.
    """
    if size > MOST_BYTES:
        raise DecompressionError(
            f"announces {size} bytes, the limit is {MOST_BYTES}; write the file anew with smaller chunks"
        )
    if compression == "":
        content = payload
    elif compression == "lz4":
        content = _lz4(payload, size)
    elif compression == "zstd":
        content = _zstd(payload, size)
    else:
        raise DecompressionError(f"is compressed with {compression!r}, known are lz4 and zstd")
    if len(content) != size:
        raise DecompressionError(f"announces {size} bytes and holds {_count(len(content), size)}")
    return content


def _lz4(payload: bytes, size: int) -> bytes:
    try:
        import lz4.frame
    except ImportError:
        raise SessionError("the session is compressed with lz4; install the Python package lz4") from None
    # In pieces: the library doubles its room as it goes, and copies what it has not read yet.
    content, decompressor = io.BytesIO(), lz4.frame.LZ4FrameDecompressor()
    try:
        for begin in range(0, len(payload), _PIECE):
            piece = payload[begin : begin + _PIECE]
            while not decompressor.eof and content.tell() <= size:
                content.write(decompressor.decompress(piece, max_length=_UNPACKED))
                piece = b""
                if decompressor.needs_input:
                    break
    except RuntimeError as error:
        raise DecompressionError(f"does not decompress: {error}") from error
    if not decompressor.eof and content.tell() <= size:
        raise DecompressionError("does not decompress: its lz4 frame is cut off")
    return content.getvalue()


def _zstd(payload: bytes, size: int) -> bytes:
    try:
        import zstandard
    except ImportError:
        raise SessionError("the session is compressed with zstd; install the Python package zstandard") from None
    try:
        announced = zstandard.get_frame_parameters(payload).content_size
        if announced not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise DecompressionError(f"announces {size} bytes, its zstd frame {announced}")
        reader = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW).stream_reader(payload)
        content: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise DecompressionError(f"does not decompress: {error}") from error
    return content


def _count(found: int, announced: int) -> str:
    return "more" if found > announced else str(found)
