# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decompression of chunks with bounded memory.

The compression ratio is no safeguard: clouds of a cloth at rest compress by a factor of 1000. The announced size is: at
most that many bytes are unpacked, and a chunk may announce at most `MAX_CHUNK_BYTES`.
"""

from __future__ import annotations

import io

from cloth_sim_ros.session.errors import SessionError

#: Maximum size of a chunk's content [bytes]. Recorders close chunks at a few megabytes.
MAX_CHUNK_BYTES = 256 << 20
#: Maximum window of a zstd frame, in addition to its content [bytes]; levels up to 19 use 8 MiB.
_MAX_ZSTD_WINDOW = 32 << 20
#: Maximum input and output of one call of lz4 [bytes].
_LZ4_INPUT_BYTES, _LZ4_OUTPUT_BYTES = 1 << 20, 8 << 20


class DecompressionError(ValueError):
    """Error: compressed bytes do not unpack to their announced size, announce too much, or use an unknown method."""


def decompress(payload: bytes, compression: str, size: int) -> bytes:
    """Return a chunk's decompressed content. Raises DecompressionError unless it has the announced `size`.

    Args:
        payload: the compressed bytes.
        compression: name of the method: lz4, zstd, or empty for none.
        size: announced size of the content [bytes].

    Raises:
        DecompressionError: if `size` is above `MAX_CHUNK_BYTES`, or the content has another size.
        SessionError: if the library for the method is not installed.
    """
    if size > MAX_CHUNK_BYTES:
        limit = f"the limit is {MAX_CHUNK_BYTES}; rewrite the file with smaller chunks"
        raise DecompressionError(f"announces {size} bytes, {limit}")
    if compression == "":
        content = payload
    elif compression == "lz4":
        content = _lz4(payload, size)
    elif compression == "zstd":
        content = _zstd(payload, size)
    else:
        raise DecompressionError(f"is compressed with {compression!r}; known are lz4 and zstd")
    if len(content) != size:
        raise DecompressionError(f"announces {size} bytes and holds {_describe_size(len(content), size)}")
    return content


def _lz4(payload: bytes, size: int) -> bytes:
    try:
        import lz4.frame
    except ImportError:
        raise SessionError("the session is compressed with lz4; install the Python package lz4") from None
    # In pieces, because the library doubles its buffer repeatedly and copies unread input.
    content, decompressor = io.BytesIO(), lz4.frame.LZ4FrameDecompressor()
    try:
        for begin in range(0, len(payload), _LZ4_INPUT_BYTES):
            piece = payload[begin : begin + _LZ4_INPUT_BYTES]
            while not decompressor.eof and content.tell() <= size:
                content.write(decompressor.decompress(piece, max_length=_LZ4_OUTPUT_BYTES))
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
        reader = zstandard.ZstdDecompressor(max_window_size=_MAX_ZSTD_WINDOW).stream_reader(payload)
        content: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise DecompressionError(f"does not decompress: {error}") from error
    return content


def _describe_size(actual: int, announced: int) -> str:
    return "more" if actual > announced else str(actual)
