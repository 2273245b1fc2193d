# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Re-run of the cloths in a bag that another program recorded.

The recorder of a bag starts at any moment, may lose messages, and writes those of different topics in any order.
Therefore frame records are numbered, and a snapshot names the number of the next record. A part of the bag is run if it
begins with a snapshot and lacks no record. Clouds and wrenches belong to the frame with their stamp.
"""

from __future__ import annotations

import bisect
import itertools
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.bag import SNAPSHOT_LEAF, SNAPSHOT_TYPE, bag_files, bag_messages
from cloth_sim_ros.session.cdr import decode_string
from cloth_sim_ros.session.errors import DamagedSessionError, SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.session.snapshot_message import BagSnapshot, read_snapshot
from cloth_sim_ros.simulation.environment import differences, recorder_with_other_arithmetic
from cloth_sim_ros.simulation.events import from_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify import outputs
from cloth_sim_ros.verify.frame_records import compare_record
from cloth_sim_ros.verify.verdict import Findings, FramePosition, Verdict

_FRAME_LEAF = "/frame"
#: Number of later frame records after which a frame is run: its other messages may be a second late in the bag.
_LAG = 64
#: Largest number of stamps whose clouds and wrenches wait for their frame.
_MAX_WAITING = 4 * _LAG
#: Number of different reasons why messages cannot be read that are reported.
_MAX_REASONS = 5


class _Key(NamedTuple):
    """Place of a frame record: index of the node's run in the bag, and number of the record in that run."""

    session: int
    sequence: int

    @property
    def successor(self) -> _Key:
        return _Key(self.session, self.sequence + 1)


class _PendingRecord(NamedTuple):
    """A frame record that is not run yet."""

    key: _Key
    record: FrameRecord
    stamp: int
    """ROS time at which the frame was due [ns]."""


@dataclass
class _Contents:
    """Frame records and snapshots of one node in the bag."""

    sessions: dict[str, int] = field(default_factory=dict)
    """Index by identifier of the node's run."""
    frames: dict[_Key, int] = field(default_factory=dict)
    """Frame number of each record."""
    snapshots: set[_Key] = field(default_factory=set)
    """Next record of each snapshot."""
    unreadable: dict[str, int] = field(default_factory=dict)
    """Number of unreadable messages by reason, of the first few reasons."""

    def key(self, session: str, sequence: int) -> _Key:
        """Return the place of a record."""
        return _Key(self.sessions.setdefault(session, len(self.sessions)), sequence)


def verify_bag(path: Path, *, on_frame: Callable[[], object] = lambda: None) -> list[Verdict]:
    """Run each cloth of a bag again and compare it with the bag.

    Args:
        path: the bag's folder or its file.
        on_frame: called after each frame.

    Returns:
        A verdict for each node whose frame records are in the bag; none if there is no such node.

    Raises:
        SessionError: if a file cannot be read, or if it is damaged before the first frame record.
    """
    files, damage = bag_files(path), list[str]()
    contents = _read_contents(_messages(files, damage))
    if damage and not contents:
        raise DamagedSessionError(damage[0])
    runs = {}
    for node, content in contents.items():
        name = path.name if len(contents) == 1 else f"{path.name}, {node}"
        runs[node] = _BagRun(node, content, Findings(Verdict(name=name)), on_frame)
        runs[node].report_missing(damage)
    for message in _messages(files, []):
        for node, run in runs.items():
            if message.topic.startswith(f"{node}/"):
                run.add(message)
    return [run.end() for run in runs.values()]


def _messages(files: list[Path], damage: list[str]) -> Iterator[Message]:
    """Yield the messages of a bag up to the first damaged record of each file; add the damage."""
    for path in files:
        try:
            for topic, kind, log_time, data in bag_messages(path):
                yield Message(topic, kind, data, log_time, log_time, 0)
        except DamagedSessionError as error:
            damage.append(str(error))


def _read_contents(stream: Iterator[Message]) -> dict[str, _Contents]:
    """Return the frame records and snapshots by node; nodes without numbered frame records are left out."""
    contents: dict[str, _Contents] = {}
    for message in stream:
        is_frame = message.type_name == messages.STRING and message.topic.endswith(_FRAME_LEAF)
        if not is_frame and not (message.type_name == SNAPSHOT_TYPE and message.topic.endswith(SNAPSHOT_LEAF)):
            continue
        content = contents.setdefault(message.topic.rpartition("/")[0], _Contents())
        try:
            if is_frame:
                pending = _read_record(message, content)
                content.frames.setdefault(pending.key, pending.record.frame)
            else:
                snapshot = read_snapshot(message.data)
                content.snapshots.add(content.key(snapshot.session, snapshot.sequence))
        except SessionError as error:
            reason = f"{message.topic} cannot be read: {error}"
            if reason in content.unreadable or len(content.unreadable) < _MAX_REASONS:
                content.unreadable[reason] = content.unreadable.get(reason, 0) + 1
    return {node: content for node, content in contents.items() if content.frames}


def _read_record(message: Message, content: _Contents) -> _PendingRecord:
    record = FrameRecord.from_json(decode_string(message.data))
    session, sequence, stamp = (record.extras.get(name) for name in ("session", "sequence", "stamp"))
    if not (isinstance(session, str) and isinstance(sequence, int) and isinstance(stamp, int)):
        raise SessionError("its extras lack session, sequence or stamp")
    return _PendingRecord(content.key(session, sequence), record, stamp)


class _BagRun:
    """Re-run of one node's frames.

    Args:
        node: prefix of its topics.
        content: its frame records and snapshots in the whole bag.
        findings: collects the differences.
        on_frame: called after each frame.
    """

    def __init__(self, node: str, content: _Contents, findings: Findings, on_frame: Callable[[], object]) -> None:
        self._node, self._content, self._findings, self._on_frame = node, content, findings, on_frame
        self._topic, self._points, self._topology = f"{node}{_FRAME_LEAF}", f"{node}/points", f"{node}/topology"
        self._start_time = time.perf_counter()
        #: Records from which a part of the bag is run, each with a snapshot before it.
        self._starts = set(_starts(content))
        self._pending: list[_PendingRecord] = []
        self._last_key = _Key(-1, 0)
        self._snapshots: dict[_Key, BagSnapshot] = {}
        #: Clouds and wrenches by stamp [ns] and topic; several of one stamp if the clock jumped back.
        self._outputs: dict[int, dict[str, list[Message]]] = {}
        self._topology_message: Message | None = None
        self._next: _Key | None = None
        self._simulation: Simulation | None = None
        self._has_clouds = False
        self._missing_clouds = 0

    def report_missing(self, damage: list[str]) -> None:
        """Report damaged files, unreadable messages, and the frame records that are missing between others."""
        verdict, frames = self._findings.verdict, self._content.frames
        unreadable = (
            f"{pluralize(count, 'message')} of {reason}" for reason, count in self._content.unreadable.items()
        )
        verdict.missing += [*damage, *unreadable]
        if not self._content.snapshots:
            verdict.missing.append(f"no message of {self._node}{SNAPSHOT_LEAF}, from which the frames could be run")
        keys = sorted(frames)
        first = min(self._starts, default=None)
        for before, after in itertools.pairwise(keys):
            # A new run of the node begins with a snapshot; before the first one nothing is run.
            if after == before.successor or before.session != after.session or first is None or before < first:
                continue
            count = pluralize(after.sequence - before.sequence - 1, "record")
            resumed = min((start for start in self._starts if start >= after), default=None)
            end = "nothing behind them is run" if resumed is None else f"the run goes on with frame {frames[resumed]}"
            verdict.missing.append(f"{count} between frames {frames[before]} and {frames[after]}; {end}")
            verdict.damaged = True
        verdict.damaged = bool(verdict.damaged or damage or self._content.unreadable or not self._starts)

    def add(self, message: Message) -> None:
        """Add a message of the node."""
        topic = message.topic
        if topic == self._topic:
            self._add_record(message)
        elif topic == f"{self._node}{SNAPSHOT_LEAF}":
            self._add_snapshot(message)
        elif topic == self._points or (topic.endswith("/wrench") and message.type_name == messages.WRENCH):
            self._has_clouds = self._has_clouds or topic == self._points
            self._outputs.setdefault(_header_stamp(message.data), {}).setdefault(topic, []).append(message)
            if len(self._outputs) > _MAX_WAITING:
                self._skip_outputs(self._take_outputs(next(iter(self._outputs))))
        elif topic == self._topology:
            self._topology_message = message
        else:
            self._findings.not_compared(topic, "a bag does not hold its frame")

    def end(self) -> Verdict:
        """Run the last frames; return the verdict."""
        while self._pending:
            self._run(self._pending.pop(0))
        findings, verdict = self._findings, self._findings.verdict
        for stamp in list(self._outputs):
            while stamp in self._outputs:
                self._skip_outputs(self._take_outputs(stamp))
        if not self._has_clouds:
            findings.absent(self._points)
        elif self._missing_clouds:
            findings.missing(f"{pluralize(self._missing_clouds, 'message')} of {self._points}")
        verdict.seconds = time.perf_counter() - self._start_time
        return verdict

    def _add_record(self, message: Message) -> None:
        try:
            pending = _read_record(message, self._content)
        except SessionError:
            return
        if pending.key <= self._last_key or any(pending.key == entry.key for entry in self._pending):
            self._findings.not_compared(self._topic, "a second message of one frame")
            return
        bisect.insort(self._pending, pending, key=lambda entry: entry.key)
        if len(self._pending) > _LAG:
            self._run(self._pending.pop(0))

    def _add_snapshot(self, message: Message) -> None:
        try:
            snapshot = read_snapshot(message.data)
        except SessionError:
            return
        key = self._content.key(snapshot.session, snapshot.sequence)
        if key > self._last_key:
            self._snapshots[key] = snapshot

    def _run(self, pending: _PendingRecord) -> None:
        """Run the frame of a record, if the state before it is known."""
        key, record, stamp = pending
        self._last_key = key
        snapshot = self._snapshots.pop(key, None)
        self._snapshots = {later: entry for later, entry in self._snapshots.items() if later > key}
        if snapshot is not None and key in self._starts:
            self._begin(snapshot)
        elif snapshot is not None and key == self._next:
            self._compare_snapshot(snapshot)
        elif key != self._next:
            self._simulation = None
        self._next = key.successor
        simulation, findings, frame_outputs = self._simulation, self._findings, self._take_outputs(stamp)
        if simulation is None:
            findings.not_compared(self._topic, "without a snapshot before it")
            self._skip_outputs(frame_outputs)
            return
        verdict = findings.verdict
        findings.position = FramePosition(verdict.frames, record.frame, record.time)
        start_time = simulation.time
        verdict.frames += 1
        try:
            frame = simulation.advance([from_dict(dict(event)) for event in record.events])
        except (ValueError, UnstableError) as error:
            findings.difference("frame", f"it cannot be run: {error}")
            self._simulation = None
            return
        verdict.simulated += simulation.time - start_time
        labels = {name: record.extras[name] for name in ("session", "sequence", "stamp")}
        compare_record(record, frame, simulation, findings, topic=self._topic, labels=labels)
        self._compare_outputs(frame, simulation, stamp, frame_outputs)
        self._on_frame()

    def _begin(self, snapshot: BagSnapshot) -> None:
        """Begin a part of the bag."""
        findings, content = self._findings, snapshot.snapshot
        verdict, metadata = findings.verdict, content.metadata
        try:
            values = recorded_values(content.scene_yaml, node=metadata.get("node", ""))
            simulation = Simulation(Scene.from_parameters(values, files=content.files), State.from_bytes(content.state))
        except ValueError as error:
            findings.missing(f"a snapshot holds no scene that can be run here: {error}")
            verdict.damaged, self._simulation = True, None
            return
        self._simulation = simulation
        self._clouds = outputs.CloudCheck(simulation.scene, findings)
        if self._topology_message is not None:
            findings.compared("topology")
            outputs.compare_topology(self._topology_message, simulation.scene, findings)
            self._topology_message = None
        verdict.other_arithmetic = verdict.other_arithmetic or recorder_with_other_arithmetic(metadata)
        environment = [] if verdict.other_arithmetic else differences(metadata)
        absent = sorted(set(simulation.scene.files) - set(content.files))
        environment += [f"{name} as found here: the bag does not hold it" for name in absent]
        verdict.environment += [entry for entry in environment if entry not in verdict.environment]

    def _compare_snapshot(self, snapshot: BagSnapshot) -> None:
        """Compare a snapshot that the run does not need."""
        if self._simulation is None:
            return
        self._findings.compared("snapshot")
        try:
            is_same = State.from_bytes(snapshot.snapshot.state).digest() == self._simulation.state.digest()
        except ValueError:
            is_same = False
        if not is_same:
            self._findings.difference("snapshot", "the snapshot behind it", rounding=True)

    def _take_outputs(self, stamp: int) -> dict[str, Message]:
        """Remove and return the first clouds and wrenches of a stamp [ns] by topic."""
        by_topic = self._outputs.pop(stamp, {})
        if later := {topic: entries[1:] for topic, entries in by_topic.items() if len(entries) > 1}:
            self._outputs[stamp] = later
        return {topic: entries[0] for topic, entries in by_topic.items()}

    def _skip_outputs(self, frame_outputs: dict[str, Message]) -> None:
        for topic in frame_outputs:
            self._findings.not_compared(topic, "of no frame that was run")

    def _compare_outputs(
        self, frame: Frame, simulation: Simulation, stamp: int, frame_outputs: dict[str, Message]
    ) -> None:
        findings, scene = self._findings, simulation.scene
        cloud = frame_outputs.pop(self._points, None)
        if cloud is None:
            self._missing_clouds += 1
        else:
            findings.compared("cloud")
            self._clouds.compare(cloud, simulation, stamp)
        for name, wrench in outputs.wrenches(scene, frame):
            message = frame_outputs.pop(f"{self._node}/{name}/wrench", None)
            if message is not None:
                findings.compared("wrench")
                outputs.compare_wrench(message, wrench, frame_id=scene.frame_id, stamp=stamp, findings=findings)
        self._skip_outputs(frame_outputs)


def _starts(content: _Contents) -> Iterator[_Key]:
    """Yield the records that begin a part of the bag: each follows a snapshot, and no record that is run."""
    expected: _Key | None = None
    for key in sorted(content.frames):
        if key == expected:
            expected = key.successor
        elif key in content.snapshots:
            yield key
            expected = key.successor


def _header_stamp(data: bytes) -> int:
    """Return the stamp of a message that begins with a header [ns]; -1 if it is cut off."""
    if len(data) < 12:
        return -1
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
