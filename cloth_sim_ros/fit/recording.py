# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for fits: commands of each frame, and clouds of the cloth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import reset_step_control
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.scene.recorded_scene import recorded_values
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Relax, SetParameters, from_dict
from cloth_sim_ros.simulation.sleep import wake

if TYPE_CHECKING:
    from cloth_sim_ros.fit.grasped import GraspedParticles

#: Least number of clouds with points.
MIN_CLOUDS = 3
#: Memory limit of residuals and derivatives of two windows [bytes].
MAX_BYTES = 4 << 30


@attrs.frozen(eq=False, kw_only=True)
class FitRecording:
    """Recording as a fit compares it: scene, initial state, events of each frame, and clouds.

    Clouds are matched (row k is particle k, NaN if it is hidden) or bare points of the surface.
    """

    #: Names of the files.
    name: str
    scene: Scene
    #: Initial state; None for the scene's own.
    state: State | None
    #: Events at the beginning of each frame.
    events: tuple[tuple[Event, ...], ...]
    #: Time of each cloud in frames since the start, with fractions, ascending; shape (clouds,).
    frames: NDArray[np.float64]
    #: Time of each cloud since the start of the recording [s], shape (clouds,).
    seconds: NDArray[np.float64]
    #: Points of each cloud [m], shape (points, 3).
    clouds: tuple[NDArray[np.float64], ...]
    #: True if row k of a cloud is particle k.
    matched: bool = True
    #: Number of settling frames, in which the cloth comes to rest in thick air; 0 if the initial state is known.
    n_settle_frames: int = 0
    #: True if all matched clouds may have a common offset. The camera's calibration and the cloth's position in the
    #: gripper are known to millimetres at best.
    has_shift: bool = False
    #: Description of the unreadable part of the recording; empty if it is complete.
    unreadable: str = ""
    #: Grasped particles of each gripper that is closed at the first cloud; empty for a session, whose state has them.
    grasped: tuple[GraspedParticles, ...] = ()

    def part(self, *, until: float | None = None, every: int = 1) -> FitRecording:
        """Return the recording with every n-th cloud and all events, up to a time [s] after its beginning.

        Args:
            until: time of the last cloud [s]; None for all.
            every: n.
        """
        last = len(self.seconds) if until is None else int(np.searchsorted(self.seconds, until + 1e-9, side="right"))
        frames = self.frames[:last:every]
        used = self.events if until is None or not frames.size else self.events[: int(np.ceil(frames[-1]))]
        return attrs.evolve(
            self, events=used, frames=frames, seconds=self.seconds[:last:every], clouds=self.clouds[:last:every]
        )


def read_session(paths: Sequence[Path], *, scene: Scene | None = None, matched: bool = True) -> FitRecording:
    """Read a recorded session's scene, state, events and clouds for a fit. Raises SessionError or FitError.

    Args:
        paths: files of the session, in order.
        scene: replaces the recorded scene, for other starting values.
        matched: true if row k of a cloud is particle k; false to use its points as bare surface points.

    Raises:
        SessionError: if a file can't be read.
        FitError: if scene and state do not match.
    """
    from cloth_sim_ros.session.cdr import decode_cloud
    from cloth_sim_ros.session.reader import SessionReader, read_frame

    events: list[tuple[Event, ...]] = []
    frames, seconds, clouds = list[float](), list[float](), list[NDArray[np.float64]]()
    with SessionReader(list(paths)) as reader:
        node = reader.node
        try:
            recorded = Scene.from_parameters(recorded_values(reader.scene_yaml, node=node), files=reader.files)
            state = State.from_bytes(reader.state)
        except ValueError as error:
            raise FitError(f"{paths[0]} holds no scene that this version can run: {error}") from error
        scene = scene or recorded
        if scene.rate != recorded.rate:
            rates = f"{scene.rate:g} Hz, the session {recorded.rate:g} Hz"
            raise FitError(f"the scene has a rate of {rates}; set the session's rate")
        begin, stamp, gap = state.frame, -1, ""
        for message in reader.messages([f"{node}/frame", f"{node}/points"]):
            if message.topic == f"{node}/frame":
                record = read_frame(message)
                if record.frame > begin + 1:
                    gap = f"frames {begin + 1} to {record.frame - 1} are missing; later frames are not used"
                    break
                begin, stamp = record.frame, message.publish_time
                events.append(_events(record.events, record.time))
            elif message.publish_time == stamp:
                frames.append(len(events))
                seconds.append((begin - state.frame) * scene.period)
                clouds.append(np.array(decode_cloud(message.data).xyz, dtype=np.float64))
        unreadable = "; ".join(filter(None, (gap, reader.missing)))
    return FitRecording(
        name=", ".join(Path(path).name for path in paths),
        scene=scene,
        state=prepare_state(state),
        events=tuple(events),
        frames=np.array(frames),
        seconds=np.array(seconds),
        clouds=tuple(clouds),
        matched=matched,
        unreadable=unreadable,
    )


def prepare_state(state: State) -> State:
    """Return a copy of a state for other parameters: awake, with a reset step controller and tolerance."""
    copy = state.copy()
    wake(copy)
    reset_step_control(copy, entirely=True)
    relaxation.set_factor(copy, 1.0)
    return copy


def check_recording(recording: FitRecording, parameter_names: Sequence[str], *, min_clouds: int = MIN_CLOUDS) -> None:
    """Raise FitError for too few or too many clouds, clouds of another cloth, or parameters that changed meanwhile.

    Args:
        recording: clouds and scene.
        parameter_names: full names of the fitted parameters.
        min_clouds: least number of clouds with points.

    Raises:
        FitError: if the recording is unusable; the text names cause and remedy.
    """
    scene, clouds = recording.scene, recording.clouds
    if not clouds:
        damage = f" ({recording.unreadable})" if recording.unreadable else ""
        cause = f"{recording.name} holds no cloud of the cloth in the requested time"
        raise FitError(f"{cause}; there is nothing to fit{damage}")
    count = len(scene.initial_positions())
    if recording.matched:
        for k, cloud in enumerate(clouds):
            if len(cloud) != count:
                raise FitError(
                    f"the cloud at {recording.seconds[k]:.3f} s has {len(cloud)} points, the scene's cloth {count} "
                    "particles: each point must be a particle, NaN if it is hidden, or carry its index in a "
                    "field 'index'; for points without index give --unordered"
                )
    has_points = [bool(np.isfinite(cloud).all(axis=1).any()) for cloud in clouds]
    if sum(has_points) < min_clouds:
        cause = f"{sum(has_points)} of {len(clouds)} clouds hold a point with finite coordinates"
        raise FitError(f"{cause}; a fit needs {min_clouds} or more")
    n_coordinates = sum(cloud.size for cloud in clouds)
    needed = 8 * n_coordinates * (4 * len(parameter_names) + 4)
    if needed > MAX_BYTES:
        raise FitError(
            f"{len(clouds)} clouds of {n_coordinates // 3} points in all would take {needed / 2**30:.1f} GiB of "
            f"memory; at most {MAX_BYTES / 2**30:.0f}: use fewer by --until SECONDS or --every N"
        )
    for frame, events in enumerate(recording.events):
        for event in events:
            for name in parameter_names:
                if isinstance(event, SetParameters) and name in event.values:
                    remedy = f"end before it by --until {frame * scene.period:.3f}, or omit the parameter"
                    raise FitError(f"{name} was changed during the recording, at frame {frame}; {remedy}")


def residual_offsets(recording: FitRecording) -> NDArray[np.int64]:
    """Return the index of each cloud's first residual in the vector of all, and its length, shape (clouds + 1,)."""
    width = 3 if recording.matched else 1
    counts = [width * int(np.isfinite(cloud).all(axis=1).sum()) for cloud in recording.clouds]
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def visible_mask(cloud: Array) -> NDArray[np.bool_]:
    """Return a mask of the visible points of a cloud of shape (n, 3): true if finite, shape (n,)."""
    return np.asarray(np.isfinite(cloud).all(axis=1))


def _events(records: Sequence[Mapping[str, Any]], time: float) -> tuple[Event, ...]:
    try:
        events = [from_dict(dict(event)) for event in records]
    except ValueError as error:
        raise FitError(f"the record of the frame at {time:.3f} s can't be run here: {error}") from error
    # The fit sets its own tolerance.
    return tuple(event for event in events if not isinstance(event, Relax) and not _sets_steps(event))


def _sets_steps(event: Event) -> bool:
    return isinstance(event, SetParameters) and set(event.values) <= {"tolerance", "step", "integrator", "work_limit"}
