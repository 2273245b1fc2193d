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
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.parameters import parameter_file
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
#: Number of bytes of such clouds and wrenches above which frames are run sooner.
_MAX_WAITING_BYTES = 1 << 30
#: Size of a message in memory besides its bytes.
_MESSAGE_SIZE = 200
#: Largest number of snapshots that wait for their record.
_MAX_SNAPSHOTS = 64
#: Number of compared clouds and wrenches that are recognised if they repeat.
_MAX_REPEATED = 2048
#: Number of different reasons why messages cannot be read that are reported, and of gaps.
_MAX_REASONS, _MAX_GAPS = 5, 20
#: Limits of a record's number, and of its time, which ROS holds as int32 seconds [ns].
_MAX_SEQUENCE, _MAX_STAMP = 1 << 63, 10**9 << 31


class _Key(NamedTuple):
    """Place of a frame record: index of the node's run in the bag, and number of the record in that run."""

    session: int
    sequence: int

    @property
    def successor(self) -> _Key:
        return _Key(self.session, self.sequence + 1)


class _PendingRecord(NamedTuple):
    """A recorded frame that has not been run again yet."""

    key: _Key
    record: FrameRecord
    stamp: int
    """ROS time at which the frame was due [ns]."""


@dataclass
class _Contents:
    """Index of one node's frame records and snapshots in the bag."""

    sessions: dict[str, int] = field(default_factory=dict)
    """Index by identifier of the node's run."""
    frames: dict[_Key, int] = field(default_factory=dict)
    """Frame number of each record."""
    hashes: dict[_Key, int] = field(default_factory=dict)
    """Hash of each record's bytes."""
    conflict_count: int = 0
    """Number of records that differ from an earlier one of the same number."""
    snapshots: set[_Key] = field(default_factory=set)
    """Next record of each snapshot."""
    unreadable: dict[str, int] = field(default_factory=dict)
    """Number of unreadable messages by reason, of the first few reasons."""

    def key(self, session: str, sequence: int) -> _Key:
        """Return the key of a record from its node's run and its number there; register the run if it is new."""
        return _Key(self.sessions.setdefault(session, len(self.sessions)), sequence)


def verify_bag(path: Path, *, on_frame: Callable[[], object] = lambda: None) -> list[Verdict]:
    """Run each node's cloth in a bag again, compare it with the bag; return a verdict for each. Raises SessionError.

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
        # Below the node's name there is its topic, or one of a gripper or an obstacle.
        node = message.topic.rpartition("/")[0]
        for owner in (node, node.rpartition("/")[0]):
            if owner in runs:
                runs[owner].add(message)
                break
    return [run.end() for run in runs.values()]


def _messages(files: list[Path], damage: list[str]) -> Iterator[Message]:
    """Yield a bag's messages, of each file up to its first damaged record, which is described in `damage`."""
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
                digest = hash(message.data)
                content.frames.setdefault(pending.key, pending.record.frame)
                content.conflict_count += content.hashes.setdefault(pending.key, digest) != digest
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
    if not (isinstance(session, str) and type(sequence) is int and type(stamp) is int):
        raise SessionError("its extras lack session, sequence or stamp")
    if not (0 <= sequence < _MAX_SEQUENCE and 0 <= stamp < _MAX_STAMP):
        raise SessionError("its sequence or its stamp is out of range")
    return _PendingRecord(content.key(session, sequence), record, stamp)


class _BagRun:
    """Re-run of one node's recorded frames, and comparison of its messages.

    Args:
        node: prefix of its topics.
        content: its frame records and snapshots in the whole bag.
        findings: collects the differences.
        on_frame: called after each frame.
    """

    def __init__(self, node: str, content: _Contents, findings: Findings, on_frame: Callable[[], object]) -> None:
        self._node, self._content, self._findings, self._on_frame = node, content, findings, on_frame
        self._topic, self._points, self._topology = f"{node}{_FRAME_LEAF}", f"{node}/points", f"{node}/topology"
        self._snapshot_topic = f"{node}{SNAPSHOT_LEAF}"
        self._start_time = time.perf_counter()
        #: Records from which a part of the bag is run, each with a snapshot before it.
        self._starts = sorted(_starts(content))
        self._is_start = set(self._starts).__contains__
        self._pending: list[_PendingRecord] = []
        self._seen: set[_Key] = set()
        self._last_key = _Key(-1, 0)
        self._snapshots: dict[_Key, BagSnapshot] = {}
        #: Clouds and wrenches by stamp [ns] and topic; several of one stamp if the clock jumped back.
        self._outputs: dict[int, dict[str, deque[Message]]] = {}
        self._waiting_bytes = 0
        #: Hashes of the last compared clouds and wrenches by stamp [ns] and topic.
        self._compared: dict[tuple[int, str], int] = {}
        #: First and last stamp of the last parts that were run [ns].
        self._parts: deque[tuple[int, int]] = deque(maxlen=8)
        #: Number of messages without their frame, by topic, between the first and the last stamp of a part.
        self._stray: Counter[str] = Counter()
        self._late_records = 0
        #: Topologies behind the last snapshot from which frames were run.
        self._topologies: list[Message] = []
        self._next: _Key | None = None
        self._simulation: Simulation | None = None
        self._has_clouds = False
        self._missing_clouds = 0
        self._wrench_topics: set[str] = set()

    def report_missing(self, damage: list[str]) -> None:
        """Set `damaged` in the verdict, and list there damaged files, unusable or missing messages, and gaps."""
        verdict = self._findings.verdict
        unreadable = (
            f"{pluralize(count, 'message')} of {reason}" for reason, count in self._content.unreadable.items()
        )
        verdict.missing += [*damage, *unreadable]
        if not self._content.snapshots:
            verdict.missing.append(f"no message of {self._node}{SNAPSHOT_LEAF}, from which the frames could be run")
        if count := self._content.conflict_count:
            verdict.missing.append(f"{pluralize(count, 'message')} of {self._topic} with another content for one frame")
        gaps = self._describe_gaps()
        verdict.missing += itertools.islice(gaps, _MAX_GAPS)
        if n_more := sum(1 for _ in gaps):
            verdict.missing.append(f"{pluralize(n_more, 'further gap')} of the records")
        verdict.damaged = bool(verdict.missing or not self._starts)

    def _describe_gaps(self) -> Iterator[str]:
        """Yield a sentence for each gap between frame records, from the first one that can be run on."""
        frames, starts = self._content.frames, self._starts
        for before, after in itertools.pairwise(sorted(frames)):
            # Before the first snapshot nothing is run.
            if after == before.successor or not starts or before < starts[0]:
                continue
            index = bisect.bisect_left(starts, after)
            end = (
                f"the run goes on with frame {frames[starts[index]]}"
                if index < len(starts)
                else "nothing behind them is run"
            )
            if before.session == after.session:
                count = pluralize(after.sequence - before.sequence - 1, "record")
                yield f"{count} between frames {frames[before]} and {frames[after]}; {end}"
            elif not self._is_start(after):
                yield f"no snapshot before frame {frames[after]}, with which the node began anew; {end}"

    def add(self, message: Message) -> None:
        """Take the node's next message: a frame record, snapshot or output; run frames whose messages are there."""
        topic = message.topic
        if topic == self._topic:
            self._add_record(message)
        elif topic == self._snapshot_topic:
            self._add_snapshot(message)
        elif topic == self._points or (topic.endswith("/wrench") and message.type_name == messages.WRENCH):
            self._add_output(message)
        elif topic == self._topology:
            self._topologies.append(message)
            if len(self._topologies) > _MAX_SNAPSHOTS:
                self._skip_topology(self._topologies.pop(0))
        else:
            self._findings.count_not_compared(topic, "a bag does not hold its frame")

    def end(self) -> Verdict:
        """Run the last frames, report the messages that no frame needed, and return the verdict."""
        while self._pending:
            self._run(self._pending.pop(0))
        findings, verdict = self._findings, self._findings.verdict
        self._compare_due_snapshot()
        self._compare_topologies(is_last=True)
        if self._snapshots:
            findings.count_not_compared(self._snapshot_topic, "of no frame that was run", len(self._snapshots))
        for stamp in list(self._outputs):
            while stamp in self._outputs:
                self._skip_outputs(stamp, self._take_outputs(stamp))
        if not self._has_clouds:
            findings.add_absent(self._points)
        elif self._missing_clouds:
            findings.add_deficit(f"{pluralize(self._missing_clouds, 'message')} of {self._points}")
            # Clouds are there, and not one belongs to a frame.
            verdict.damaged = verdict.damaged or not verdict.clouds
        if self._late_records:
            reason = f"came more than {_LAG} records late or with another node's of this name, and were not run"
            findings.add_deficit(f"{pluralize(self._late_records, 'message')} of {self._topic} {reason}")
        for topic, count in self._stray.items():
            findings.add_deficit(f"the frames of {pluralize(count, 'message')} of {topic}, by their stamps")
        verdict.damaged = bool(verdict.damaged or self._late_records or self._stray)
        verdict.seconds = time.perf_counter() - self._start_time
        return verdict

    def _add_record(self, message: Message) -> None:
        try:
            pending = _read_record(message, self._content)
        except SessionError:
            return
        if pending.key in self._seen:
            self._findings.count_not_compared(self._topic, "a second message of one frame")
            return
        self._seen.add(pending.key)
        if pending.key <= self._last_key:
            self._findings.count_not_compared(self._topic, "too late in the bag")
            self._late_records += 1
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
        # One behind the last record is compared, too.
        if key > self._last_key or key == self._next:
            self._snapshots[key] = snapshot
        else:
            self._findings.count_not_compared(self._snapshot_topic, "too late in the bag")
        if len(self._snapshots) > _MAX_SNAPSHOTS:
            del self._snapshots[max(self._snapshots)]
            self._findings.count_not_compared(self._snapshot_topic, "too early in the bag")

    def _add_output(self, message: Message) -> None:
        """Keep a cloud or a wrench for its frame. Above the limits, run frames sooner, and drop the oldest ones."""
        self._has_clouds = self._has_clouds or message.topic == self._points
        by_topic = self._outputs.setdefault(_header_stamp(message.data), {})
        by_topic.setdefault(message.topic, deque()).append(message)
        self._waiting_bytes += len(message.data) + _MESSAGE_SIZE
        while self._waiting_bytes > _MAX_WAITING_BYTES and self._pending:
            self._run(self._pending.pop(0))
        while len(self._outputs) > _MAX_WAITING or self._waiting_bytes > _MAX_WAITING_BYTES:
            stamp = next(iter(self._outputs))
            self._skip_outputs(stamp, self._take_outputs(stamp))

    def _run(self, pending: _PendingRecord) -> None:
        """Run the frame of a record again and compare it, if the state before the frame is known."""
        key, record, stamp = pending
        self._compare_due_snapshot()
        self._last_key = key
        snapshot = self._snapshots.pop(key, None)
        for earlier in [earlier for earlier in self._snapshots if earlier < key]:
            del self._snapshots[earlier]
            self._findings.count_not_compared(self._snapshot_topic, "of no frame that was run")
        if self._is_start(key):
            self._begin(key, snapshot)
        elif key != self._next:
            self._simulation = None
        self._next = key.successor
        simulation, findings, frame_outputs = self._simulation, self._findings, self._take_outputs(stamp)
        if simulation is None:
            findings.count_not_compared(self._topic, "without a snapshot before it")
            for topic in frame_outputs:
                findings.count_not_compared(topic, "of no frame that was run")
            return
        verdict = findings.verdict
        self._extend_part(stamp, is_first=self._is_start(key))
        findings.position = FramePosition(verdict.frames, record.frame, record.time)
        start_time = simulation.time
        verdict.frames += 1
        try:
            frame = simulation.advance([from_dict(dict(event)) for event in record.events])
        except (ValueError, UnstableError) as error:
            findings.add_difference("frame", f"it cannot be run: {error}")
            self._simulation = None
            return
        verdict.simulated += simulation.time - start_time
        labels = {name: record.extras[name] for name in ("session", "sequence", "stamp")}
        compare_record(record, frame, simulation, findings, topic=self._topic, labels=labels)
        self._compare_outputs(frame, simulation, stamp, frame_outputs)
        self._on_frame()

    def _extend_part(self, stamp: int, *, is_first: bool) -> None:
        """Extend the time span of the current part of the bag by the stamp of a frame that is run [ns]."""
        first, last = (stamp, stamp) if is_first else self._parts.pop()
        self._parts.append((min(first, stamp), max(last, stamp)))

    def _begin(self, key: _Key, snapshot: BagSnapshot | None) -> None:
        """Begin a part of the bag: build the simulation from its snapshot, or report why there is none."""
        findings, self._simulation = self._findings, None
        if snapshot is None:
            frame = self._content.frames[key]
            findings.add_deficit(f"the snapshot before frame {frame} among the {_LAG} records around it")
            findings.verdict.damaged = True
            return
        content = snapshot.snapshot
        verdict, metadata = findings.verdict, content.metadata
        try:
            values = recorded_values(content.scene_yaml, node=metadata.get("node", ""))
            simulation = Simulation(Scene.from_parameters(values, files=content.files), State.from_bytes(content.state))
        except ValueError as error:
            findings.add_deficit(f"a snapshot holds no scene that can be run here: {error}")
            verdict.damaged = True
            return
        self._simulation, scene = simulation, simulation.scene
        self._wrench_topics = {f"{self._node}/{name}/wrench" for name in (*scene.gripper_names, *scene.obstacle_names)}
        self._clouds = outputs.CloudCheck(scene, findings)
        self._compare_topologies(is_last=False)
        verdict.other_arithmetic = verdict.other_arithmetic or recorder_with_other_arithmetic(metadata)
        environment = [] if verdict.other_arithmetic else differences(metadata)
        absent = sorted(set(simulation.scene.files) - set(content.files))
        environment += [f"{name} as found here: the bag does not hold it" for name in absent]
        verdict.environment += [entry for entry in environment if entry not in verdict.environment]

    def _compare_topologies(self, *, is_last: bool) -> None:
        """Compare the waiting topology messages with the scene; those of other runs of the node are skipped."""
        waiting, self._topologies = self._topologies, []
        scene = None if self._simulation is None else self._simulation.scene
        for index, message in enumerate(waiting):
            is_due = len(self._content.sessions) == 1 or (index == len(waiting) - 1 and not is_last)
            if scene is not None and (is_due or outputs.is_topology_of(message, scene)):
                self._findings.count_compared("topology")
                outputs.compare_topology(message, scene, self._findings)
            else:
                self._skip_topology(message)

    def _skip_topology(self, message: Message) -> None:
        self._findings.count_not_compared(message.topic, "of no frame that was run")

    def _compare_due_snapshot(self) -> None:
        """Compare the snapshot after the last frame with the re-run, unless a part of the bag begins with it."""
        if self._simulation is None or self._next is None or self._is_start(self._next):
            return
        snapshot = self._snapshots.pop(self._next, None)
        if snapshot is None:
            return
        self._findings.count_compared("snapshot")
        reason, is_rounding = _snapshot_difference(snapshot, self._simulation)
        if reason:
            self._findings.add_difference("snapshot", f"the snapshot behind it{reason}", rounding=is_rounding)

    def _take_outputs(self, stamp: int) -> dict[str, Message]:
        """Remove and return, by topic, the first waiting cloud and wrenches of a stamp [ns]."""
        by_topic = self._outputs.get(stamp, {})
        frame_outputs = {topic: entries.popleft() for topic, entries in by_topic.items()}
        for topic in [topic for topic, entries in by_topic.items() if not entries]:
            del by_topic[topic]
        if not by_topic:
            self._outputs.pop(stamp, None)
        self._waiting_bytes -= sum(len(message.data) + _MESSAGE_SIZE for message in frame_outputs.values())
        return frame_outputs

    def _skip_outputs(self, stamp: int, frame_outputs: dict[str, Message]) -> None:
        """Count the clouds and wrenches of a stamp [ns] that belong to no frame that was run as not compared."""
        is_inside = stamp < 0 or any(first <= stamp <= last for first, last in self._parts)
        for topic, message in frame_outputs.items():
            if self._compared.get((stamp, topic)) == hash(message.data):
                self._findings.count_not_compared(topic, "a second message of one frame")
                continue
            self._findings.count_not_compared(topic, "of no frame that was run")
            if is_inside and (topic == self._points or topic in self._wrench_topics):
                self._stray[topic] += 1

    def _remember_compared(self, stamp: int, message: Message) -> None:
        """Remember a compared cloud or wrench of a stamp [ns], to recognize its repetition."""
        self._compared[stamp, message.topic] = hash(message.data)
        if len(self._compared) > _MAX_REPEATED:
            del self._compared[next(iter(self._compared))]

    def _compare_outputs(
        self, frame: Frame, simulation: Simulation, stamp: int, frame_outputs: dict[str, Message]
    ) -> None:
        findings, scene = self._findings, simulation.scene
        cloud = frame_outputs.pop(self._points, None)
        if cloud is None:
            self._missing_clouds += 1
        else:
            findings.count_compared("cloud")
            self._remember_compared(stamp, cloud)
            self._clouds.compare(cloud, simulation, stamp)
        for name, wrench in outputs.wrenches(scene, frame):
            message = frame_outputs.pop(f"{self._node}/{name}/wrench", None)
            if message is not None:
                findings.count_compared("wrench")
                self._remember_compared(stamp, message)
                outputs.compare_wrench(message, wrench, frame_id=scene.frame_id, stamp=stamp, findings=findings)
        for topic in frame_outputs:
            findings.count_not_compared(topic, "of no gripper or obstacle")


def _snapshot_difference(snapshot: BagSnapshot, simulation: Simulation) -> tuple[str, bool]:
    """Return the difference of a snapshot from the re-run as text, "" if none, and True if rounding can cause it."""
    content = snapshot.snapshot
    try:
        if State.from_bytes(content.state).digest() != simulation.state.digest():
            return ", by its state", True
        node = content.metadata.get("node", "")
        recorded = recorded_values(content.scene_yaml, node=node)
        current = recorded_values(parameter_file.dump(simulation.scene.parameters()), node=node)
    except ValueError as error:
        return f", which cannot be read: {error}", False
    # Older versions lack some parameters.
    differing = [name for name, value in recorded.items() if current.get(name, value) != value]
    return (f", by its {differing[0]}", False) if differing else ("", False)


def _starts(content: _Contents) -> Iterator[_Key]:
    """Yield the records at which a re-run begins: each follows a snapshot, and no record that is run."""
    expected: _Key | None = None
    for key in sorted(content.frames):
        if key == expected:
            expected = key.successor
        elif key in content.snapshots:
            yield key
            expected = key.successor


def _header_stamp(data: bytes) -> int:
    """Return the stamp [ns] of a message that begins with a header; -1 if it is cut off or invalid."""
    if len(data) < 12:
        return -1
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
    if not (seconds >= 0 and nanoseconds < 1_000_000_000):
        return -1
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
