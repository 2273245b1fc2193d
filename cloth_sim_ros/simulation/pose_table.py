# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of a gripper over time from a table (CSV)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.scene import input_file
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError

#: Largest table [bytes].
_MAX_BYTES = 1 << 28
#: Columns of `ros2 topic echo --csv` for PoseStamped, which writes no header.
_ECHO = ("sec", "nanosec", "frame_id", "x", "y", "z", "qx", "qy", "qz", "qw")
_POSITION, _ORIENTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_KNOWN = ("time", *_ECHO, "closed")
_FLAGS = {"0": False, "1": True, "false": False, "true": True}


def read(path: str | Path, *, gripper: str = "gripper") -> GripperScript:
    """Read a table of poses.

    The first line names the columns. They are `time` [s], or `sec` and `nanosec`, and the position `x`, `y`, `z` [m].
    A unit quaternion `qx`, `qy`, `qz`, `qw`, `closed` (0 or 1) and `frame_id` are optional. A table without that line
    has the columns of `ros2 topic echo --csv` of a PoseStamped. Without `closed`, the gripper is closed from the first
    pose on.

    Args:
        path: the file.
        gripper: name of the gripper.

    Raises:
        ScriptError: naming the file, the line and the fault.
    """
    return read_stamped(path, gripper=gripper)[1]


def read_stamped(path: str | Path, *, gripper: str = "gripper") -> tuple[float, GripperScript]:
    """Return the time of the first pose by the clock of the table [s], and the script, which begins there.

    Raises:
        ScriptError: as `read`.
    """
    try:
        lines = input_file.read_text(path, max_bytes=_MAX_BYTES).splitlines()
    except (OSError, ValueError) as error:
        raise ScriptError(f"cannot read the poses '{path}': {error}") from error
    try:
        return _script(lines, gripper)
    except (ScriptError, csv.Error) as error:
        raise ScriptError(f"{path}: {error}") from error


def _script(lines: Sequence[str], gripper: str) -> tuple[float, GripperScript]:
    reader = csv.reader(lines, skipinitialspace=True)
    rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if row]
    if not rows:
        raise ScriptError("the table is empty")
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
            raise ScriptError(f"line {line} has {len(row)} entries; the table has {len(columns)} columns")
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
            raise ScriptError(f"line {line} is not later than the line before; times must increase")
        poses.append([numbers[name] for name in names])
        frames.add(cells.get("frame_id", ""))
        if "closed" in cells:
            if cells["closed"].lower() not in _FLAGS:
                raise ScriptError(f"line {line}: closed is '{cells['closed']}'; it must be 0 or 1")
            closed.append(_FLAGS[cells["closed"].lower()])
    if not times:
        raise ScriptError("the table has no pose")
    if len(frames) > 1:
        raise ScriptError(f"the poses are in several frames: {', '.join(sorted(frames))}; transform them into one")
    (frame_id,) = frames
    script = GripperScript.from_poses(times, poses, gripper=gripper, closed=closed or True, frame_id=frame_id)
    return first_second + times[0], script


def _check_columns(columns: Sequence[str]) -> None:
    unknown = [name for name in columns if name not in _KNOWN]
    if unknown:
        raise ScriptError(f"the first line has the unknown column '{unknown[0]}'; known are {', '.join(_KNOWN)}")
    needed = ["time"] if "sec" not in columns else ["sec", "nanosec"]
    needed += _POSITION
    if set(columns) & set(_ORIENTATION):
        needed += _ORIENTATION
    missing = [name for name in needed if name not in columns]
    if missing:
        raise ScriptError(f"the table has no column '{missing[0]}'; it needs {', '.join(needed)}")
    repeated = [name for name in columns if columns.count(name) > 1]
    if repeated:
        raise ScriptError(f"the column '{repeated[0]}' stands twice")


def _read_number(cell: str, name: str, line: int) -> float:
    try:
        return float(cell)
    except ValueError as error:
        raise ScriptError(f"line {line}: {name} is '{cell}'; it must be a number") from error
