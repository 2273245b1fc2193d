# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points and poses in messages of any type, by the names of their fields.

A field is written as `markers[].pose.position`: attributes after dots, and `[]` for each element of an array. Three
arrays of coordinates are written as `x,y,z`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.session.errors import SessionError

_FIELD = re.compile(r"[A-Za-z_]\w*(\[\])?(\.[A-Za-z_]\w*(\[\])?)*")
#: Names of a pose's position and orientation: of geometry_msgs/Pose and of geometry_msgs/Transform.
_POSE_FIELDS = (("position", "orientation"), ("translation", "rotation"))


def split_topic(text: str) -> tuple[str, str]:
    """Split `TOPIC:FIELD` into topic and field, empty for a topic alone. Raises FitError for an invalid field.

    Raises:
        FitError: for a field that is not written so.
    """
    topic, colon, field = text.partition(":")
    if colon:
        check_field(field)
    return topic, field


def check_field(field: str) -> None:
    """Raise FitError unless a text names a field of a message, such as `markers[].pose.position`.

    Raises:
        FitError: naming the form.
    """
    parts = field.split(",")
    if len(parts) not in (1, 3) or not all(map(_FIELD.fullmatch, parts)):
        raise FitError(f"'{field}' is no field of a message; write it as markers[].pose.position, or three as x,y,z")


def topic_messages(paths: Sequence[Path], topic: str) -> Iterator[tuple[int, Any]]:
    """Yield log time [ns] and decoded message of a bag's topic. Raises FitError if it is absent, or SessionError.

    Args:
        paths: files of one bag of ROS 1 or ROS 2, or its folder.
        topic: name of the topic.

    Raises:
        SessionError: if a file can't be read, or a definition is missing.
        FitError: for a topic that is not in the bag.
    """
    from cloth_sim_ros.session.channel_description import standard_types

    try:
        from rosbags.highlevel import AnyReader
    except ImportError as error:
        raise SessionError(f"{paths[0]} needs {error.name}, which is not installed: pip install rosbags") from error
    for path in paths:
        try:
            with AnyReader([path], default_typestore=standard_types()) as reader:
                connections = [entry for entry in reader.connections if entry.topic == topic]
                if not connections:
                    topics = ", ".join(sorted({entry.topic for entry in reader.connections})) or "none"
                    raise FitError(f"{path} has no topic '{topic}'; it has {topics}")
                for connection, log_time, data in reader.messages(connections):
                    yield log_time, reader.deserialize(data, connection.msgtype)
        except (FitError, GeneratorExit):
            raise
        except Exception as error:  # Errors of several libraries.
            raise SessionError(f"{path} can't be read as a bag: {error}") from error


def field_values(message: Any, field: str) -> list[Any]:
    """Return the values of a message's field, a list over the elements of its arrays. Raises FitError if it is absent.

    Raises:
        FitError: if the message has no such field.
    """
    values = [message]
    for part in field.split("."):
        name = part.removesuffix("[]")
        for value in values:
            if not hasattr(value, name):
                known = (
                    ", ".join(key for key in vars(value) if not key.startswith("_"))
                    if hasattr(value, "__dict__")
                    else ""
                )
                raise FitError(f"field '{field}': there is no '{name}'; there are {known or 'no further fields'}")
        values = [getattr(value, name) for value in values]
        if part != name:
            values = [element for value in values for element in _elements(value, field)]
    return values


def _elements(value: Any, field: str) -> list[Any]:
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        raise FitError(f"field '{field}': [] stands after a value that is no array")
    return list(value)


def points_of(message: Any, field: str) -> Array:
    """Return the points in a message's field [m], shape (count, 3). Raises FitError if it holds none.

    Its values are objects with x, y and z, or arrays of numbers, three for each point. Of three fields, each has one
    coordinate of all points.

    Raises:
        FitError: if the field has no points.
    """
    if "," in field:
        columns = [_numbers(message, name) for name in field.split(",")]
        if len({column.size for column in columns}) > 1:
            sizes = ", ".join(str(column.size) for column in columns)
            raise FitError(f"fields '{field}' hold {sizes} numbers; each point has one in every field")
        return np.stack(columns, axis=1)
    rows: list[list[float]] = []
    for value in field_values(message, field):
        if all(hasattr(value, axis) for axis in "xyz"):
            rows.append([float(value.x), float(value.y), float(value.z)])
            continue
        try:
            numbers = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise FitError(f"field '{field}' holds {type(value).__name__}, and no points: {error}") from error
        if numbers.ndim != 1 or numbers.size % 3:
            raise FitError(f"field '{field}' holds {numbers.size} numbers; each point has three")
        rows += numbers.reshape(-1, 3).tolist()
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _numbers(message: Any, field: str) -> Array:
    """Return all numbers that a message's field holds, shape (count,)."""
    try:
        return np.concatenate(
            [np.atleast_1d(np.asarray(v, dtype=np.float64)).ravel() for v in field_values(message, field)]
        )
    except (TypeError, ValueError) as error:
        raise FitError(f"field '{field}' holds no numbers: {error}") from error


def indices_of(message: Any, field: str) -> list[int]:
    """Return the particle indices in a message's field. Raises FitError for other than whole numbers.

    Raises:
        FitError: if the field has no whole numbers.
    """
    values = field_values(message, field)
    flat = [entry for value in values for entry in (value.tolist() if isinstance(value, np.ndarray) else [value])]
    try:
        particles = [int(entry) for entry in flat]
    except (TypeError, ValueError) as error:
        raise FitError(f"field '{field}' holds no particle numbers: {error}") from error
    if particles != flat:
        raise FitError(f"field '{field}' holds numbers that are not whole")
    return particles


def pose_of(message: Any, field: str) -> list[float]:
    """Return the pose in a message's field: position [m] and quaternion x, y, z, w, 7 numbers. Raises FitError.

    Raises:
        FitError: if the field is no pose.
    """
    values = field_values(message, field) if field else [message]
    if len(values) != 1:
        raise FitError(f"field '{field}' has {len(values)} values; a gripper has one pose")
    value = values[0]
    for wrapped in ("pose", "transform"):
        value = getattr(value, wrapped, value)
    for first, second in _POSE_FIELDS:
        if hasattr(value, first) and hasattr(value, second):
            p, q = getattr(value, first), getattr(value, second)
            return [float(entry) for entry in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)]
    if all(hasattr(value, axis) for axis in "xyz"):
        return [float(value.x), float(value.y), float(value.z), 0.0, 0.0, 0.0, 1.0]
    raise FitError(f"field '{field}' holds {type(value).__name__}; a pose has position and orientation")


def stamp_of(message: Any) -> int:
    """Return the stamp of a message's header [ns]; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return int(stamp.sec) * 10**9 + int(stamp.nanosec) if stamp is not None else 0


def frame_of(message: Any) -> str:
    """Return the frame of a message's header; empty if it has none."""
    return str(getattr(getattr(message, "header", None), "frame_id", ""))
