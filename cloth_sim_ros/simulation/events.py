# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Events that change a simulation at frame boundaries, and their exact text form."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, ...]


def _floats(value: Any) -> Vector:
    return tuple(map(float, value))


@attrs.frozen
class Target:
    """Command of a gripper to a pose by the end of the frame; without orientation the present target's is kept."""

    gripper: str
    #: Position [m], 3 numbers.
    position: Vector = attrs.field(converter=_floats)
    #: Unit quaternion x, y, z, w, or None.
    orientation: Vector | None = attrs.field(default=None, converter=attrs.converters.optional(_floats))


@attrs.frozen
class Move:
    """Command of an obstacle to a pose; without orientation the present target's is kept."""

    obstacle: str
    #: Position [m], 3 numbers.
    position: Vector = attrs.field(converter=_floats)
    #: Unit quaternion x, y, z, w, or None.
    orientation: Vector | None = attrs.field(default=None, converter=attrs.converters.optional(_floats))


def _truth(value: Any) -> bool:
    """Return the truth value of a command; a text has none, because any text would be true."""
    if isinstance(value, str | bytes):
        raise ValueError(f"{value!r} is a text; it must be True or False")
    return bool(value)


def _python_values(value: Any) -> Any:
    """Return a copy in which numbers and arrays of numpy are plain ones."""
    if isinstance(value, dict):
        return {name: _python_values(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return type(value)(map(_python_values, value)) if type(value) in (list, tuple) else value


def _names(value: Any) -> tuple[str, ...]:
    return tuple(value)


def _pose_rows(value: Any) -> NDArray[np.float64]:
    rows = np.array(value, dtype=np.float64)
    rows.setflags(write=False)
    return rows


@attrs.frozen
class MoveObstacles:
    """Command of several obstacles to poses, as a `Move` for each, at the cost of one event."""

    obstacles: tuple[str, ...] = attrs.field(converter=_names)
    #: Position [m] and unit quaternion x, y, z, w of each obstacle, shape (count, 7).
    poses: NDArray[np.float64] = attrs.field(converter=_pose_rows, eq=attrs.cmp_using(eq=np.array_equal))


@attrs.frozen
class Grasp:
    """Command that closes or opens a gripper; opening, force and speed are for grippers with pads."""

    gripper: str
    #: Any truth value, numpy's included.
    closed: bool = attrs.field(converter=_truth)
    #: Distance between the pads' faces at which they stop [m]; None to close or open them entirely.
    opening: float | None = attrs.field(default=None, converter=attrs.converters.optional(float))
    #: Largest force of each pad [N] and largest speed [m/s] until the next grasp; 0 for those of the scene.
    force: float = attrs.field(default=0.0, converter=float)
    speed: float = attrs.field(default=0.0, converter=float)


@attrs.frozen
class SetParameters:
    """Command to change live scene parameters, values by full name such as `air.drag`.

    Numbers and arrays of numpy become plain ones. A later change of the given dict has no effect.
    """

    values: dict[str, Any] = attrs.field(converter=_python_values)


@attrs.frozen
class Pause:
    """Command to stop simulated time (True), or to resume it (False)."""

    paused: bool = attrs.field(converter=_truth)


@attrs.frozen
class Step:
    """Command to advance by one frame although the simulation is paused; without a pause it has no effect."""


def _pose_tuples(value: Any) -> tuple[Vector, ...]:
    return tuple(map(_floats, value))


@attrs.frozen
class Reset:
    """Command to return cloth, grippers and obstacles to the initial state; the frame index continues.

    Named obstacles start at other poses than those of the scene: a robot's links, where the robot is.
    """

    obstacles: tuple[str, ...] = attrs.field(default=(), converter=_names)
    #: Position [m] and quaternion x, y, z, w of each named obstacle, 7 numbers each.
    poses: tuple[Vector, ...] = attrs.field(default=(), converter=_pose_tuples)


@attrs.frozen
class Relax:
    """Command to multiply the scene's tolerance by a factor until the next such event; 1 restores the scene's own."""

    #: From 1 to `relaxation.MAX_FACTOR`.
    factor: float = attrs.field(converter=float)


Event = Target | Move | MoveObstacles | Grasp | SetParameters | Pause | Step | Reset | Relax

_KINDS: dict[str, type] = {
    "target": Target,
    "move": Move,
    "move_obstacles": MoveObstacles,
    "grasp": Grasp,
    "set_parameters": SetParameters,
    "pause": Pause,
    "step": Step,
    "reset": Reset,
    "relax": Relax,
}
_NAMES = {kind: name for name, kind in _KINDS.items()}
#: Names of the fields of each kind, cached because recorded runs have events in most frames.
_FIELDS = {kind: tuple(field.name for field in attrs.fields(kind)) for kind in _NAMES}
#: Fields that a dict leaves out if they have their default, because older sessions do not have them.
_OPTIONAL: dict[type, dict[str, Any]] = {
    Grasp: {"opening": None, "force": 0.0, "speed": 0.0},
    Reset: {"obstacles": (), "poses": ()},
}
#: Types of the fields that have no converter.
_TYPES = {"gripper": str, "obstacle": str, "values": dict, "paused": bool}
#: Kinds that come before others. Built once, because building a union of types takes longer than the isinstance check.
_BEFORE_OTHERS = (Target, Move, MoveObstacles, Grasp)


def ordered(events: list[Event]) -> list[Event]:
    """Return events in the order in which a frame applies them, only a body's newest `Target` or `Move` retained.

    First the newest target of each gripper, then moves of several obstacles. The newest target of each obstacle is
    next, then grasps, then other events. Events of one kind keep their order of arrival.
    """
    if len(events) < 2:
        return events
    targets: dict[str, Event] = {}
    moves: dict[str, Event] = {}
    for event in events:
        if isinstance(event, Target):
            targets[event.gripper] = event
        elif isinstance(event, Move):
            moves[event.obstacle] = event
    grasps = [event for event in events if isinstance(event, Grasp)]
    later = [event for event in events if not isinstance(event, _BEFORE_OTHERS)]
    several = [event for event in events if isinstance(event, MoveObstacles)]
    newest = [*(targets[name] for name in sorted(targets)), *several, *(moves[name] for name in sorted(moves))]
    return [*newest, *grasps, *later]


def to_dict(event: Event) -> dict[str, Any]:
    """Return an event as a dict of plain values, for `from_dict`; floats keep every bit through JSON."""
    kind = type(event)
    content: dict[str, Any] = {"kind": _NAMES[kind]}
    optional = _OPTIONAL.get(kind, {})
    for name in _FIELDS[kind]:
        value = getattr(event, name)
        if name not in optional or value != optional[name]:
            content[name] = _plain(value)
    return content


def from_dict(data: dict[str, Any]) -> Event:
    """Build an event from a dict of plain values, as from `to_dict`; raise ValueError if it does not describe one.

    Raises:
        ValueError: for an unknown kind or fields that do not fit it.
    """
    fields = dict(data)
    kind = fields.pop("kind", None)
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError(f"event of unknown kind {kind!r}; known are {', '.join(_KINDS)}")
    for name, expected in _TYPES.items():
        if name in fields and not isinstance(fields[name], expected):
            raise ValueError(f"event {data} does not fit '{kind}': {name} must be of type {expected.__name__}")
    try:
        event: Event = _KINDS[kind](**fields)
    except (TypeError, OverflowError) as error:
        raise ValueError(f"event {data} does not fit '{kind}': {error}") from error
    return event


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value
