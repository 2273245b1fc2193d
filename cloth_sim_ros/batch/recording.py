# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A run as a recorded session: the same file that a node records, without ROS and without a clock."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.scene import parameter_file
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.cdr import encode_string
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.layouts import Qos
from cloth_sim_ros.session.writer import SessionWriter, Snapshot, WriterOptions
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target, to_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation

NODE = "/cloth_sim"
#: ROS time of every run's start [ns]: a fixed number, so that the same run has the same bytes.
START = 1_800_000_000_000_000_000


class RunRecording:
    """Writes a simulation's frames into one session file. Methods may raise OSError as the system reports it.

    Args:
        folder: of the run alone; the file gets its place when it is complete.
        simulation: what is recorded, at its start.
        name: of the session.
        clouds: whether the particles' positions are written each frame; a session without them runs again all the same.
    """

    def __init__(self, folder: Path, simulation: Simulation, *, name: str, clouds: bool) -> None:
        self._simulation = simulation
        self._sequences: dict[str, int] = {}
        self._now = START
        scene = simulation.scene
        self._frame_id = scene.frame_id
        self._writer = SessionWriter(
            folder,
            snapshot=Snapshot(
                scene_yaml=parameter_file.dump(scene.parameters()),
                state=simulation.state.to_bytes(),
                files=scene.files,
                metadata={**environment(), "node": NODE, "period": repr(scene.period)},
            ),
            stem=name,
            log_time=START,
            # Chunks are closed by their size alone: by their age the bytes would depend on the machine's speed.
            options=WriterOptions(sync_seconds=0.0),
        )
        self._writer.declare(f"{NODE}/topology", messages.MESH, Qos(durability="transient_local", depth=1))
        sheet = scene.sheet
        self._add(f"{NODE}/topology", messages.MESH, messages.mesh_bytes(sheet.triangles(), sheet.positions()))
        self._velocity = scene.points.velocity
        self._cloud: messages.CloudBytes | None = None
        if clouds:
            rows, columns = scene.shape
            self._cloud = messages.CloudBytes(
                frame_id=self._frame_id, height=rows, width=columns, velocity=self._velocity
            )

    @property
    def bytes_written(self) -> int:
        """Bytes that are in the file."""
        return self._writer.bytes_written

    def add(self, events: Sequence[Event], frame: Frame) -> None:
        """Write the frame that was just computed: its commands, its record, then what shows it."""
        simulation = self._simulation
        self._now = START + round(frame.index * simulation.scene.period * 1e9)
        for event in events:
            self._add_command(event)
        record = FrameRecord(
            frame=frame.index,
            time=frame.time,
            events=tuple(to_dict(event) for event in frame.events),
            integrator=frame.integrator,
            tolerance=frame.tolerance,
            steps=frame.advance.steps if frame.advance else 0,
            digest=simulation.state.digest(),
            paused=simulation.paused,
            extras={"flagged": frame.advance.flagged} if frame.advance and frame.advance.flagged else {},
        )
        self._add(f"{NODE}/frame", messages.STRING, encode_string(record.to_json()))
        if self._cloud is not None:
            state = simulation.state
            cloud = self._cloud.at(state.x, self._now, state.v if self._velocity else None)
            self._add(f"{NODE}/points", messages.CLOUD, cloud)
        scene = simulation.scene
        bodies = [*zip(scene.gripper_names, frame.wrenches, strict=True)]
        bodies += zip(scene.obstacle_names, frame.loads, strict=True)
        for name, wrench in bodies:
            data = messages.wrench_bytes(wrench.tolist(), frame_id=self._frame_id, stamp=self._now)
            self._add(f"{NODE}/{name}/wrench", messages.WRENCH, data)

    def finish(self, *, reason: str) -> Path:
        """Write what waits, close the file and wait until it would survive a power loss; its path."""
        self._writer.finish(reason=reason)
        with self._writer.path.open("rb") as file:
            os.fsync(file.fileno())
        return self._writer.path

    def abandon(self) -> None:
        """Close the file as it is."""
        self._writer.abandon()

    def _add_command(self, event: Event) -> None:
        frame_id, now = self._frame_id, self._now
        if isinstance(event, Grasp):
            self._add(f"{NODE}/{event.gripper}/grasp", messages.BOOL, messages.bool_bytes(event.closed))
        elif isinstance(event, Target | Move):
            name = event.gripper if isinstance(event, Target) else event.obstacle
            if event.orientation is None:
                data = messages.point_bytes(event.position, frame_id=frame_id, stamp=now)
                self._add(f"{NODE}/{name}/point", messages.POINT, data)
            else:
                data = messages.pose_bytes(event.position, event.orientation, frame_id=frame_id, stamp=now)
                self._add(f"{NODE}/{name}/target", messages.POSE, data)

    def _add(self, topic: str, kind: str, data: bytes) -> None:
        if not self._writer.is_declared(topic):
            self._writer.declare(topic, kind)
        sequence = self._sequences.get(topic, 0)
        self._sequences[topic] = sequence + 1
        self._writer.add(topic, data, log_time=self._now, publish_time=self._now, sequence=sequence)
