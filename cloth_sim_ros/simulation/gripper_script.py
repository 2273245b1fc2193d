# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scripted gripper motion: poses over time, and grasps."""

from __future__ import annotations

import bisect
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, rotated_by, rotation_vector
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.parameters import ros_yaml
from cloth_sim_ros.simulation import pose_table
from cloth_sim_ros.simulation.pose_table import PoseTable

Vector = tuple[float, ...]
#: Target rate of a script that gives none [Hz].
DEFAULT_RATE = 100.0
#: Motion between waypoints: from rest to rest, or straight at constant speed.
INTERPOLATIONS = MINIMUM_JERK, LINEAR = ("minimum_jerk", "linear")


class ScriptError(ValueError):
    """Error: a script can't be read or played; the message gives the reason."""


@attrs.frozen(kw_only=True)
class Waypoint:
    """Pose of the gripper at a time of a script."""

    #: Time since the script's start [s].
    time: float
    #: Position [m], 3 numbers.
    position: Vector
    #: Unit quaternion x, y, z, w.
    orientation: Vector


@attrs.frozen(kw_only=True)
class TimedGrasp:
    """Closing (True) or opening of the gripper at a time of a script."""

    time: float
    closed: bool


@attrs.frozen(kw_only=True)
class GripperScript:
    """Motion and grasps of one gripper over time, from rest to rest or straight between waypoints."""

    gripper: str
    #: Coordinate frame of the poses; empty means the cloth's.
    frame_id: str
    #: Target rate [Hz].
    rate: float
    waypoints: tuple[Waypoint, ...]
    grasps: tuple[TimedGrasp, ...]
    #: One of `INTERPOLATIONS`.
    interpolation: str = MINIMUM_JERK

    @classmethod
    def from_file(cls, path: str | Path) -> GripperScript:
        """Read a script (YAML), or recorded poses (CSV, by its ending); raise ScriptError that names file and fault.

        Raises:
            ScriptError: naming the file and the fault.
        """
        if Path(path).suffix.lower() == ".csv":
            try:
                return cls.from_table(pose_table.read(path))
            except pose_table.PoseTableError as error:
                raise ScriptError(str(error)) from error
            except ScriptError as error:
                raise ScriptError(f"{path}: {error}") from error
        import yaml

        try:
            content = ros_yaml.load(input_file.read_text(path))
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise ScriptError(f"cannot read the script '{path}': {error}") from error
        try:
            return cls.from_dict(content)
        except ScriptError as error:
            raise ScriptError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: PoseTable) -> GripperScript:
        """Build a script from recorded poses; raise ScriptError for an invalid one.

        A gripper whose table does not say so is closed from the first pose on.

        Raises:
            ScriptError: for a pose that is not finite, or has no unit quaternion.
        """
        closed = True if table.closed is None else table.closed
        return cls.from_poses(table.times, table.poses, closed=closed, frame_id=table.frame_id)

    @classmethod
    def from_dict(cls, content: Any) -> GripperScript:
        """Build a script from its parsed YAML; raise ScriptError for a missing, unknown or invalid entry.

        Raises:
            ScriptError: for a missing, unknown or invalid entry.
        """
        known = {"gripper", "frame_id", "rate", "steps", "interpolation"}
        entries = _checked_entries(content, "script", needed={"steps"}, known=known)
        rate = _read_number(entries.get("rate", DEFAULT_RATE), "rate")
        if not 0.1 <= rate <= 10000.0:
            raise ScriptError(f"rate is {rate} Hz; it must be from 0.1 to 10000")
        if not isinstance(entries["steps"], list) or not entries["steps"]:
            raise ScriptError("steps must be a list of at least one step")
        waypoints: list[Waypoint] = []
        grasps: list[TimedGrasp] = []
        last_time = -math.inf
        for index, step in enumerate(entries["steps"], start=1):
            time = _read_step(step, f"step {index}", waypoints, grasps)
            if time < last_time or time < 0.0:
                raise ScriptError(f"step {index} is at {time} s; times must not be negative, nor go back")
            last_time = time
        if not waypoints:
            raise ScriptError("no step has a position")
        for first, second in itertools.pairwise(waypoints):
            if second.time <= first.time:
                raise ScriptError(f"two positions are at {second.time} s; a gripper is in one place at a time")
        interpolation = _read_text(entries, "interpolation", MINIMUM_JERK)
        if interpolation not in INTERPOLATIONS:
            raise ScriptError(f"interpolation is '{interpolation}'; it must be one of {', '.join(INTERPOLATIONS)}")
        return cls(
            gripper=_read_text(entries, "gripper", "gripper"),
            frame_id=_read_text(entries, "frame_id", ""),
            rate=rate,
            waypoints=tuple(waypoints),
            grasps=tuple(grasps),
            interpolation=interpolation,
        )

    @classmethod
    def from_poses(
        cls,
        times: ArrayLike,
        poses: ArrayLike,
        *,
        gripper: str = "gripper",
        closed: ArrayLike | None = None,
        frame_id: str = "",
    ) -> GripperScript:
        """Build a script from poses over time, straight between two, such as a recorded robot's; raise ScriptError.

        Args:
            times: increasing times [s], shape (count,); the first one is the script's start.
            poses: position [m], and optionally quaternion x, y, z, w, shape (count, 3) or (count, 7).
            gripper: name of the gripper.
            closed: whether the gripper is closed, for all times or for each one, shape () or (count,); None for no
                grasps.
            frame_id: coordinate frame of the poses; empty means the cloth's.

        Raises:
            ScriptError: for other shapes, a value that is not finite, or times that do not increase.
        """
        stamps, rows = _number_array(times, "times"), _number_array(poses, "poses")
        if stamps.ndim != 1 or not stamps.size:
            raise ScriptError(f"times have the shape {stamps.shape}; it must be (count,), with at least one time")
        if rows.shape not in ((stamps.size, 3), (stamps.size, 7)):
            raise ScriptError(f"poses have the shape {rows.shape}; it must be ({stamps.size}, 3) or ({stamps.size}, 7)")
        late = np.flatnonzero(np.diff(stamps) <= 0.0)
        if late.size:
            k = int(late[0])
            raise ScriptError(f"time {k + 1} is {stamps[k + 1]} s, after {stamps[k]} s; times must increase")
        waypoints = []
        for time, row in zip((stamps - stamps[0]).tolist(), rows.tolist(), strict=True):
            orientation = _unit_quaternion(row[3:], f"the pose at {time:g} s") if row[3:] else (0.0, 0.0, 0.0, 1.0)
            waypoints.append(Waypoint(time=time, position=tuple(row[:3]), orientation=orientation))
        grasps = []
        if closed is not None:
            flags = _flag_array(closed)
            if flags.shape not in ((), stamps.shape):
                raise ScriptError(f"closed has the shape {flags.shape}; it must be () or ({stamps.size},)")
            flags = np.broadcast_to(flags, stamps.shape)
            changes = [0, *(np.flatnonzero(flags[1:] != flags[:-1]) + 1).tolist()]
            grasps = [TimedGrasp(time=waypoints[k].time, closed=bool(flags[k])) for k in changes]
        return cls(
            gripper=gripper,
            frame_id=frame_id,
            rate=DEFAULT_RATE,
            waypoints=tuple(waypoints),
            grasps=tuple(grasps),
            interpolation=LINEAR,
        )

    @property
    def duration(self) -> float:
        """Time of the last step [s]."""
        return max([self.waypoints[-1].time, *(grasp.time for grasp in self.grasps)])

    def rest_end(self, time: float) -> float:
        """Return the time [s] until which the pose of `time` [s] stays, inf at the end; `time` itself in a motion."""
        waypoints, k = self.waypoints, self._waypoint_index(time)
        if k < 0:
            return time
        while k + 1 < len(waypoints):
            first, second = waypoints[k], waypoints[k + 1]
            if (first.position, first.orientation) != (second.position, second.orientation):
                return max(time, first.time)
            k += 1
        return math.inf

    def pose(self, time: float) -> tuple[Vector, Vector]:
        """Return (position [m], quaternion) at a time [s]; the first and the last one outside the waypoints' times.

        With minimum jerk, the gripper rests in each waypoint.
        """
        k = self._waypoint_index(time)
        start = self.waypoints[max(k, 0)]
        if k < 0 or k + 1 == len(self.waypoints):
            return start.position, start.orientation
        end = self.waypoints[k + 1]
        s = (time - start.time) / (end.time - start.time)
        # Minimum jerk from rest to rest (Flash and Hogan 1985).
        fraction = s if self.interpolation == LINEAR else s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        position = tuple(a + fraction * (b - a) for a, b in zip(start.position, end.position, strict=True))
        return position, _interpolated_orientation(start.orientation, end.orientation, fraction)

    def _waypoint_index(self, time: float) -> int:
        """Return the index of the last waypoint at a time [s] or before; -1 if there is none."""
        return bisect.bisect_right(self._times, time) - 1

    @functools.cached_property
    def _times(self) -> list[float]:
        return [waypoint.time for waypoint in self.waypoints]


def _number_array(values: ArrayLike, name: str) -> Array:
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ScriptError(f"{name} are no array of numbers: {error}") from error
    if not np.isfinite(numbers).all():
        index = np.argwhere(~np.isfinite(numbers))[0].tolist()
        raise ScriptError(f"{name} hold {numbers[tuple(index)]} at {index}; all must be finite")
    return numbers


def _flag_array(values: ArrayLike) -> NDArray[np.bool_]:
    """Return truth values: bool, or the numbers 0 and 1."""
    flags = np.asarray(values)
    if flags.dtype.kind not in "biuf" or not ((flags == 0) | (flags == 1)).all():
        raise ScriptError(f"closed is {values!r}; it must be true or false, or 1 or 0")
    return flags.astype(np.bool_)


def _unit_quaternion(numbers: Sequence[float], name: str) -> Vector:
    try:
        return tuple(normalized(numbers).tolist())
    except ValueError as error:
        raise ScriptError(f"{name}: {error}") from error


def _read_step(step: Any, name: str, waypoints: list[Waypoint], grasps: list[TimedGrasp]) -> float:
    entries = _checked_entries(step, name, needed={"time"}, known={"time", "position", "orientation", "close"})
    time = _read_number(entries["time"], f"{name}: time")
    if not {"position", "close"} & set(entries):
        raise ScriptError(f"{name} has neither position nor close")
    if "position" in entries:
        position = _read_numbers(entries["position"], 3, f"{name}: position")
        orientation = waypoints[-1].orientation if waypoints else (0.0, 0.0, 0.0, 1.0)
        if "orientation" in entries:
            orientation = _unit_quaternion(_read_numbers(entries["orientation"], 4, f"{name}: orientation"), name)
        waypoints.append(Waypoint(time=time, position=position, orientation=orientation))
    elif "orientation" in entries:
        raise ScriptError(f"{name} has an orientation without a position")
    if "close" in entries:
        if not isinstance(entries["close"], bool):
            raise ScriptError(f"{name}: close is {entries['close']!r}; it must be true or false")
        grasps.append(TimedGrasp(time=time, closed=entries["close"]))
    return time


def _checked_entries(content: Any, name: str, *, needed: set[str], known: set[str]) -> dict[str, Any]:
    if not isinstance(content, Mapping):
        raise ScriptError(f"{name} is {content!r}; it must have entries {', '.join(sorted(known))}")
    unknown = sorted(str(key) for key in content if key not in known)
    if unknown:
        raise ScriptError(f"{name} has the unknown entry '{unknown[0]}'; known are {', '.join(sorted(known))}")
    missing = sorted(needed - set(content))
    if missing:
        raise ScriptError(f"{name} has no '{missing[0]}'")
    return dict(content)


def _read_text(entries: Mapping[str, Any], name: str, default: str) -> str:
    value = entries.get(name, default)
    if not isinstance(value, str):
        raise ScriptError(f"{name} is {value!r}; it must be a text: write it in quotes, or leave it out")
    return value


def _read_number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ScriptError(f"{name} is {value!r}; it must be a finite number")
    return float(value)


def _read_numbers(value: Any, count: int, name: str) -> Vector:
    if not isinstance(value, list) or len(value) != count:
        raise ScriptError(f"{name} is {value!r}; it must be a list of {count} numbers")
    return tuple(_read_number(entry, name) for entry in value)


def _interpolated_orientation(start: Vector, end: Vector, fraction: float) -> Vector:
    """Return the quaternion at a fraction of the shortest rotation from `start` to `end`."""
    if start == end:
        return start
    return tuple(rotated_by(start, [fraction * angle for angle in _rotation_between(start, end)]))


@functools.lru_cache(maxsize=64)
def _rotation_between(start: Vector, end: Vector) -> list[float]:
    return rotation_vector(start, end)
