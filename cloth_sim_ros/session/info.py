# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Summary of a session on one screen."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode_cloud, decode_mesh
from cloth_sim_ros.session.console import printable
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.session.reader import SessionReader, read_frame

_MAX_NOTABLE_EVENTS = 12
_TARGET_EVENTS = ("target", "move", "move_obstacles")


@dataclass(slots=True)
class TopicSummary:
    """Type of the messages of one topic, their number and size, and the number of missing ones."""

    type_name: str
    count: int = 0
    size: int = 0
    """Size of all messages [bytes]."""
    n_missing: int = 0
    """Messages whose sequence numbers are absent: dropped, or in a damaged chunk."""
    next_sequence: int | None = None


@dataclass(slots=True)
class SessionSummary:
    """Counts, sizes, times and events of one session, which a `Summarizer` fills message by message."""

    topics: dict[str, TopicSummary] = field(default_factory=dict)
    first_time: int | None = None
    """Earliest log time [ns since the epoch]."""
    last_time: int | None = None
    advances: int = 0
    """Number of frame records, including those while paused."""
    first_frame: int | None = None
    last_frame: int | None = None
    simulated: tuple[float, float] | None = None
    """Simulated time of the first and the last frame record [s]."""
    steps: list[int] = field(default_factory=lambda: [0, 0, 0])
    """Minimum, maximum and sum of the steps per frame."""
    integrators: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    notable_events: list[str] = field(default_factory=list)
    """The first events that are not targets, each with its time."""
    grid: tuple[int, int] | None = None
    """Height and width of the clouds."""
    triangles: int | None = None

    @property
    def seconds(self) -> float:
        """Span of the log times [s]."""
        return 0.0 if self.first_time is None or self.last_time is None else (self.last_time - self.first_time) * 1e-9


class Summarizer:
    """Builder of a `SessionSummary` from a session's messages, one by one."""

    def __init__(self, node: str) -> None:
        self.summary = SessionSummary()
        self._node = node

    def add(self, message: Message) -> None:
        """Add the next message to `summary`. Raises SessionError for a frame, cloud or mesh that does not decode."""
        summary = self.summary
        topic = summary.topics.setdefault(message.topic, TopicSummary(message.type_name))
        topic.count += 1
        topic.size += len(message.data)
        if topic.next_sequence is not None and message.sequence > topic.next_sequence:
            topic.n_missing += message.sequence - topic.next_sequence
        topic.next_sequence = message.sequence + 1
        time = message.log_time
        summary.first_time = time if summary.first_time is None else min(summary.first_time, time)
        summary.last_time = time if summary.last_time is None else max(summary.last_time, time)
        if message.topic == f"{self._node}/frame":
            self._add_frame(message)
        elif message.topic == f"{self._node}/points" and summary.grid is None:
            cloud = decode_cloud(message.data)
            summary.grid = (cloud.height, cloud.width)
        elif message.topic == f"{self._node}/topology" and summary.triangles is None:
            summary.triangles = len(decode_mesh(message.data).triangles)

    def _add_frame(self, message: Message) -> None:
        summary = self.summary
        frame = read_frame(message)
        summary.advances += 1
        if summary.first_frame is None or summary.simulated is None:
            summary.first_frame = frame.frame
            summary.simulated = (frame.time, frame.time)
            summary.steps[0] = frame.steps
        summary.last_frame = frame.frame
        summary.simulated = (summary.simulated[0], frame.time)
        summary.steps[0] = min(summary.steps[0], frame.steps)
        summary.steps[1] = max(summary.steps[1], frame.steps)
        summary.steps[2] += frame.steps
        tolerance = "fixed step" if frame.tolerance is None else f"tolerance {frame.tolerance:g} m"
        summary.integrators[f"{frame.integrator} ({tolerance})"] += 1
        for event in frame.events:
            kind = str(event.get("kind", "?"))
            summary.events[kind] += 1
            if kind not in _TARGET_EVENTS and len(summary.notable_events) < _MAX_NOTABLE_EVENTS:
                summary.notable_events.append(f"{frame.time:9.3f} s  {kind} {_format_event(event)}".rstrip())


def render(reader: SessionReader, summary: SessionSummary) -> str:
    """Return the summary as lines for the terminal; call it after `reader` has read the session to its end."""
    size = sum(part.size() for part in reader.parts)
    lines = [part.path.name for part in reader.parts[:3]]
    if len(reader.parts) > 3:
        lines.append(f"... {len(reader.parts) - 3} more files")
    lines += [
        _line("state", "complete" if reader.missing is None else reader.missing),
        _line("ends", _end_reason(reader.parts[-1])),
        _line("recorded", _format_time(summary)),
        _line("size", f"{size / 1e6:,.1f} MB{_per_hour(size, summary.seconds)}"),
        _line("by", ", ".join(f"{key} {value}" for key, value in _visible_metadata(reader.metadata).items())),
        "",
        _line("cloth", _cloth(summary)),
        _line("frames", _frames(summary)),
        _line("integrator", ", ".join(f"{name} x {count}" for name, count in summary.integrators.most_common(3))),
        _line("steps", _steps(summary)),
        _line("events", ", ".join(f"{kind} {count}" for kind, count in summary.events.most_common()) or "none"),
        *(" " * 12 + printable(event) for event in summary.notable_events),
    ]
    n_hidden = sum(n for kind, n in summary.events.items() if kind not in _TARGET_EVENTS) - len(summary.notable_events)
    if n_hidden > 0:
        lines.append(" " * 12 + f"... and {n_hidden} more")
    lines += ["", f"{'topic':36} {'type':34} {'count':>8} {'MB':>9} {'lost':>6}"]
    for name, topic in sorted(summary.topics.items()):
        short = printable(topic.type_name.replace("/msg/", "/"))
        lines.append(f"{printable(name):36} {short:34} {topic.count:8} {topic.size / 1e6:9.2f} {topic.n_missing:6}")
    return "\n".join(lines)


def to_json(reader: SessionReader, summary: SessionSummary) -> dict[str, Any]:
    """Return the summary as a JSON object (dict); call it after `reader` has read the session to its end."""
    return {
        "files": [str(part.path) for part in reader.parts],
        "bytes": sum(part.size() for part in reader.parts),
        "complete": reader.missing is None,
        "missing": reader.missing,
        "metadata": dict(reader.metadata),
        "end": [dict(part.end_notes) for part in reader.parts],
        "log_time": [summary.first_time, summary.last_time],
        "advances": summary.advances,
        "frames": [summary.first_frame, summary.last_frame],
        "simulated_time": summary.simulated,
        "steps": old_keys.add_old_keys(
            dict(zip(("min", "max", "sum"), summary.steps, strict=True)), old_keys.SESSION_SUMMARY
        ),
        "integrators": dict(summary.integrators),
        "events": dict(summary.events),
        "grid": summary.grid,
        "triangles": summary.triangles,
        "topics": {
            name: {"type": topic.type_name, "count": topic.count, "bytes": topic.size, "lost": topic.n_missing}
            for name, topic in sorted(summary.topics.items())
        },
    }


def _line(label: str, text: str) -> str:
    return f"{label:11} {printable(text)}"


def _format_event(event: Mapping[str, Any]) -> str:
    text = " ".join(f"{key}={value}" for key, value in event.items() if key != "kind")
    return text if len(text) <= 80 else text[:77] + "..."


def _end_reason(part: SessionPart) -> str:
    reason = part.end_notes.get("reason")
    if reason is not None:
        return reason
    if part.is_being_written():
        return "not yet: it is still being recorded"
    return "unknown: the record 'cloth_sim_end' is missing, as after a copy by a tool" if part.finished else "cut off"


def _format_time(summary: SessionSummary) -> str:
    if summary.first_time is None:
        return "nothing"
    start = datetime.datetime.fromtimestamp(summary.first_time * 1e-9, datetime.UTC)
    return f"{start:%Y-%m-%d %H:%M:%S} UTC (by the node's clock), {summary.seconds:.2f} s"


def _per_hour(size: int, seconds: float) -> str:
    return f", {size / seconds * 3600 / 1e9:,.2f} GB an hour" if seconds > 0 else ""


def _visible_metadata(metadata: Mapping[str, str]) -> dict[str, str]:
    hidden = ("checksum", "session", "part", "format")
    return {key: value for key, value in metadata.items() if key not in hidden and len(value) <= 60}


def _cloth(summary: SessionSummary) -> str:
    if summary.grid is None:
        return "no clouds"
    height, width = summary.grid
    shape = f"{height} x {width}, {height * width} particles" if height > 1 else f"{width} particles"
    return shape if summary.triangles is None else f"{shape}, {pluralize(summary.triangles, 'triangle')}"


def _frames(summary: SessionSummary) -> str:
    if summary.simulated is None:
        return "none"
    first, last = summary.simulated
    speed = f", {(last - first) / summary.seconds:.2f} x real time" if summary.seconds > 0 else ""
    frames = f"{summary.first_frame} to {summary.last_frame} ({pluralize(summary.advances, 'record')})"
    return f"{frames}, {first:.3f} to {last:.3f} s simulated{speed}"


def _steps(summary: SessionSummary) -> str:
    if not summary.advances:
        return "none"
    min_steps, max_steps, total_steps = summary.steps
    return f"{total_steps / summary.advances:.1f} a frame, {min_steps} to {max_steps}"
