# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clouds and gripper poses in tables: CSV, and arrays of numpy (npz)."""

from __future__ import annotations

import csv
import io
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recorded import RecordedGripper
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.simulation import pose_table

#: Endings of the files.
ENDINGS = (".csv", ".npz")
#: Largest table [bytes].
_MAX_BYTES = 1 << 30
#: Largest number of names in an error.
_MAX_LISTED = 12
_AXES = ("x", "y", "z")
#: Names of the columns of a table, and of the arrays of an npz file, that `--columns` may rename.
_COLUMNS, _ARRAYS = ("time", "particle", *_AXES), ("times", "points")


def is_table(path: Path) -> bool:
    """Return True if a file's ending is that of a table with clouds (CSV or npz)."""
    return path.suffix.lower() in ENDINGS


def parse_columns(text: str) -> dict[str, str]:
    """Return a table's columns by name from an option such as `time=t,x=X`. Raises FitError for another form.

    Raises:
        FitError: for another form, or an unknown name.
    """
    names: dict[str, str] = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        name, equals, column = (part.strip() for part in entry.partition("="))
        if not equals or not column:
            raise FitError(f"--columns has '{entry}'; write it as time=t,particle=id,x=X,y=Y,z=Z")
        if name not in (*_COLUMNS, *_ARRAYS):
            raise FitError(f"--columns has the unknown name '{name}'; known are {', '.join((*_COLUMNS, *_ARRAYS))}")
        if name in names:
            raise FitError(f"--columns names '{name}' twice, as '{names[name]}' and as '{column}'; give it once")
        names[name] = column
    return names


def read_clouds(
    path: Path, count: int, *, columns: Mapping[str, str] | None = None, scale: float = 1.0, matched: bool = True
) -> tuple[NDArray[np.float64], list[Array]]:
    """Read the clouds of a CSV or npz table; return times [s], ascending, and points [m]. Raises FitError.

    An npz file holds `times`, shape (clouds,), and `points`, shape (clouds, points, 3), NaN for hidden points. A CSV
    has a line for each point: `time`, `particle`, `x`, `y`, `z`. Alternatively it has a line for each cloud, with
    columns such as `x0`, `y0`, `z0`, `x1`. `columns` renames them: `x=m{}_x` for columns `m0_x`, `m1_x`.

    Args:
        path: the file.
        count: number of particles.
        columns: names in the file, by the names above.
        scale: factor from the table's unit to metres.
        matched: true if a point is a particle; false for bare points, which need no column `particle`.

    Raises:
        FitError: naming file, line and fault.
    """
    try:
        content = input_file.read_bytes(path, max_bytes=_MAX_BYTES)
        read = _read_arrays if path.suffix.lower() == ".npz" else _read_csv
        times, clouds = read(content, count, dict(columns or {}), matched)
        if not np.isfinite(times).all():
            k = int(np.argmin(np.isfinite(times)))
            raise ValueError(f"the time of cloud {k} is {times[k]}; it must be finite")
    except (OSError, ValueError, csv.Error) as error:
        raise FitError(f"{path}: {error}") from error
    order = np.argsort(times, kind="stable")
    return times[order], [scale * clouds[k] for k in order]


def read_track(path: Path, start: float, *, scale: float = 1.0) -> RecordedGripper:
    """Return a gripper's recorded poses from a CSV table; times count from `start` [s]. Raises FitError.

    Times count from `start`, a time of the table's clock [s].

    Its columns are those of `cloth_gripper`: `time`, `x`, `y`, `z`, and optionally `qx`, `qy`, `qz`, `qw`, `closed`.

    Raises:
        FitError: naming file, line and fault.
    """
    from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

    try:
        table = pose_table.read(path)
        script = GripperScript.from_table(table)
    except (pose_table.PoseTableError, ScriptError) as error:
        raise FitError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
    offset = table.start - start
    return RecordedGripper(
        times=np.array(table.times) + offset,
        positions=scale * np.array([entry.position for entry in script.waypoints]),
        quaternions=[entry.orientation for entry in script.waypoints],
        # A gripper whose table does not say so is closed all the time.
        grasps=() if table.closed is None else tuple((grasp.time + offset, grasp.closed) for grasp in script.grasps),
    )


def _read_arrays(
    content: bytes, count: int, columns: Mapping[str, str], matched: bool
) -> tuple[NDArray[np.float64], list[Array]]:
    import zipfile
    import zlib

    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise FitError("is no npz file: write it with numpy.savez")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {}
            for name in _ARRAYS:
                key = columns.get(name, name)
                if key not in file:
                    raise FitError(f"there is no array '{key}'; there are {_names_text(file.files)}")
                n_bytes = file.zip.getinfo(f"{key}.npy").file_size
                if n_bytes > _MAX_BYTES:
                    raise FitError(f"the array '{key}' has {n_bytes} bytes unpacked; at most {_MAX_BYTES} are read")
                array = file[key]
                if not isinstance(array, np.ndarray):
                    raise FitError(f"the array '{key}' is damaged: write the file again with numpy.savez")
                if array.dtype.kind not in "fiu":
                    raise FitError(f"the array '{key}' has the type {array.dtype}; it must be of real numbers")
                arrays[name] = array.astype(np.float64)
    except (zipfile.BadZipFile, zlib.error, EOFError, KeyError, MemoryError) as error:
        raise FitError(f"is no npz file: {error}") from error
    times, points = arrays["times"], arrays["points"]
    if times.ndim != 1 or points.shape != (len(times), *points.shape[1:2], 3):
        raise FitError(
            f"times have the shape {times.shape} and points {points.shape}; they must be (clouds,) and "
            "(clouds, points, 3)"
        )
    if not len(times):
        raise FitError("the table has no cloud")
    if matched and points.shape[1] != count:
        raise FitError(f"points have {points.shape[1]} particles; the scene has {count}")
    return times, [points[k] if matched else points[k][np.isfinite(points[k]).all(axis=1)] for k in range(len(times))]


def _read_csv(
    content: bytes, count: int, columns: Mapping[str, str], matched: bool
) -> tuple[NDArray[np.float64], list[Array]]:
    pose_table.check_separator(_lines(content))
    reader = csv.reader(_lines(content), skipinitialspace=True)
    header = [name.strip() for name in next(reader, [])]
    names = {name: columns.get(name, name) for name in _COLUMNS}
    used = [names["time"]]
    _check_columns(header, used, names)
    wide = _wide_columns(header, names) if names["x"] not in header else {}
    if wide:
        used += [key for keys in wide.values() for key in keys]
    else:
        used = [names[name] for name in _COLUMNS if matched or name != "particle"]
    _check_columns(header, used, names)
    if matched and wide and max(wide) >= count:
        raise FitError(f"there are columns of particle {max(wide)}; there are {count}, from index 0")
    clouds = dict[float, _CloudRows]()
    for row in filter(None, reader):
        if len(row) != len(header):
            raise FitError(f"line {reader.line_num} has {len(row)} entries; the table has {len(header)} columns")
        line = _Line(reader.line_num, dict(zip(header, row, strict=True)))
        time = line.read_number(names["time"])
        if not np.isfinite(time):
            raise FitError(f"line {line.index}: {names['time']} is {time}; it must be finite")
        if wide:
            if time in clouds:
                raise FitError(f"line {line.index}: a cloud of time {time:g} s stands above")
            points = [(particle, [line.read_number(key) for key in keys]) for particle, keys in wide.items()]
        else:
            particle = line.read_particle(names["particle"], count) if matched else 0
            points = [(particle, [line.read_number(names[axis]) for axis in _AXES])]
        if time not in clouds:
            clouds[time] = _CloudRows(count if matched else None)
        for particle, point in points:
            if not clouds[time].add(particle, point):
                raise FitError(f"line {line.index}: particle {particle} stands twice in the cloud of time {time:g} s")
    if not clouds:
        raise FitError("the table has no cloud")
    return np.array(list(clouds)), [rows.to_array() for rows in clouds.values()]


def _check_columns(header: Sequence[str], used: Sequence[str], names: Mapping[str, str]) -> None:
    """Raise FitError unless a table has each used column once, and each column is used once.

    Args:
        header: columns of the table.
        used: columns that are read.
        names: columns by the names of `--columns`.
    """
    counts, uses = Counter(header), Counter(used)
    for column in used:
        if not counts[column]:
            known = [name for name, renamed in names.items() if renamed == column]
            remedy = f"; name it by --columns {known[0]}=COLUMN" if known else ""
            raise FitError(f"there is no column '{column}'; there are {_names_text(header)}{remedy}")
        if counts[column] > 1:
            raise FitError(f"the column '{column}' stands {counts[column]} times; rename or remove the others")
        if uses[column] > 1:
            raise FitError(f"--columns uses the column '{column}' {uses[column]} times; name a column for each")


def _lines(content: bytes) -> Iterator[str]:
    """Yield the lines of a text in UTF-8, without a byte order mark. Raises FitError for other bytes.

    A list of all lines takes many times the memory of the text.
    """
    try:
        yield from io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise FitError(f"is no text in UTF-8: {error}; save it in UTF-8") from error


class _CloudRows:
    """Collector of one cloud's points, line by line: a row for each of `count` particles, or bare points for None."""

    def __init__(self, count: int | None) -> None:
        self._is_matched = count is not None
        self._coordinates = array("d", [math.nan]) * (3 * (count or 0))
        self._has_line = bytearray(count or 0)

    def add(self, particle: int, point: Sequence[float]) -> bool:
        """Add a point [m], of a particle or bare; return False if the particle has one already."""
        if not self._is_matched:
            self._coordinates.extend(point)
            return True
        if self._has_line[particle]:
            return False
        self._has_line[particle] = 1
        self._coordinates[3 * particle : 3 * particle + 3] = array("d", point)
        return True

    def to_array(self) -> Array:
        """Return the points [m], shape (points, 3): NaN for hidden particles, and none of hidden bare points."""
        points = np.frombuffer(self._coordinates, dtype=np.float64).reshape(-1, 3)
        return points if self._is_matched else points[np.isfinite(points).all(axis=1)]


def _names_text(names: Sequence[str]) -> str:
    """Return the first names as text, and how many more there are; `none` without names."""
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return ", ".join(names[:_MAX_LISTED]) + more or "none"


@attrs.frozen
class _Line:
    """Line of a table: its line number in the file, and its cells by column."""

    index: int
    cells: Mapping[str, str]

    def read_number(self, name: str) -> float:
        """Return the number of a column, NaN for an empty cell (a hidden point). Raises FitError for a text."""
        cell = self.cells[name].strip()
        try:
            return float(cell or "nan")
        except ValueError as error:
            raise FitError(f"line {self.index}: {name} is '{cell}'; it must be a number") from error

    def read_particle(self, name: str, count: int) -> int:
        """Return the particle index in a column. Raises FitError unless it is whole, from 0 to below `count`."""
        particle = self.read_number(name)
        if not (0 <= particle < count and particle == int(particle)):
            raise FitError(f"line {self.index} names particle {particle:g}; there are {count}, from index 0")
        return int(particle)


def _wide_columns(header: Sequence[str], names: Mapping[str, str]) -> dict[int, tuple[str, ...]]:
    """Return the columns x, y, z of each particle in a table that has a line for each cloud."""
    patterns = [name if "{}" in name else name + "{}" for name in (names[axis] for axis in _AXES)]
    columns: dict[int, tuple[str, ...]] = {}
    before, _, after = patterns[0].partition("{}")
    known = frozenset(header)
    for name in header:
        index = name[len(before) : len(name) - len(after)]
        if name.startswith(before) and name.endswith(after) and index.isdecimal():
            keys = tuple(pattern.replace("{}", index) for pattern in patterns)
            missing = [key for key in keys if key not in known]
            if missing:
                raise FitError(f"there is a column '{name}', but no column '{missing[0]}'")
            if int(index) in columns:
                raise FitError(f"there are several columns of particle {int(index)}, such as '{name}'")
            columns[int(index)] = keys
    return columns
