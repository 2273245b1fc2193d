# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Re-run of a recorded session from its own snapshot and events, and comparison of every message."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.reader import SPLIT, SessionReader, read_frame
from cloth_sim_ros.session.writer import FILE_PREFIX, SCENE_NAME, STATE_NAME
from cloth_sim_ros.simulation.environment import differences, recorder_with_other_arithmetic
from cloth_sim_ros.simulation.events import Event, from_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.commands import CommandCheck
from cloth_sim_ros.verify.completeness import CompletenessCheck
from cloth_sim_ros.verify.declarations import compare_declarations
from cloth_sim_ros.verify.diagnostics import TOPIC as DIAGNOSTICS
from cloth_sim_ros.verify.diagnostics import DiagnosticsCheck
from cloth_sim_ros.verify.ensemble import EnsembleCheck
from cloth_sim_ros.verify.frame_outputs import FrameOutputCheck
from cloth_sim_ros.verify.frame_records import compare_record
from cloth_sim_ros.verify.verdict import Findings, FramePosition, Verdict

__all__ = ["RunObserver", "Verdict", "verify"]

#: Topics that the node shares with others, with their description.
_SHARED = {"/rosout": "texts of the log", "/parameter_events": "changes of parameters, as the node announced them"}
#: Reasons of an end after a complete frame; after any other end, the last frame may lack messages.
_CLEAN_END_REASONS = frozenset({"stopped", "split", "node stopped", "~/record", "failed"})
#: Simulated time after which a node's recording must have diagnostics [s].
_DIAGNOSTICS_WITHIN = 10.0


class RunObserver(Protocol):
    """Observer of a session's re-run; `verify` calls its methods for each frame, its cloud and its end."""

    def on_frame(
        self, simulation: Simulation, scene_before: Scene, before: State, frame: Frame, record: FrameRecord
    ) -> None:
        """Receive a frame that was run again, with the scene and the state before it, and its record."""

    def on_cloud(self, recorded: NDArray[np.floating], is_same: bool) -> None:
        """Receive the frame's recorded positions (n, 3) [m]; `is_same`: they equal those of the re-run."""

    def on_frame_end(self) -> None:
        """Receive the end of a frame's messages; also called without a frame."""


def verify(
    paths: Sequence[Path],
    *,
    on_progress: Callable[[int], None] = lambda _bytes: None,
    observer: RunObserver | None = None,
) -> Verdict:
    """Run a session again and compare each message with the recording; return the verdict. Raises SessionError.

    Args:
        paths: the files of one session, in order.
        on_progress: receives the number of bytes read so far.
        observer: receives the frames.

    Raises:
        SessionError: if a file cannot be read, or its scene and state make no simulation.
    """
    start_time = time.perf_counter()
    with SessionReader(list(paths)) as reader:
        verdict = Verdict(name=", ".join(path.name for path in paths))
        verdict.other_arithmetic = recorder_with_other_arithmetic(reader.metadata)
        if not verdict.other_arithmetic:
            verdict.environment = differences(reader.metadata)
        run, finished_bytes = _SessionRun(reader.node, Findings(verdict), observer), 0
        for part in reader.parts:
            run.begin(part)
            part.rewind()
            is_whole = True
            for message in part.messages():
                if not run.add(message):
                    is_whole = False
                    break
                on_progress(finished_bytes + part.position)
            run.finish(whole=is_whole)
            verdict.damaged = verdict.damaged or bool(part.damage)
            finished_bytes += part.size()
        run.end()
        if reader.missing:
            verdict.missing.insert(0, reader.missing)
    verdict.seconds = time.perf_counter() - start_time
    return verdict


class _SessionRun:
    """Re-run of a session and comparison of its messages, file by file."""

    def __init__(self, node: str, findings: Findings, observer: RunObserver | None) -> None:
        self._node, self._findings, self._observer = node, findings, observer
        self._verdict = findings.verdict
        self._frame_topic, self._points = f"{node}/frame", f"{node}/points"
        self._completeness = CompletenessCheck(findings)
        self._completeness.declare(self._frame_topic, "frame", droppable=False)
        self._completeness.declare(self._points, "cloud", droppable=True)
        self._completeness.declare(DIAGNOSTICS, "diagnostics message", droppable=False)
        self._ensemble = EnsembleCheck(node, self._completeness, findings)
        self._completeness.declare(self._ensemble.topic, "ensemble cloud", droppable=True)
        self._previous: Simulation | None = None
        self._commands: CommandCheck | None = None
        self._diagnostics: DiagnosticsCheck | None = None

    def begin(self, part: SessionPart) -> None:
        """Begin a file: build the simulation and the checks from its opening snapshot. Raises SessionError."""
        self._part = part
        self.simulation = simulation = _simulation(part)
        scene, from_start = simulation.scene, simulation.frame == 0
        self._check_snapshot()
        self._ensemble.begin(continues=self._previous is not None and self._previous.frame == simulation.frame)
        for name in sorted(set(scene.files) - set(part.files)):
            self._verdict.environment.append(f"{name} as found here: the session does not hold it")
        opened = part.attachments[STATE_NAME].log_time
        self._completeness.begin(part, opened)
        # Waiting commands carry over to the next file.
        if self._commands is None or self._diagnostics is None:
            self._commands = CommandCheck(node=self._node, scene=scene, from_start=from_start, findings=self._findings)
            self._diagnostics = DiagnosticsCheck(self._node, from_start=from_start, findings=self._findings)
        else:
            self._diagnostics.next_file()
        self._frame_outputs = FrameOutputCheck(
            self._node, part=part, open_time=opened, simulation=simulation, completeness=self._completeness,
            findings=self._findings,
        )  # fmt: skip
        self._frame: Frame | None = None
        self._frames_before = self._verdict.frames

    def add(self, message: Message) -> bool:
        """Run the frame of a record, or compare another message; return False if the re-run cannot continue."""
        topic, is_opening = message.topic, self._frame is None
        assert self._commands is not None
        assert self._diagnostics is not None
        if topic == self._frame_topic:
            self._completeness.add(message, is_from_node=True)
            return self._run_frame(read_frame(message), message)
        if self._frame_outputs.is_compared(topic):
            is_same = self._frame_outputs.compare(message, is_opening=is_opening)
            is_opening = is_opening and self._frame_outputs.is_latched(topic)
            self._completeness.add(message, is_from_node=True, is_opening=is_opening)
            if topic == self._points and is_same is not None:
                self._observe_cloud(message, is_same)
            return True
        if topic in self._commands.topics:
            self._completeness.declare(topic, "command", droppable=False)
            self._completeness.add(message, is_from_node=True)
            self._commands.receive(message, self.simulation)
        elif topic == self._ensemble.topic:
            self._ensemble.compare(message)
        elif topic == DIAGNOSTICS:
            self._completeness.add(message, is_from_node=True)
            self._diagnostics.compare(message, self.simulation)
        else:
            self._skip(message)
        return True

    def finish(self, *, whole: bool) -> None:
        """End a file: report missing messages. `whole`: True if it was read to its end."""
        self._frame_outputs.close_frame()
        self._close_frame()
        if self._verdict.frames > self._frames_before:
            self._frame_outputs.finish()
        self._completeness.finish(whole=whole)
        self._list_foreign_records()
        assert self._commands is not None
        compared = self._frame_outputs.topics | self._commands.topics
        compared |= {self._frame_topic, DIAGNOSTICS, self._ensemble.topic}
        compare_declarations(self._part, self._node, compared, self._findings)
        self._previous = self.simulation

    def end(self) -> None:
        """End the session: report topics and commands that are missing in it."""
        assert self._commands is not None
        part, position = self._part, self._findings.position
        is_clean = part.at_end and part.end_notes.get("reason") in _CLEAN_END_REASONS
        if not is_clean and self._verdict.frames:
            missing_topics = self._completeness.forgive_last_frame(position)
            if missing_topics:
                topics = ", ".join(missing_topics)
                self._findings.add_deficit(f"its last frame, {position.frame}, was recorded without {topics}")
        self._frame_outputs.end()
        self._completeness.end()
        if part.end_notes.get("reason") == SPLIT:
            self._findings.add_deficit(f"the session goes on in another file after {part.path.name}")
        needs_diagnostics = "dropped" in part.end_notes and self._verdict.simulated > _DIAGNOSTICS_WITHIN
        if needs_diagnostics and not self._completeness.is_seen(DIAGNOSTICS):
            self._findings.add_absent(DIAGNOSTICS)
        self._commands.end()
        self._ensemble.end()

    def _skip(self, message: Message) -> None:
        topic, robot = message.topic, self.simulation.scene.robot
        if robot.enabled and topic.endswith(f"/{robot.joint_states_topic.lstrip('/~')}"):
            self._completeness.add(message, is_from_node=True)
            self._findings.count_not_compared(
                topic, "joint states; the poses of links that follow from them are events"
            )
            return
        is_from_node = topic in _SHARED or topic == "/tf" or topic.startswith(f"{self._node}/")
        self._completeness.add(message, is_from_node=is_from_node)
        default = "an unknown topic of the node" if is_from_node else "not the node's"
        self._findings.count_not_compared(topic, _SHARED.get(topic, default))

    def _list_foreign_records(self) -> None:
        """List the attachments that the scene does not name, and the metadata of other tools, as not compared."""
        files = {f"{FILE_PREFIX}{name}" for name in self.simulation.scene.files}
        for name in sorted(self._part.attachments.keys() - files - {SCENE_NAME, STATE_NAME}):
            self._findings.count_not_compared(f"attachment {name}", "not of the scene")
        for name in sorted(self._part.foreign_metadata):
            self._findings.count_not_compared(f"metadata {name}", "not of cloth_sim")

    def _check_snapshot(self) -> None:
        """Compare the snapshot of a split file with the final state of the previous file."""
        previous = self._previous
        if previous is None or previous.frame != self.simulation.frame:
            return
        if previous.state.digest() != self.simulation.state.digest():
            self._findings.add_difference(
                "snapshot", f"the snapshot that {self._part.path.name} opens with", rounding=True
            )

    def _run_frame(self, record: FrameRecord, message: Message) -> bool:
        self._frame_outputs.close_frame()
        self._close_frame()
        simulation, verdict = self.simulation, self._verdict
        if record.frame > simulation.frame + 1:
            verdict.damaged = True
            gap = f"frames {simulation.frame + 1} to {record.frame - 1} are missing"
            verdict.missing.append(f"{self._part.path.name}: {gap}; what follows them cannot be run")
            return False
        self._findings.position = FramePosition(verdict.frames, record.frame, record.time)
        start_time, scene, before = simulation.time, simulation.scene, simulation.state.shallow_copy()
        verdict.frames += 1
        self._ensemble.before_frame(simulation, record)
        try:
            events: list[Event] = [from_dict(dict(event)) for event in record.events]
            self._frame = frame = simulation.advance(events)
        except (ValueError, UnstableError) as error:
            self._findings.add_difference("frame", f"it cannot be run: {error}")
            return False
        # Messages of a frame share its publish time; a log time may be raised to keep the order of recording.
        stamp = message.publish_time
        verdict.simulated += simulation.time - start_time
        compare_record(record, frame, simulation, self._findings, topic=self._frame_topic, labels={"stamp": stamp})
        if self._observer is not None:
            self._observer.on_frame(simulation, scene, before, frame, record)
        assert self._commands is not None
        assert self._diagnostics is not None
        self._commands.compare(record, message.log_time, stamp, simulation)
        self._diagnostics.observe_frame(frame, simulation)
        self._ensemble.observe_frame(frame, stamp)
        self._frame_outputs.open_frame(frame, stamp)
        return True

    def _observe_cloud(self, message: Message, is_same: bool) -> None:
        if self._observer is not None:
            try:
                self._observer.on_cloud(decode_cloud(message.data).xyz, is_same)
            except SessionError:
                # An unreadable cloud is reported already; it has no positions.
                return

    def _close_frame(self) -> None:
        if self._observer is not None:
            self._observer.on_frame_end()


def _simulation(part: SessionPart) -> Simulation:
    try:
        values = recorded_values(part.scene_yaml, node=part.metadata.get("node", ""))
        return Simulation(Scene.from_parameters(values, files=part.files), State.from_bytes(part.state))
    except ValueError as error:
        raise SessionError(f"{part.path} holds no scene that can be run here: {error}") from error
