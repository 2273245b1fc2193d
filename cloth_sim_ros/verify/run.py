# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Running a recorded session again from its own snapshots and events, and comparing every frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.recorded import parameters_of
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode, decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.reader import SessionReader, read_frame
from cloth_sim_ros.simulation.environment import differences, recorder_with_other_arithmetic
from cloth_sim_ros.simulation.events import Event, from_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.commands import CommandCheck

_WRENCH = "geometry_msgs/msg/WrenchStamped"
#: What a frame's record tells that other arithmetic can change: the rest it must get right.
_OF_ROUNDING = frozenset({"the digest of its state", "its steps", "its integrator"})


@dataclass(kw_only=True)
class Verdict:
    """How a session came out when it was run again."""

    name: str
    """The session's files."""
    frames: int = 0
    """Frames that were run and compared."""
    clouds: int = 0
    """Clouds that were compared."""
    different: int = 0
    """Frames of which anything differs."""
    first_frame: int | None = None
    """Number of the first of them."""
    first_time: float = 0.0
    """Its simulated time [s]."""
    first_reason: str = ""
    """What differs there."""
    largest_deviation: float = 0.0
    """Of any particle's position in any cloud [m]; infinite where a cloud holds something that is no number."""
    simulated: float = 0.0
    """Simulated time that was run [s]."""
    seconds: float = 0.0
    """Wall time that it took [s]."""
    environment: list[str] = field(default_factory=list)
    """Differences of code and files from the recording's that change bits, or may; a phrase each."""
    other_arithmetic: str = ""
    """By what it was recorded, where that rounds otherwise than this package; empty where it does not."""
    unexplained: str = ""
    """With other arithmetic: the first frame and what differs in it that no rounding explains."""
    missing: list[str] = field(default_factory=list)
    """What the session lacks, a sentence each."""
    damaged: bool = False
    """Whether frames are damaged or missing in the middle, so that they could not be compared."""

    @property
    def same(self) -> bool:
        """Whether all that was compared came out the same to the last bit."""
        return self.first_frame is None


class Watch(Protocol):
    """Looks on while a session is run again."""

    def frame(self, simulation: Simulation, was: Scene, before: State, frame: Frame, record: FrameRecord) -> None:
        """Take a frame that was just run, from scene and state before it."""

    def cloud(self, recorded: NDArray[np.float32], same: bool) -> None:
        """Take the positions (n, 3) [m] that were recorded of it, and whether they are those that it came to."""

    def close(self) -> None:
        """All that was recorded of a frame has come; also called where there was none."""


def verify(
    paths: Sequence[Path],
    *,
    progress: Callable[[int], None] = lambda _bytes: None,
    watch: Watch | None = None,
) -> Verdict:
    """Run a session again, all its files in order, and compare it with what was recorded.

    Args:
        paths: the files of one session, in order.
        progress: told the bytes that have been read so far.
        watch: looks on.

    Raises:
        SessionError: if a file cannot be read, or holds a scene or a state that make no simulation.
    """
    begun = time.perf_counter()
    with SessionReader(list(paths)) as reader:
        verdict = Verdict(name=", ".join(path.name for path in paths))
        verdict.other_arithmetic = recorder_with_other_arithmetic(reader.metadata)
        if not verdict.other_arithmetic:
            verdict.environment = differences(reader.metadata)
        done = 0
        before: _Run | None = None
        for part in reader.parts:
            run = _Run(part, reader.node, verdict, before, watch)
            part.rewind()
            for message in part.messages(topics=run.topics):
                if not run.take(message):
                    break
                progress(done + part.position)
            run.finish()
            verdict.damaged = verdict.damaged or bool(part.damage)
            done += part.size()
            before = run
        if reader.missing:
            verdict.missing.insert(0, reader.missing)
    verdict.seconds = time.perf_counter() - begun
    return verdict


class _Run:
    """One file's run."""

    def __init__(
        self, part: SessionPart, node: str, verdict: Verdict, before: _Run | None, watch: Watch | None
    ) -> None:
        self.simulation = _simulation(part)
        self._watch = watch
        self._part = part
        self._verdict = verdict
        self._differs = False
        self._check_snapshot(before)
        scene = self.simulation.scene
        for name in sorted(set(scene.files) - set(part.files)):
            verdict.environment.append(f"{name} as found here: the session does not hold it")
        self._frame_topic, self._points = f"{node}/frame", f"{node}/points"
        names = [*scene.gripper_names, *scene.described]
        self._wrenches = {f"{node}/{name}/wrench": name for name in names}
        # Commands wait across the end of a file.
        self._commands: CommandCheck = before._commands if before else _commands(self.simulation, node)
        self._frame: Frame | None = None
        self._frame_stamp = -1

    @property
    def topics(self) -> frozenset[str]:
        """The topics that are compared."""
        return frozenset({self._frame_topic, self._points, *self._wrenches}) | self._commands.topics

    def take(self, message: Message) -> bool:
        """Run or compare what a message tells; False where the session cannot be run any further."""
        if message.topic == self._frame_topic:
            return self._run_frame(read_frame(message), message)
        if message.topic == self._points:
            self._compare_cloud(message)
        elif message.topic in self._wrenches:
            self._compare_wrench(message)
        else:
            self._commands.receive(message)
        return True

    def finish(self) -> None:
        """Count what the last frame showed."""
        self._close_frame()

    def _check_snapshot(self, before: _Run | None) -> None:
        """A file of a split session opens with the state at which the one before ended."""
        if before is None or before.simulation.frame != self.simulation.frame:
            return
        if before.simulation.state.digest() != self.simulation.state.digest():
            self._note_difference(f"the snapshot that {self._part.path.name} opens with", rounding=True)
            self._close_frame()

    def _run_frame(self, record: FrameRecord, message: Message) -> bool:
        self._close_frame()
        simulation = self.simulation
        if record.frame > simulation.frame + 1:
            self._verdict.damaged = True
            self._verdict.missing.append(
                f"{self._part.path.name}: frames {simulation.frame + 1} to {record.frame - 1} are missing; "
                "what follows them cannot be run"
            )
            return False
        since, scene, before = simulation.time, simulation.scene, simulation.state.share()
        try:
            events: list[Event] = [from_dict(dict(event)) for event in record.events]
            self._frame = simulation.advance(events)
        except (ValueError, UnstableError) as error:
            self._verdict.frames += 1
            self._note_difference(f"it cannot be run: {error}", record)
            self._close_frame()
            return False
        # What belongs to a frame has its publish time; a log time may be raised to keep the order of recording.
        self._frame_stamp = message.publish_time
        self._verdict.frames += 1
        self._verdict.simulated += simulation.time - since
        self._compare_frame(record)
        if self._watch is not None:
            self._watch.frame(simulation, scene, before, self._frame, record)
        uncommanded = self._commands.compare(record, message.log_time)
        if uncommanded:
            self._note_difference(uncommanded, record)
        return True

    def _compare_frame(self, record: FrameRecord) -> None:
        frame, simulation = self._frame, self.simulation
        assert frame is not None
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
                self._note_difference(f"{what} ({recorded} was recorded, {again} came out)", record, rounding=rounding)
                return

    def _compare_cloud(self, message: Message) -> None:
        if message.publish_time != self._frame_stamp:
            return
        cloud = decode_cloud(message.data)
        recorded, again = cloud.xyz, self.simulation.state.x.T.astype(np.float32)
        self._verdict.clouds += 1
        if self._watch is not None:
            same = recorded.shape == again.shape and np.array_equal(recorded.view(np.uint32), again.view(np.uint32))
            self._watch.cloud(recorded, same)
        if recorded.shape != again.shape:
            self._note_difference(f"its cloud has {len(recorded)} points, the cloth {len(again)}")
        elif not np.array_equal(recorded.view(np.uint32), again.view(np.uint32)):
            away = np.linalg.norm(recorded.astype(np.float64) - again, axis=1)
            worst = int(np.argmax(np.where(np.isfinite(away), away, np.inf)))
            deviation = float(away[worst]) if math.isfinite(away[worst]) else math.inf
            self._verdict.largest_deviation = max(self._verdict.largest_deviation, deviation)
            self._note_difference(
                f"its cloud, by {deviation:.3g} m at particle {worst}", rounding=math.isfinite(deviation)
            )
        elif cloud.velocity is not None:
            again = self.simulation.state.v.T.astype(np.float32)
            wrong = np.flatnonzero((cloud.velocity.view(np.uint32) != again.view(np.uint32)).any(axis=1))
            if wrong.size:
                self._note_difference(f"its cloud, by the velocity of particle {wrong[0]}", rounding=True)

    def _compare_wrench(self, message: Message) -> None:
        if message.publish_time != self._frame_stamp or self._frame is None:
            return
        wrench = decode(message.data, _WRENCH).wrench
        recorded = [getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"]
        name, scene = self._wrenches[message.topic], self.simulation.scene
        bodies = [*zip(scene.gripper_names, self._frame.wrenches, strict=True)]
        bodies += zip(scene.obstacle_names, self._frame.loads, strict=True)
        again = dict(bodies).get(name, [])
        if recorded != [float(value) for value in again]:
            self._note_difference(f"the wrench on {message.topic.split('/')[-2]}", rounding=True)

    def _note_difference(self, reason: str, record: FrameRecord | None = None, *, rounding: bool = False) -> None:
        """Note what differs; `rounding` says that other arithmetic alone can make it differ."""
        self._differs = True
        verdict = self._verdict
        frame = self.simulation.frame if record is None else record.frame
        if verdict.other_arithmetic and not rounding and not verdict.unexplained:
            verdict.unexplained = f"frame {frame}, {reason}"
        if verdict.first_frame is None:
            verdict.first_frame = frame
            verdict.first_time = self.simulation.time if record is None else record.time
            verdict.first_reason = reason

    def _close_frame(self) -> None:
        self._verdict.different += self._differs
        self._differs = False
        if self._watch is not None:
            self._watch.close()


def _commands(simulation: Simulation, node: str) -> CommandCheck:
    scene = simulation.scene
    return CommandCheck(
        node=node,
        grippers=scene.gripper_names,
        obstacles=[name for name, obstacle in scene.described.items() if not obstacle.frame],
        frame_id=scene.frame_id,
        follows_frame=any(scene.of_gripper(name, "frame") for name in scene.gripper_names),
        from_start=simulation.frame == 0,
    )


def _simulation(part: SessionPart) -> Simulation:
    try:
        values = parameters_of(part.scene_yaml, node=part.metadata.get("node", ""))
        return Simulation(Scene.from_parameters(values, files=part.files), State.from_bytes(part.state))
    except ValueError as error:
        raise SessionError(f"{part.path} holds no scene that can be run here: {error}") from error
