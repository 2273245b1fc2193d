# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small files that demand much memory or time, and measurement of their readers."""

from __future__ import annotations

import io
import struct
import subprocess
import time
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

_CHUNK, _MESSAGE = 6, 5


def record(opcode: int, body: bytes) -> bytes:
    """Return an MCAP record."""
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(payload: bytes, compression: str, size: int, crc: int = 0) -> bytes:
    """Return a chunk record with an announced size of its content."""
    name = compression.encode()
    head = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name
    return record(_CHUNK, head + struct.pack("<Q", len(payload)) + payload)


def opening(session: Path) -> bytes:
    """Return the bytes of a session before its first chunk."""
    from cloth_sim_ros.session.mcap_scan import locate_record

    with session.open("rb") as file:
        position = 8
        while (record := locate_record(file, position)) is not None and record.opcode != _CHUNK:
            position = record.end
        file.seek(0)
        return file.read(position)


def zstd(content: bytes) -> bytes:
    """Return compressed content."""
    import zstandard

    return bytes(zstandard.ZstdCompressor().compress(content))


def zstd_zeros(size: int) -> bytes:
    """Return zeros, compressed by a factor of 100,000."""
    import zstandard

    compressor = zstandard.ZstdCompressor(level=1).compressobj()
    pieces = [compressor.compress(bytes(1 << 20)) for _ in range(size >> 20)]
    return b"".join([*pieces, compressor.flush()])


def lz4_zeros(size: int) -> bytes:
    """Return compressed zeros in a frame without their size."""
    import lz4.frame

    with lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB) as compressor:
        pieces = [compressor.begin()]
        pieces += [compressor.compress(bytes(1 << 22)) for _ in range(size >> 22)]
        return b"".join([*pieces, compressor.flush()])


def false_heads(size: int) -> bytes:
    """Return chunk headers, each of which claims the whole rest as its content."""
    head = 9 + 32 + 8
    count = size // head
    out = bytearray()
    for k in range(count):
        remaining = (count - k - 1) * head
        out += chunk(b"", "", remaining, crc=1)[:-8] + struct.pack("<Q", remaining)
        struct.pack_into("<Q", out, k * head + 1, 40 + remaining)
    return bytes(out)


def npz_zeros(size: int) -> bytes:
    """Return a state with deflated zeros of a given size as positions."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("position", "velocity"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                shape = (3, size // 48)
                np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": shape})
                left = 24 * shape[1]
                while left:
                    entry.write(bytes(min(left, 1 << 22)))
                    left -= min(left, 1 << 22)
        with archive.open("frame.npy", "w") as entry:
            np.lib.format.write_array(entry, np.array(0))
    return buffer.getvalue()


def npy_of_shape(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    """Return a state whose positions have a header with a shape, but no content."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, archive.open("position.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": descr, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def laughs(levels: int = 9) -> str:
    """Return YAML aliases that expand to a power of 10 texts."""
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, levels)]
    return "\n".join(lines) + f"\nscene: *a{levels - 1}\n"


def many_cornered_face(corners: int) -> bytes:
    """Return an OBJ file with one comb-shaped face, which no triangle fan fills."""
    lines = []
    for k in range(corners):
        lines.append(f"v {k * 1e-3} {(k % 2) * 0.5 if 0 < k < corners - 1 else -1.0} 0")
    return ("\n".join(lines) + "\nf " + " ".join(str(k + 1) for k in range(corners)) + "\n").encode()


def sparse(path: Path, size: int, start: bytes = b"") -> Path:
    """Write a sparse file of a given size."""
    with path.open("wb") as file:
        file.write(start)
        file.truncate(size)
    return path


class Measured(NamedTuple):
    """Result of a command that read a file."""

    status: int
    said: str
    seconds: float
    memory: float
    """Peak resident memory [MB]."""


def measure(arguments: list[str], folder: Path, *, limit: float = 60.0) -> Measured:
    """Run a command in a separate process and measure it."""
    begun = time.perf_counter()
    with (folder / "said.log").open("w+b") as said:
        process = subprocess.Popen(arguments, cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        memory = 0.0
        while (status := process.poll()) is None:
            memory = max(memory, _peak(process.pid))
            if time.perf_counter() - begun > limit:
                process.kill()
            time.sleep(0.01)
        said.seek(0)
        words = said.read(1 << 20).decode(errors="replace")
    return Measured(status, words, time.perf_counter() - begun, memory)


def _peak(pid: int) -> float:
    """Return the peak resident memory of a process so far [MB]."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    words = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return int(words[0]) / 1e3 if words else 0.0
