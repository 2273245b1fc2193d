# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of a gripper over time from a table (CSV)."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import attrs

from cloth_sim_ros.scene import input_file

#: First character of a text that some programs write.
BYTE_ORDER_MARK = "\ufeff"
#: Largest table [bytes].
_MAX_BYTES = 1 << 28
#: Columns of `ros2 topic echo --csv` for PoseStamped, which writes no header.
_ECHO = ("sec", "nanosec", "frame_id", "x", "y", "z", "qx", "qy", "qz", "qw")
_POSITION, _ORIENTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_KNOWN = ("time", *_ECHO, "closed")
_FLAGS = {"0": False, "1": True, "false": False, "true": True}


class PoseTableError(ValueError):
    """Error: a table of poses can't be read; the message gives the reason."""


@attrs.frozen(kw_only=True)
class PoseTable:
    """Poses of a gripper over time, as a table holds them."""

    #: Time of the first pose by the clock of the table [s].
    start: float
    #: Times since then [s], increasing.
    times: list[float]
    #: Position [m], and quaternion x, y, z, w if the table has it, of each pose.
    poses: list[list[float]]
    #: Whether the gripper is closed at each pose; None if the table does not say so.
    closed: list[bool] | None
    #: Coordinate frame of the poses; empty if the table does not name it.
    frame_id: str


def read(path: str | Path) -> PoseTable:
    """Read the poses of a gripper over time from a CSV file; raise PoseTableError that names file, line and fault.

    The first line names the columns. They are `time` [s], or `sec` and `nanosec`, and the position `x`, `y`, `z` [m].
    A unit quaternion `qx`, `qy`, `qz`, `qw`, `closed` (0 or 1) and `frame_id` are optional. A table without that line
    has the columns of `ros2 topic echo --csv` of a PoseStamped.

    Raises:
        PoseTableError: naming the file, the line and the fault.
    """
    try:
        lines = input_file.read_text(path, max_bytes=_MAX_BYTES).removeprefix(BYTE_ORDER_MARK).splitlines()
    except (OSError, ValueError) as error:
        raise PoseTableError(f"cannot read the poses '{path}': {error}") from error
    try:
        return _parse(lines)
    except (PoseTableError, csv.Error) as error:
        raise PoseTableError(f"{path}: {error}") from error


def _parse(lines: Sequence[str]) -> PoseTable:
    reader = csv.reader(lines, skipinitialspace=True)
    rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if row]
    if not rows:
        raise PoseTableError("the table is empty")
    check_separator(lines)
    columns = tuple(name.lower() for name in rows[0][1])
    if len(columns) == len(_ECHO) and columns[0].isdecimal():
        columns = _ECHO
    else:
        del rows[0]
    _check_columns(columns)
    times, poses, closed, frames = list[float](), list[list[float]](), list[bool](), set[str]()
    names = _POSITION + (_ORIENTATION if "qw" in columns else ())
    first_second = 0.0
    for line, row in rows:
        if len(row) != len(columns):
            raise PoseTableError(f"line {line} has {len(row)} entries; the table has {len(columns)} columns")
        cells = dict(zip(columns, row, strict=True))
        numbers = {
            name: _read_number(cells[name], name, line) for name in columns if name not in ("closed", "frame_id")
        }
        if "time" not in numbers and not times:
            first_second = numbers["sec"]
        # Relative to the first second, because a float resolves stamps since 1970 to a quarter of a microsecond.
        times.append(
            numbers["time"] if "time" in numbers else numbers["sec"] - first_second + 1e-9 * numbers["nanosec"]
        )
        if times[1:] and times[-1] <= times[-2]:
            raise PoseTableError(f"line {line} is not later than the line before; times must increase")
        poses.append([numbers[name] for name in names])
        frames.add(cells.get("frame_id", ""))
        if "closed" in cells:
            if cells["closed"].lower() not in _FLAGS:
                raise PoseTableError(f"line {line}: closed is '{cells['closed']}'; it must be 0 or 1")
            closed.append(_FLAGS[cells["closed"].lower()])
    if not times:
        raise PoseTableError("the table has no pose")
    if len(frames) > 1:
        raise PoseTableError(f"the poses are in several frames: {', '.join(sorted(frames))}; transform them into one")
    (frame_id,) = frames
    return PoseTable(
        start=first_second + times[0],
        times=[time - times[0] for time in times],
        poses=poses,
        closed=closed or None,
        frame_id=frame_id,
    )


def check_separator(lines: Iterable[str]) -> None:
    """Raise PoseTableError if a table's columns are separated by semicolons or tabs instead of commas.

    Raises:
        PoseTableError: naming the separator and the remedy.
    """
    first = next(filter(str.strip, lines), "")
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if separator in first and "," not in first:
            raise PoseTableError(
                f"its columns are separated by {name}; save it with commas, and with points in numbers"
            )


def _check_columns(columns: Sequence[str]) -> None:
    unknown = [name for name in columns if name not in _KNOWN]
    if unknown:
        raise PoseTableError(f"the first line has the unknown column '{unknown[0]}'; known are {', '.join(_KNOWN)}")
    needed = ["time"] if "sec" not in columns else ["sec", "nanosec"]
    needed += _POSITION
    if set(columns) & set(_ORIENTATION):
        needed += _ORIENTATION
    missing = [name for name in needed if name not in columns]
    if missing:
        raise PoseTableError(f"the table has no column '{missing[0]}'; it needs {', '.join(needed)}")
    repeated = [name for name in columns if columns.count(name) > 1]
    if repeated:
        raise PoseTableError(f"the column '{repeated[0]}' stands twice")


def _read_number(cell: str, name: str, line: int) -> float:
    try:
        return float(cell)
    except ValueError as error:
        raise PoseTableError(f"line {line}: {name} is '{cell}'; it must be a number") from error
