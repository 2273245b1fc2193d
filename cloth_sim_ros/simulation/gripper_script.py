# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scripted gripper motion: poses over time, and grasps."""

from __future__ import annotations

import bisect
import functools
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.physics.plan.gripper_path import normalized, rotated_by, rotation_vector
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.parameters import ros_yaml

Vector = tuple[float, ...]


class ScriptError(ValueError):
    """A script that can't be played; the message gives the reason."""


@attrs.frozen(kw_only=True)
class Waypoint:
    """Pose at which the gripper rests at a time."""

    #: Time since the script's start [s].
    time: float
    #: Position [m], 3 numbers.
    position: Vector
    #: Unit quaternion x, y, z, w.
    orientation: Vector


@attrs.frozen(kw_only=True)
class TimedGrasp:
    """Time at which the gripper closes (True) or opens."""

    time: float
    closed: bool


@attrs.frozen(kw_only=True)
class GripperScript:
    """Motion and grasps of one gripper over time."""

    gripper: str
    #: Coordinate frame of the poses; empty means the cloth's.
    frame_id: str
    #: Target rate [Hz].
    rate: float
    waypoints: tuple[Waypoint, ...]
    grasps: tuple[TimedGrasp, ...]

    @classmethod
    def from_file(cls, path: str | Path) -> GripperScript:
        """Read a script.

        Raises:
            ScriptError: naming the file and the fault.
        """
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
    def from_dict(cls, content: Any) -> GripperScript:
        """Build a script from its parsed YAML.

        Raises:
            ScriptError: for a missing, unknown or invalid entry.
        """
        entries = _checked_entries(content, "script", needed={"steps"}, known={"gripper", "frame_id", "rate", "steps"})
        rate = _read_number(entries.get("rate", 100.0), "rate")
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
        gripper, frame_id = str(entries.get("gripper", "gripper")), str(entries.get("frame_id", ""))
        return cls(gripper=gripper, frame_id=frame_id, rate=rate, waypoints=tuple(waypoints), grasps=tuple(grasps))

    @property
    def duration(self) -> float:
        """Time of the last step [s]."""
        return max([self.waypoints[-1].time, *(grasp.time for grasp in self.grasps)])

    def rest_end(self, time: float) -> float:
        """Return the time [s] until which the gripper keeps its pose of a time [s]; that time itself while the gripper
        moves.
        """
        end = time
        for first, second in itertools.pairwise(self.waypoints):
            if first.time <= end < second.time:
                if (first.position, first.orientation) != (second.position, second.orientation):
                    return end
                end = second.time
        return end if end < self.waypoints[-1].time else math.inf

    def pose(self, time: float) -> tuple[Vector, Vector]:
        """Return position [m] and orientation at a time [s]: rest in each waypoint, minimum jerk between waypoints."""
        times = [waypoint.time for waypoint in self.waypoints]
        upper = bisect.bisect_right(times, time)
        if upper == 0:
            return self.waypoints[0].position, self.waypoints[0].orientation
        start = self.waypoints[upper - 1]
        if upper == len(times):
            return start.position, start.orientation
        end = self.waypoints[upper]
        s = (time - start.time) / (end.time - start.time)
        # Minimum jerk from rest to rest (Flash and Hogan 1985).
        fraction = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        position = tuple(a + fraction * (b - a) for a, b in zip(start.position, end.position, strict=True))
        return position, _interpolated_orientation(start.orientation, end.orientation, fraction)


def _read_step(step: Any, name: str, waypoints: list[Waypoint], grasps: list[TimedGrasp]) -> float:
    entries = _checked_entries(step, name, needed={"time"}, known={"time", "position", "orientation", "close"})
    time = _read_number(entries["time"], f"{name}: time")
    if not {"position", "close"} & set(entries):
        raise ScriptError(f"{name} has neither position nor close")
    if "position" in entries:
        position = _read_numbers(entries["position"], 3, f"{name}: position")
        orientation = waypoints[-1].orientation if waypoints else (0.0, 0.0, 0.0, 1.0)
        if "orientation" in entries:
            try:
                quaternion = normalized(_read_numbers(entries["orientation"], 4, f"{name}: orientation"))
            except ValueError as error:
                raise ScriptError(f"{name}: {error}") from error
            orientation = tuple(quaternion.tolist())
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


def _read_number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ScriptError(f"{name} is {value!r}; it must be a finite number")
    return float(value)


def _read_numbers(value: Any, count: int, name: str) -> Vector:
    if not isinstance(value, list) or len(value) != count:
        raise ScriptError(f"{name} is {value!r}; it must be a list of {count} numbers")
    return tuple(_read_number(entry, name) for entry in value)


def _interpolated_orientation(start: Vector, end: Vector, fraction: float) -> Vector:
    """Return the orientation at a fraction of the shortest rotation from one to another."""
    if start == end:
        return start
    return tuple(rotated_by(start, [fraction * angle for angle in _rotation_between(start, end)]))


@functools.lru_cache(maxsize=64)
def _rotation_between(start: Vector, end: Vector) -> list[float]:
    return rotation_vector(start, end)
