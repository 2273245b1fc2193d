# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorder of a run as a session file, without ROS."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cloth_sim_ros.physics.model.sheets.normals import vertex_normals
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.cdr import encode_string
from cloth_sim_ros.session.channel_description import Qos
from cloth_sim_ros.session.frame_record import frame_text
from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter, WriterOptions
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target, to_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.ensemble import EnsembleFrame

NODE = "/cloth_sim"
#: ROS time of every run's start [ns]: constant, so that the same run has the same bytes.
START_STAMP = 1_800_000_000_000_000_000
#: Number of frames that are written together. This halves the time of writing, because the engine evicts the recorder
#: from the processor's inner caches in each frame.
_FRAMES_PER_WRITE = 32
#: Events with a target pose; a constant, because building a union type takes longer than the test of a type.
_TARGET_EVENTS = (Target, Move)


class _PendingFrame(NamedTuple):
    """Encoded frame that is not yet written."""

    #: ROS time of the frame's end [ns], and the events at its beginning, in order of arrival.
    stamp: int
    events: tuple[Event, ...]
    #: Frame record, and message bytes of the cloud.
    record: dict[str, Any]
    cloud: bytes | None
    #: Message bytes of the ensemble's cloud.
    deviations: bytes | None
    #: Topics and wrenches [N, N m] of the grippers, then of the obstacles.
    topics: Sequence[str]
    wrenches: list[list[float]]


class RunRecording:
    """Writer of the session file of a study's run, which it creates; methods may raise OSError.

    Args:
        folder: folder of this run alone; the caller moves the complete file.
        simulation: the recorded simulation, at its start.
        name: name of the session.
        clouds: true to write the particles' positions of each frame; sessions without clouds can be rerun too.
    """

    def __init__(self, folder: Path, simulation: Simulation, *, name: str, clouds: bool) -> None:
        self._simulation = simulation
        self._sequences: dict[str, int] = {}
        self._pending: list[_PendingFrame] = []
        self._stamp = START_STAMP
        scene = simulation.scene
        self._frame_id = scene.frame_id
        self._set_scene(scene)
        self._writer = SessionWriter(
            folder,
            snapshot=SessionSnapshot(
                scene_yaml=parameter_file.dump(scene.parameters()),
                state=simulation.state.to_bytes(),
                files=scene.files,
                metadata={**environment(), "node": NODE, "period": repr(scene.period)},
            ),
            stem=name,
            log_time=START_STAMP,
            # Only the size closes a chunk. With a time limit the bytes would depend on the machine's speed.
            options=WriterOptions(sync_seconds=0.0),
        )
        self._writer.declare(f"{NODE}/topology", messages.MESH, Qos(durability="transient_local", depth=1))
        sheet = scene.sheet
        self._add(f"{NODE}/topology", messages.MESH, messages.mesh_bytes(sheet.triangles(), sheet.positions()))
        self._fields, self._triangles = scene.points, sheet.triangles()
        self._cloud: messages.CloudEncoder | None = None
        if clouds:
            rows, columns = scene.shape
            fields = self._fields.fields
            self._cloud = messages.CloudEncoder(frame_id=self._frame_id, height=rows, width=columns, **fields)
        #: Encoder of an ensemble's clouds; built on first use.
        self._deviations: messages.CloudEncoder | None = None

    @property
    def bytes_written(self) -> int:
        """Size of the session file [bytes]."""
        return self._writer.bytes_written

    def add(self, events: Sequence[Event], frame: Frame, ensemble: EnsembleFrame | None = None) -> None:
        """Add the latest frame: commands, frame record, clouds and wrenches. Frames are written in groups.

        `ensemble`: that of the frame; its members start with the first frame.
        """
        simulation = self._simulation
        if simulation.scene is not self._scene:
            self._set_scene(simulation.scene)
        stamp = START_STAMP + round(frame.index * self._period * 1e9)
        advance = frame.advance
        record = {
            "frame": frame.index,
            "time": frame.time,
            # Convert immediately, because the user may change the values of parameters later.
            "events": [to_dict(event) for event in frame.events],
            "integrator": frame.integrator,
            "tolerance": frame.tolerance,
            "steps": advance.steps if advance else 0,
            "digest": simulation.state.digest(),
            "paused": simulation.paused,
        }
        extras = frame.extras()
        if advance and advance.flagged:
            extras["flagged"] = advance.flagged
        if ensemble is not None and self._deviations is None:
            extras["ensemble"] = "start"
        if extras:
            record["extras"] = extras
        cloud = None
        if self._cloud is not None:
            state, fields = simulation.state, self._fields
            normals = vertex_normals(state.x, self._triangles) if fields.normal else None
            cloud = self._cloud.encode(state.x, stamp, state.v if fields.velocity else None, normals)
        deviations = None if ensemble is None else self._encode_ensemble(ensemble, stamp)
        wrenches = frame.wrenches.tolist()
        if len(frame.obstacle_wrenches):
            wrenches += frame.obstacle_wrenches[self._unlinked_indices].tolist()
        self._pending.append(_PendingFrame(stamp, tuple(events), record, cloud, deviations, self._topics, wrenches))
        if len(self._pending) >= _FRAMES_PER_WRITE:
            self._write_pending()

    def finish(self, *, reason: str) -> Path:
        """Write the pending frames, close the file, synchronise it to the disk, and return its path. Raises OSError."""
        self._write_pending()
        self._writer.finish(reason=reason)
        with self._writer.path.open("rb") as file:
            os.fsync(file.fileno())
        return self._writer.path

    def abandon(self) -> None:
        """Close the session file without pending frames and indexes."""
        self._writer.abandon()

    def _encode_ensemble(self, frame: EnsembleFrame, stamp: int) -> bytes:
        if self._deviations is None:
            rows, columns = self._scene.shape
            self._deviations = messages.CloudEncoder(
                frame_id=self._frame_id, height=rows, width=columns, deviation=True
            )
        return self._deviations.encode(frame.mean.T, stamp, deviation=frame.deviation)

    def _set_scene(self, scene: Scene) -> None:
        """Set the scene that gives period and topics of the following frames."""
        self._scene, self._period = scene, scene.period
        names, links = scene.obstacle_names, set(scene.link_names)
        #: Indices of the obstacles with topics: all but links of a robot.
        self._unlinked_indices = [k for k, name in enumerate(names) if name not in links]
        unlinked_names = [names[k] for k in self._unlinked_indices]
        self._topics = [f"{NODE}/{name}/wrench" for name in (*scene.gripper_names, *unlinked_names)]

    def _write_pending(self) -> None:
        """Write the messages of the pending frames into the session file."""
        pending, self._pending = self._pending, []
        for stamp, events, record, cloud, deviations, topics, wrenches in pending:
            self._stamp = stamp
            for event in events:
                self._add_command(event)
            self._add(f"{NODE}/frame", messages.STRING, encode_string(frame_text(record)))
            if cloud is not None:
                self._add(f"{NODE}/points", messages.CLOUD, cloud)
            if cloud is not None and deviations is not None:
                self._add(f"{NODE}/ensemble", messages.CLOUD, deviations)
            for topic, wrench in zip(topics, wrenches, strict=True):
                data = messages.wrench_bytes(wrench, frame_id=self._frame_id, stamp=stamp)
                self._add(topic, messages.WRENCH, data)

    def _add_command(self, event: Event) -> None:
        frame_id, stamp = self._frame_id, self._stamp
        if isinstance(event, Grasp):
            self._add(f"{NODE}/{event.gripper}/grasp", messages.BOOL, messages.bool_bytes(event.closed))
        elif isinstance(event, _TARGET_EVENTS):
            name = event.gripper if isinstance(event, Target) else event.obstacle
            if event.orientation is None:
                data = messages.point_bytes(event.position, frame_id=frame_id, stamp=stamp)
                self._add(f"{NODE}/{name}/point", messages.POINT, data)
            else:
                data = messages.pose_bytes(event.position, event.orientation, frame_id=frame_id, stamp=stamp)
                self._add(f"{NODE}/{name}/target", messages.POSE, data)

    def _add(self, topic: str, kind: str, data: bytes) -> None:
        if not self._writer.is_declared(topic):
            self._writer.declare(topic, kind)
        sequence = self._sequences.get(topic, 0)
        self._sequences[topic] = sequence + 1
        self._writer.add(topic, data, log_time=self._stamp, publish_time=self._stamp, sequence=sequence)
