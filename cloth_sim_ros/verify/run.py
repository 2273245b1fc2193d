# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Re-run of a recorded session from its own snapshot and events, and comparison of every message."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.recorded import recorded_values
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.reader import SessionReader, read_frame
from cloth_sim_ros.session.writer import STATE_NAME
from cloth_sim_ros.simulation.environment import differences, recorder_with_other_arithmetic
from cloth_sim_ros.simulation.events import Event, from_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.commands import CommandCheck
from cloth_sim_ros.verify.declarations import compare_declarations
from cloth_sim_ros.verify.diagnostics import TOPIC as DIAGNOSTICS
from cloth_sim_ros.verify.diagnostics import DiagnosticsCheck
from cloth_sim_ros.verify.numbering import Numbering
from cloth_sim_ros.verify.shown import ShownCheck
from cloth_sim_ros.verify.verdict import Findings, Place, Verdict

__all__ = ["Verdict", "Watch", "verify"]

#: Parts of a frame record that other arithmetic can change.
_OF_ROUNDING = frozenset({"the digest of its state", "its steps", "its integrator"})
#: Entries of a frame record's extras from `Frame.extras`.
_FRAME_EXTRAS = frozenset({"poses", "halted"})
#: Topics that the node shares with others, with their description.
_SHARED = {"/rosout": "texts of the log", "/parameter_events": "changes of parameters, as the node announced them"}
#: Reasons of an end after a complete frame; after any other end, the last frame may lack messages.
_WHOLE_ENDS = frozenset({"stopped", "split", "node stopped", "~/record", "failed"})
#: Simulated time after which a node's recording must have diagnostics [s].
_REPORTED = 10.0


class Watch(Protocol):
    """Observer of a re-run."""

    def frame(self, simulation: Simulation, was: Scene, before: State, frame: Frame, record: FrameRecord) -> None:
        """Receive a frame of the re-run, with scene and state before it."""

    def cloud(self, recorded: NDArray[np.floating], same: bool) -> None:
        """Receive the frame's recorded positions (n, 3) [m]; `is_same`: they equal those of the re-run."""

    def close(self) -> None:
        """Receive the end of a frame's messages; also called without a frame."""


def verify(
    paths: Sequence[Path],
    *,
    progress: Callable[[int], None] = lambda _bytes: None,
    watch: Watch | None = None,
) -> Verdict:
    """Run a session again and compare it with the recording.

    Args:
        paths: the files of one session, in order.
        on_progress: receives the number of bytes read so far.
        observer: receives the frames.

    Raises:
        SessionError: if a file cannot be read, or its scene and state make no simulation.
    """
    begun = time.perf_counter()
    with SessionReader(list(paths)) as reader:
        verdict = Verdict(name=", ".join(path.name for path in paths))
        verdict.other_arithmetic = recorder_with_other_arithmetic(reader.metadata)
        if not verdict.other_arithmetic:
            verdict.environment = differences(reader.metadata)
        run, done = _Run(reader.node, Findings(verdict), watch), 0
        for part in reader.parts:
            run.begin(part)
            part.rewind()
            whole = True
            for message in part.messages():
                if not run.take(message):
                    whole = False
                    break
                progress(done + part.position)
            run.finish(whole=whole)
            verdict.damaged = verdict.damaged or bool(part.damage)
            done += part.size()
        run.end()
        if reader.missing:
            verdict.missing.insert(0, reader.missing)
    verdict.seconds = time.perf_counter() - begun
    return verdict


class _Run:
    """Re-run of a session, file by file."""

    def __init__(self, node: str, findings: Findings, watch: Watch | None) -> None:
        self._node, self._findings, self._watch = node, findings, watch
        self._verdict = findings.verdict
        self._frame_topic, self._points = f"{node}/frame", f"{node}/points"
        self._numbering = Numbering(findings)
        self._numbering.declare(self._frame_topic, "frame", droppable=False)
        self._numbering.declare(self._points, "cloud", droppable=True)
        self._numbering.declare(DIAGNOSTICS, "diagnostics message", droppable=False)
        self._before: Simulation | None = None
        self._commands: CommandCheck | None = None
        self._diagnostics: DiagnosticsCheck | None = None

    def begin(self, part: SessionPart) -> None:
        """Begin a file, from its opening snapshot."""
        self._part = part
        self.simulation = simulation = _simulation(part)
        scene, from_start = simulation.scene, simulation.frame == 0
        self._check_snapshot()
        for name in sorted(set(scene.files) - set(part.files)):
            self._verdict.environment.append(f"{name} as found here: the session does not hold it")
        opened = part.attachments[STATE_NAME].log_time
        self._numbering.begin(part, opened)
        # Waiting commands carry over to the next file.
        if self._commands is None or self._diagnostics is None:
            self._commands = CommandCheck(node=self._node, scene=scene, from_start=from_start, findings=self._findings)
            self._diagnostics = DiagnosticsCheck(self._node, from_start=from_start, findings=self._findings)
        else:
            self._diagnostics.next_file()
        self._shown = ShownCheck(
            self._node, part=part, opened=opened, simulation=simulation, numbering=self._numbering,
            findings=self._findings,
        )  # fmt: skip
        self._frame: Frame | None = None
        self._frames_before = self._verdict.frames

    def take(self, message: Message) -> bool:
        """Run the frame of a record, or compare another message; return False if the re-run cannot continue."""
        topic, opens = message.topic, self._frame is None
        assert self._commands is not None
        assert self._diagnostics is not None
        if topic == self._frame_topic:
            self._numbering.add(message, own=True)
            return self._run_frame(read_frame(message), message)
        if self._shown.takes(topic):
            same = self._shown.take(message, opens=opens)
            self._numbering.add(message, own=True, opens=opens and self._shown.is_latched(topic))
            if topic == self._points and same is not None:
                self._show_cloud(message, same)
            return True
        if topic in self._commands.topics:
            self._numbering.declare(topic, "command", droppable=False)
            self._numbering.add(message, own=True)
            self._commands.receive(message, self.simulation)
        elif topic == DIAGNOSTICS:
            self._numbering.add(message, own=True)
            self._diagnostics.compare(message, self.simulation)
        else:
            self._leave(message)
        return True

    def finish(self, *, whole: bool) -> None:
        """End a file. `whole`: True if it was read to its end."""
        self._shown.close_frame()
        self._close_watch()
        if self._verdict.frames > self._frames_before:
            self._shown.finish()
        self._numbering.finish(whole=whole)
        assert self._commands is not None
        compared = self._shown.topics | self._commands.topics | {self._frame_topic, DIAGNOSTICS}
        compare_declarations(self._part, self._node, compared, self._findings)
        self._before = self.simulation

    def end(self) -> None:
        """End the session."""
        assert self._commands is not None
        part, place = self._part, self._findings.place
        if part.end_notes.get("reason") not in _WHOLE_ENDS and self._verdict.frames:
            lacking = self._numbering.pardon(place)
            if lacking:
                self._findings.missing(f"its last frame, {place.frame}, was recorded without {', '.join(lacking)}")
        self._shown.end()
        self._numbering.end()
        if (
            "dropped" in part.end_notes
            and self._verdict.simulated > _REPORTED
            and not self._numbering.is_seen(DIAGNOSTICS)
        ):
            self._findings.absent(DIAGNOSTICS)
        self._commands.end()

    def _leave(self, message: Message) -> None:
        topic = message.topic
        own = topic in _SHARED or topic == "/tf" or topic.startswith(f"{self._node}/")
        self._numbering.add(message, own=own)
        reason = _SHARED.get(topic)
        self._findings.not_compared(topic, reason or ("an unknown topic of the node" if own else "not the node's"))

    def _check_snapshot(self) -> None:
        """Compare the snapshot of a split file with the final state of the previous file."""
        before = self._before
        if before is None or before.frame != self.simulation.frame:
            return
        if before.state.digest() != self.simulation.state.digest():
            self._findings.difference("snapshot", f"the snapshot that {self._part.path.name} opens with", rounding=True)

    def _run_frame(self, record: FrameRecord, message: Message) -> bool:
        self._shown.close_frame()
        self._close_watch()
        simulation, verdict = self.simulation, self._verdict
        if record.frame > simulation.frame + 1:
            verdict.damaged = True
            verdict.missing.append(
                f"{self._part.path.name}: frames {simulation.frame + 1} to {record.frame - 1} are missing; "
                "what follows them cannot be run"
            )
            return False
        self._findings.place = Place(verdict.frames, record.frame, record.time)
        since, scene, before = simulation.time, simulation.scene, simulation.state.share()
        verdict.frames += 1
        try:
            events: list[Event] = [from_dict(dict(event)) for event in record.events]
            self._frame = frame = simulation.advance(events)
        except (ValueError, UnstableError) as error:
            self._findings.difference("frame", f"it cannot be run: {error}")
            return False
        # Messages of a frame share its publish time; a log time may be raised to keep the order of recording.
        stamp = message.publish_time
        verdict.simulated += simulation.time - since
        self._compare_frame(record, frame)
        if self._watch is not None:
            self._watch.frame(simulation, scene, before, frame, record)
        assert self._commands is not None
        assert self._diagnostics is not None
        self._commands.compare(record, message.log_time, stamp, simulation)
        self._diagnostics.follow(frame, simulation)
        self._shown.open_frame(frame, stamp)
        return True

    def _compare_frame(self, record: FrameRecord, frame: Frame) -> None:
        simulation = self.simulation
        steps = frame.advance.steps if frame.advance else 0
        compared = (
            ("its number", record.frame, frame.index),
            ("its time", record.time, frame.time),
            ("whether it is paused", record.paused, simulation.paused),
            ("its tolerance", record.tolerance, frame.tolerance),
            ("the digest of its state", record.digest, simulation.state.digest()),
            ("its steps", record.steps, steps),
            ("its integrator", record.integrator, frame.integrator),
        )
        for what, recorded, again in compared:
            if recorded != again:
                rounding = what in _OF_ROUNDING
                self._findings.difference(
                    "frame", f"{what} ({recorded} was recorded, {again} came out)", rounding=rounding
                )
                return
        self._compare_extras(record, frame)

    def _compare_extras(self, record: FrameRecord, frame: Frame) -> None:
        energy, expected = self.simulation.energy_report, frame.extras()
        for key in (*expected, *(("energy",) if energy is not None else ())):
            if key not in record.extras:  # older sessions have no such entries
                self._findings.not_compared(self._frame_topic, f"'{key}', absent from the record")
        for key, recorded in record.extras.items():
            again: Any
            if key in _FRAME_EXTRAS:
                again = expected.get(key)
                wrong = recorded != again
            elif key == "flagged":
                again = frame.advance.flagged if frame.advance else 0
                wrong = recorded != again
            elif key == "energy" and energy is not None:
                again = energy.total
                wrong = not (isinstance(recorded, float) and math.isclose(recorded, again, rel_tol=1e-9, abs_tol=1e-12))
            else:
                self._findings.not_compared(self._frame_topic, f"'{key}' of the record")
                continue
            if wrong:
                self._findings.difference(
                    "frame", f"its {key} ({recorded} was recorded, {again} came out)", rounding=True
                )

    def _show_cloud(self, message: Message, same: bool) -> None:
        if self._watch is not None:
            try:
                self._watch.cloud(decode_cloud(message.data).xyz, same)
            except SessionError:
                # An unreadable cloud is reported already; it has no positions.
                return

    def _close_watch(self) -> None:
        if self._watch is not None:
            self._watch.close()


def _simulation(part: SessionPart) -> Simulation:
    try:
        values = recorded_values(part.scene_yaml, node=part.metadata.get("node", ""))
        return Simulation(Scene.from_parameters(values, files=part.files), State.from_bytes(part.state))
    except ValueError as error:
        raise SessionError(f"{part.path} holds no scene that can be run here: {error}") from error
