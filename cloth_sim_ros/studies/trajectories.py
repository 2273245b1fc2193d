# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectory arrays of a run, recomputed from its session with digest checks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.reader import SessionReader, read_frame
from cloth_sim_ros.simulation.events import Grasp, Target, from_dict
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.studies.errors import StoppedError
from cloth_sim_ros.studies.run_recording import RunRecording
from cloth_sim_ros.studies.study_run import RunError, advance_ensemble, start_ensemble

Floats = NDArray[np.float32]


@attrs.frozen(kw_only=True, eq=False)
class Trajectory:
    """Trajectory of one run of T frames: T + 1 states and T transitions; float32, SI units."""

    #: Index of the run.
    run: int
    #: Frames per second [Hz].
    rate: float
    #: Names of grippers and obstacles, in the order of the arrays.
    grippers: tuple[str, ...]
    obstacles: tuple[str, ...]
    #: Particle indices of each triangle, shape (m, 3).
    triangles: NDArray[np.int32]
    #: Particle positions [m] and velocities [m/s], shape (T + 1, n, 3).
    positions: Floats
    velocities: Floats
    #: Pose of each gripper: position [m], quaternion x, y, z, w, closed (1) or open (0); shape (T + 1, grippers, 8). A
    #: gripper is nowhere until its first target: NaN, in actions too.
    poses: Floats
    #: Latest command of each gripper: target position [m], quaternion, close (1) or open (0); shape (T, grippers, 8).
    actions: Floats
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the frame, shape (T, grippers, 6).
    wrenches: Floats
    #: Pose of each obstacle: position [m] and quaternion, shape (T + 1, obstacles, 7).
    obstacle_poses: Floats


@attrs.frozen(kw_only=True)
class StudiedRun:
    """Successful run of a study: index, session file, and its result in the study's index."""

    run: int
    session: Path
    #: Number of frames, and digest of the state after them.
    n_frames: int
    digest: str


def read(studied: StudiedRun, *, copy_into: Path | None = None) -> Trajectory:
    """Return the trajectory of a run by simulating its session again. Raises StoppedError if a digest differs.

    Args:
        studied: the run.
        copy_into: folder for a copy of the session with clouds, also those of its ensemble; None for no copy.

    Raises:
        StoppedError: if the session can't be read or is not that of the run, a digest differs, or the ensemble can't
            go on.
    """
    run, session = studied.run, studied.session
    try:
        with SessionReader([session]) as reader:
            part = reader.parts[0]
            values = recorded_values(part.scene_yaml, node=reader.node)
            simulation = Simulation(Scene.from_parameters(values, files=part.files), State.from_bytes(part.state))
            part.rewind()
            records = [read_frame(message) for message in part.messages(topics=frozenset({f"{reader.node}/frame"}))]
        if (frames := len(records)) != studied.n_frames or (records and records[-1].digest != studied.digest):
            raise StoppedError(
                f"{session} is not the session of run {run}: it has {frames} frames, the run {studied.n_frames}"
                + ("; run the study again" if frames != studied.n_frames else ", and its last digest differs")
            )
        ensemble = None if copy_into is None else start_ensemble(simulation)
    except (SessionError, ValueError) as error:
        raise StoppedError(f"run {run} can't be read: {error}") from error
    recording = None
    if copy_into is not None:
        copy_into.mkdir(parents=True, exist_ok=True)
        recording = RunRecording(copy_into, simulation, name=session.stem, clouds=True)
    recorder = _TrajectoryRecorder(simulation)
    for record in records:
        events = [from_dict(dict(event)) for event in record.events]
        frame = simulation.advance(events)
        if simulation.state.digest() != record.digest:
            remedy = "export it with the version of cloth_sim_ros that recorded it (cloth_verify prints it)"
            raise StoppedError(f"run {run} has another digest here from frame {record.frame} on; {remedy}")
        if recording is not None:
            try:
                deviations = None if ensemble is None else advance_ensemble(ensemble, frame)
            except RunError as error:
                raise StoppedError(f"run {run} can't be exported: {error}") from error
            recording.add(events, frame, deviations)
        recorder.add(events, frame)
    if recording is not None:
        recording.finish(reason="stopped")
    return recorder.trajectory(run)


class _TrajectoryRecorder:
    """Recorder of the states, actions and wrenches of a simulation as a trajectory."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        names = ("positions", "velocities", "poses", "actions", "wrenches", "obstacle_poses")
        self._arrays: dict[str, list[Any]] = {name: [] for name in names}
        grippers = len(simulation.grippers.names)
        self._action = np.zeros((grippers, 8))
        for k, pose in enumerate(simulation.grippers.poses()):
            self._action[k, :7] = pose if simulation.grippers.is_placed(k) else np.nan
            self._action[k, 7] = simulation.grippers.is_closed(k)
        self._record_state()

    def add(self, events: list[Any], frame: Any) -> None:
        """Record the newest frame and the events that led to it."""
        names = self._simulation.grippers.names
        for event in events:
            if isinstance(event, Target):
                row = self._action[names.index(event.gripper)]
                row[:3] = event.position
                if event.orientation is not None:
                    row[3:7] = event.orientation
                elif np.isnan(row[3]):
                    row[3:7] = (0.0, 0.0, 0.0, 1.0)
            elif isinstance(event, Grasp):
                self._action[names.index(event.gripper), 7] = event.closed
        self._arrays["actions"].append(self._action.copy())
        self._arrays["wrenches"].append(frame.wrenches.copy())
        self._record_state()

    def trajectory(self, run: int) -> Trajectory:
        """Return the recorded trajectory."""
        simulation = self._simulation
        return Trajectory(
            run=run,
            rate=simulation.scene.rate,
            grippers=tuple(simulation.grippers.names),
            obstacles=() if simulation.obstacles is None else tuple(simulation.obstacles.names),
            triangles=np.asarray(simulation.scene.sheet.triangles(), dtype=np.int32).reshape(-1, 3),
            **{name: np.array(values, dtype=np.float32) for name, values in self._arrays.items()},
        )

    def _record_state(self) -> None:
        simulation = self._simulation
        grippers = simulation.grippers
        closed = [[float(grippers.is_closed(k))] for k in range(len(grippers.names))]
        poses = grippers.poses()
        for k in range(len(poses)):
            if not grippers.is_placed(k):
                poses[k] = np.nan
        self._arrays["positions"].append(simulation.state.x.T.astype(np.float32))
        self._arrays["velocities"].append(simulation.state.v.T.astype(np.float32))
        self._arrays["poses"].append(np.concatenate([poses, np.reshape(closed, (-1, 1))], axis=1))
        none = np.zeros((0, 7))
        self._arrays["obstacle_poses"].append(none if simulation.obstacles is None else simulation.obstacles.poses())
