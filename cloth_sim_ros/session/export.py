# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Particle trajectories out of a session, as .npz or Parquet, without ever holding them all."""

from __future__ import annotations

import io
import itertools
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.output_files import atomic_write
from cloth_sim_ros.session.reader import RecordedCloud, SessionReader

if TYPE_CHECKING:
    from numpy.typing import NDArray

_ROW_GROUP = 1 << 20
"""Rows of a Parquet row group; the export holds one group in memory."""


class _Frame(NamedTuple):
    frame_index: int
    time: float
    log_time: int
    xyz: NDArray[np.floating]


def export(
    reader: SessionReader,
    target: Path | str,
    *,
    every: int = 1,
    start: float | None = None,
    end: float | None = None,
    on_progress: Callable[[], None] = lambda: None,
) -> int:
    """Write particle positions over time to a new .npz or .parquet file; return the frame count. Raises SessionError.

    Args:
        reader: the session.
        target: ``*.npz`` or ``*.parquet``; appears when it is complete and never replaces a file.
        every: export every n-th cloud.
        start: first simulated time [s].
        end: simulated time before which the export stops [s].
        on_progress: called after each cloud read; .npz takes two passes, the first to count. Clouds that are recorded
            after it are left out.

    ``.npz`` holds ``frame`` (m,), ``time`` (m,) [s], ``log_time`` (m,) [ns since the epoch], ``positions`` (m, n, 3)
    [m], of the clouds' precision (float32 or float64). If the session has them, also ``triangles`` (k, 3) and
    ``rest_positions`` (n, 3) [m]. Parquet has one row per particle and frame: ``frame``, ``time``,
    ``particle``, ``x``, ``y``, ``z``.

    Raises SessionError for another kind of target, or if the session has no clouds in that time span.
    """
    target = Path(target)
    writers: dict[str, Callable[[Path, Callable[[], Iterator[_Frame]], SessionReader], int]] = {
        ".npz": _write_npz,
        ".parquet": _write_parquet,
    }
    if target.suffix not in writers:
        raise SessionError(f"cannot export to {target.name}: the name must end in {' or '.join(writers)}")
    if target.exists():
        raise SessionError(f"{target} exists; give another name")
    if not target.absolute().parent.is_dir():
        raise SessionError(f"there is no folder '{target.absolute().parent}' for {target.name}; create it first")
    if every < 1:
        raise SessionError(f"every {every}th frame cannot be exported; give 1 or more")

    def frames() -> Iterator[_Frame]:
        return _frames(reader, every, start, end, on_progress)

    try:
        with atomic_write(target, replace=False) as unfinished:
            return writers[target.suffix](unfinished, frames, reader)
    except FileExistsError:
        raise SessionError(f"{target} exists; give another name") from None


def _frames(
    reader: SessionReader, every: int, start: float | None, end: float | None, on_progress: Callable[[], None]
) -> Iterator[_Frame]:
    n_clouds = 0
    n_points: int | None = None
    dtype: np.dtype[Any] | None = None
    for recorded in reader.clouds():
        on_progress()
        if not _is_within(recorded, start, end):
            continue
        n_clouds += 1
        if (n_clouds - 1) % every:
            continue
        frame = recorded.frame
        xyz = recorded.cloud.xyz
        if n_points is not None and len(xyz) != n_points:
            counts = f"{len(xyz)} points, those before {n_points}"
            raise SessionError(f"a cloud has {counts}; export the time spans separately")
        if dtype is not None and xyz.dtype != dtype:
            types = f"{xyz.dtype.name}, those before {dtype.name}"
            raise SessionError(f"a cloud is {types}; export the time spans separately")
        n_points, dtype = len(xyz), xyz.dtype
        frame_index, time = (-1, float("nan")) if frame is None else (frame.frame, frame.time)
        yield _Frame(frame_index, time, recorded.log_time, xyz)


def _is_within(recorded: RecordedCloud, start: float | None, end: float | None) -> bool:
    if start is None and end is None:
        return True
    if recorded.frame is None:
        return False
    time = recorded.frame.time
    return (start is None or time >= start) and (end is None or time < end)


def _write_npz(path: Path, frames: Callable[[], Iterator[_Frame]], reader: SessionReader) -> int:
    # The array's shape precedes its contents; therefore the first pass counts the frames.
    table = [(frame.frame_index, frame.time, frame.log_time, frame.xyz.shape, frame.xyz.itemsize) for frame in frames()]
    if not table:
        raise SessionError(reader.with_missing("the session has no clouds in that span"))
    shape, dtype = (len(table), *table[0][3]), f"<f{table[0][4]}"
    surface = reader.topology()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        columns: dict[str, NDArray[Any]] = {
            "frame": np.array([row[0] for row in table], np.int64),
            "time": np.array([row[1] for row in table], np.float64),
            "log_time": np.array([row[2] for row in table], np.int64),
        }
        if surface is not None:
            columns |= {"triangles": surface.triangles, "rest_positions": surface.vertices}
        for name, column in columns.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, column, allow_pickle=False)
            archive.writestr(f"{name}.npy", buffer.getvalue())
        with archive.open("positions.npy", "w", force_zip64=True) as entry:
            header = {"descr": dtype, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(entry, header)
            written = 0
            # A session that is being recorded has more by now.
            for frame in itertools.islice(frames(), len(table)):
                entry.write(np.ascontiguousarray(frame.xyz, dtype).tobytes())
                written += 1
    if written != len(table):
        raise SessionError(f"the session changed while it was read: {len(table)} clouds, then {written}")
    return written


def _write_parquet(path: Path, frames: Callable[[], Iterator[_Frame]], reader: SessionReader) -> int:
    try:
        import pyarrow as pa  # type: ignore[import-untyped]
        import pyarrow.parquet as pq  # type: ignore[import-untyped]
    except ImportError:
        raise SessionError("Parquet needs the Python package pyarrow; install it, or export to .npz") from None
    span = frames()
    first = next(span, None)
    if first is None:
        raise SessionError(reader.with_missing("the session has no clouds in that span"))
    dtype = np.dtype(f"f{first.xyz.itemsize}")
    leading = [("frame", pa.int64()), ("time", pa.float64()), ("particle", pa.int32())]
    schema = pa.schema([*leading, *((axis, pa.from_numpy_dtype(dtype)) for axis in "xyz")])
    count = 0
    queued_frames: list[_Frame] = []
    with pq.ParquetWriter(path, schema) as writer:

        def write() -> None:
            n_points = len(queued_frames[0].xyz)
            xyz = np.concatenate([frame.xyz for frame in queued_frames])
            columns = [
                np.repeat(np.array([frame.frame_index for frame in queued_frames], np.int64), n_points),
                np.repeat(np.array([frame.time for frame in queued_frames], np.float64), n_points),
                np.tile(np.arange(n_points, dtype=np.int32), len(queued_frames)),
                *(np.ascontiguousarray(xyz[:, axis], dtype) for axis in range(3)),
            ]
            writer.write_table(pa.table(columns, schema=schema))
            queued_frames.clear()

        for frame in itertools.chain([first], span):
            queued_frames.append(frame)
            count += 1
            if sum(len(queued_frame.xyz) for queued_frame in queued_frames) >= _ROW_GROUP:
                write()
        if queued_frames:
            write()
    return count
