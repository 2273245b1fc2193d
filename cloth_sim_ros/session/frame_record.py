# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Record of one `advance`: a line of JSON on the channel ``<node>/frame``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from cloth_sim_ros.session import plain_json
from cloth_sim_ros.session.errors import SessionError

#: Shared by all frames, because construction is slow.
_ENCODE = json.JSONEncoder(allow_nan=False, separators=(",", ":"), ensure_ascii=False).encode
#: Maximum magnitude of a number in an event: the largest float.
_MAX_NUMBER = sys.float_info.max
_REQUIRED = ("frame", "time", "events", "integrator", "tolerance", "steps", "digest", "paused")


def frame_text(content: dict[str, Any]) -> str:
    """Return a frame record's JSON text from its members, in their order. Raises SessionError for NaN and infinities.

    Faster than `FrameRecord.to_json`: no record is constructed.

    Raises SessionError for NaN, infinities, and objects without a JSON form.
    """
    try:
        return _ENCODE(content)
    except (ValueError, TypeError) as error:
        raise SessionError(f"frame {content['frame']} cannot be recorded: {error}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRecord:
    """Record of one frame: events, settings, steps and digest; enough to run it again and to check the result."""

    frame: int
    """Index of the frame at the end of this advance; constant while paused."""
    time: float
    """Simulated time at its end [s]."""
    events: tuple[Mapping[str, Any], ...] = ()
    """Events applied at the beginning of the frame, in order; plain JSON objects."""
    integrator: str
    tolerance: float | None
    """Effective error tolerance [m]; None if the step is fixed."""
    steps: int
    digest: str
    """Digest of the full state at its end, hexadecimal."""
    paused: bool
    extras: Mapping[str, Any] = field(default_factory=dict)
    """Further JSON members, not needed to run the session again. `poses` maps each gripper that did not reach its
    target to its final pose: position [m] and quaternion x, y, z, w. `halted` lists bodies that are stopped until a new
    target."""

    def to_json(self) -> str:
        """Encode the record as JSON: keys in fixed order, floats in the shortest form with the same bits.

        Raises SessionError for NaN, infinities, and objects without a JSON form.
        """
        content: dict[str, Any] = {name: getattr(self, name) for name in _REQUIRED}
        content["events"] = [dict(event) for event in self.events]
        if self.extras:
            content["extras"] = dict(self.extras)
        return frame_text(content)

    @classmethod
    def from_json(cls, text: str) -> FrameRecord:
        """Decode a frame record from JSON. Raises SessionError with the reason if the text is no valid record."""
        try:
            content = plain_json.loads(
                text, parse_constant=_refuse_constant, parse_float=_parse_finite, object_pairs_hook=_unique_keys
            )
        except ValueError as error:
            raise SessionError(f"a frame record is not readable: {error}") from error
        if not isinstance(content, dict):
            raise SessionError(f"a frame record is a JSON object, not {text[:40]!r}")
        absent = [key for key in _REQUIRED if key not in content]
        unknown = [key for key in content if key not in _REQUIRED and key != "extras"]
        if absent or unknown:
            raise SessionError(f"a frame record lacks {absent} or has unknown keys {unknown}")
        _check_types(content)
        return cls(
            frame=content["frame"],
            time=float(content["time"]),
            events=tuple(content["events"]),
            integrator=content["integrator"],
            tolerance=None if content["tolerance"] is None else float(content["tolerance"]),
            steps=content["steps"],
            digest=content["digest"],
            paused=content["paused"],
            extras=content.get("extras", {}),
        )


def _check_types(content: dict[str, Any]) -> None:
    expected: dict[str, tuple[type, ...]] = {
        "frame": (int,),
        "time": (int, float),
        "events": (list,),
        "integrator": (str,),
        "tolerance": (int, float, type(None)),
        "steps": (int,),
        "digest": (str,),
        "paused": (bool,),
        "extras": (dict,),
    }
    for key, value in content.items():
        if not isinstance(value, expected[key]) or (isinstance(value, bool) and key != "paused"):
            raise SessionError(f"a frame record's {key} is {value!r}, expected {expected[key][0].__name__}")
    for key in ("frame", "steps"):
        if not 0 <= content[key] < 1 << 63:
            raise SessionError(f"a frame record's {key} is out of range; it must be from 0 to 2^63 - 1")
    for key in ("time", "tolerance"):
        if content[key] is not None and not abs(content[key]) <= _MAX_NUMBER:
            raise SessionError(f"a frame record's {key} is out of range; it must be at most {_MAX_NUMBER:g}")
    for name, (is_valid, description) in _EXTRA_CHECKS.items():
        if name in content.get("extras", {}) and not is_valid(content["extras"][name]):
            raise SessionError(f"a frame record's extras have '{name}' that is not {description}")
    if not all(isinstance(event, dict) for event in content["events"]):
        raise SessionError("a frame record's events are JSON objects")
    for event in content["events"]:
        for name, event_kinds, is_valid, description in _EVENT_CHECKS:
            if event.get("kind") in event_kinds and not is_valid(event.get(name)):
                raise SessionError(f"a frame record's event {str(event)[:200]} has no '{name}' that is {description}")


def _is_vector(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_number, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MAX_NUMBER


def _is_number_or_absent(value: Any) -> bool:
    return value is None or _is_number(value)


def _are_poses(value: Any) -> bool:
    return isinstance(value, dict) and all(_is_vector(pose) and len(pose) == 7 for pose in value.values())


def _are_rows(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_vector, value))


def _are_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _parse_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is beyond the range of a float")
    return value


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise ValueError(f"a key appears twice among {[key for key, _ in pairs]}")
    return content


#: Checks of the extras that are read: predicate and its description, by name.
_EXTRA_CHECKS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "poses": (_are_poses, "an object of lists of 7 numbers"),
    "halted": (_are_names, "a list of texts"),
}

#: Checks of events: name of a member, kinds of event that have it, predicate and its description.
_EVENT_CHECKS: tuple[tuple[str, tuple[str, ...], Callable[[Any], bool], str], ...] = (
    ("gripper", ("target", "grasp"), lambda value: isinstance(value, str), "a text"),
    ("obstacle", ("move",), lambda value: isinstance(value, str), "a text"),
    ("obstacles", ("move_obstacles",), _are_names, "a list of texts"),
    ("poses", ("move_obstacles",), _are_rows, "a list of lists of numbers"),
    ("obstacles", ("reset",), lambda value: value is None or _are_names(value), "a list of texts"),
    ("poses", ("reset",), lambda value: value is None or _are_rows(value), "a list of lists of numbers"),
    ("position", ("target", "move"), _is_vector, "a list of numbers"),
    ("orientation", ("target", "move"), lambda value: value is None or _is_vector(value), "numbers or null"),
    ("closed", ("grasp",), lambda value: isinstance(value, bool), "true or false"),
    ("opening", ("grasp",), _is_number_or_absent, "a number"),
    ("force", ("grasp",), _is_number_or_absent, "a number"),
    ("speed", ("grasp",), _is_number_or_absent, "a number"),
    ("values", ("set_parameters",), lambda value: isinstance(value, dict), "an object"),
    ("paused", ("pause",), lambda value: isinstance(value, bool), "true or false"),
    ("factor", ("relax",), _is_number, "a number"),
)
