# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated motions near the times of a recording's clouds, for any time offset of the clouds."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitParameter, scene_with
from cloth_sim_ros.fit.recording import FitRecording, prepare_state
from cloth_sim_ros.fit.run_pool import RunPool
from cloth_sim_ros.fit.runs import MAX_WORK, SETTLING_DRAG, interpolate
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Tolerance of settling frames [m].
SETTLING_TOLERANCE = 1e-3
#: Duration of a settling frame [s].
SETTLING_PERIOD = 0.1
#: Settling time of a cloth that starts from the rest state of similar parameters [s].
WARM_SETTLE_TIME = 1.5


@attrs.frozen(kw_only=True, eq=False)
class SimulatedMotion:
    """Positions [m] and velocities [m/s], (frames, particles, 3), of a simulation at the frames near the clouds."""

    #: Indices of the frames, ascending, shape (frames,); 0 is the start.
    frames: NDArray[np.int64]
    #: Positions [m] and velocities [m/s], shape (frames, particles, 3).
    x: Array
    v: Array
    #: Duration of a frame [s].
    period: float
    #: Number of frames that missed the tolerance.
    n_missed: int
    #: Number of settling frames before the motion.
    n_settle_frames: int
    #: State at the end of settling.
    rest_state: State | None = None

    def sample(self, frame_times: NDArray[np.float64]) -> Array:
        """Return positions [m] at times that count frames, with fractions, shape (times, particles, 3).

        Positions between two frames are interpolated by cubic Hermite polynomials. Times outside the trajectory give
        its first or last position.
        """
        clipped = np.clip(frame_times, self.frames[0], self.frames[-1])
        below = np.searchsorted(self.frames, np.floor(clipped), side="right") - 1
        below = np.clip(below, 0, len(self.frames) - 1)
        above = np.minimum(below + 1, len(self.frames) - 1)
        s = (clipped - self.frames[below])[:, None, None]
        x0, v0, x1, v1 = self.x[below], self.v[below], self.x[above], self.v[above]
        return interpolate(x0, v0, x1, v1, s, self.period)


@attrs.frozen(kw_only=True, eq=False)
class TrajectoryRun:
    """Request of one simulation of a recording: parameter values, tolerance and time offsets."""

    #: Recording without clouds.
    recording: FitRecording
    parameters: tuple[FitParameter, ...]
    #: Values of the parameters, in their units.
    values: tuple[float, ...]
    #: Tolerance of the simulation [m].
    tolerance: float
    #: Smallest and largest time offset of the clouds [frames].
    offsets: tuple[float, float] = (0.0, 0.0)


def trajectory_run(
    recording: FitRecording,
    parameters: Sequence[FitParameter],
    values: Sequence[float],
    *,
    tolerance: float,
    offsets: tuple[float, float] = (0.0, 0.0),
    rest_state: State | None = None,
    is_at_rest: bool = False,
) -> TrajectoryRun:
    """Return the request of a simulation; from a rest state of similar parameters it settles faster.

    Args:
        recording: commands and times of the clouds.
        parameters: the parameters, in the order of the values.
        values: values of the parameters.
        tolerance: tolerance of the simulation [m].
        offsets: smallest and largest time offset of the clouds [s].
        rest_state: rest state of similar parameters, from which the cloth settles faster.
        is_at_rest: true if the rest state is that of these parameters too.
    """
    light = attrs.evolve(recording, clouds=())
    n_warm = 0 if is_at_rest else max(round(WARM_SETTLE_TIME * recording.scene.rate), 1)
    n_warm = min(n_warm, recording.n_settle_frames)
    omitted = recording.n_settle_frames - n_warm
    if rest_state is not None and recording.n_settle_frames:
        light = attrs.evolve(
            light,
            state=rest_state,
            events=recording.events[omitted:],
            frames=recording.frames - omitted,
            n_settle_frames=n_warm,
        )
    rate = recording.scene.rate
    return TrajectoryRun(
        recording=light,
        parameters=tuple(parameters),
        values=tuple(values),
        tolerance=tolerance,
        offsets=(offsets[0] * rate, offsets[1] * rate),
    )


def simulate_trajectory(run: TrajectoryRun) -> SimulatedMotion:
    """Let the cloth settle, then simulate a recording; return the motion near the times of the clouds.

    Raises:
        ValueError: if the values are invalid, or an event can't take effect.
        UnstableError: if the motion does not stay finite.
    """
    recording, n_settle = run.recording, run.recording.n_settle_frames
    scene = scene_with(
        recording.scene, run.parameters, run.values, tolerance=run.tolerance, step=0.0, work_limit=MAX_WORK
    )
    rest_state = _settle(recording, scene) if n_settle else None
    simulation = Simulation(scene, rest_state or recording.state)
    stored_frames = _needed_frames(recording, run.offsets)
    positions, velocities, n_missed = [], [], 0
    needed = frozenset(stored_frames.tolist())
    for n in range(n_settle, int(stored_frames[-1]) + 1):
        if n in needed:
            positions.append(simulation.state.x.T.copy())
            velocities.append(simulation.state.v.T.copy())
        if n < stored_frames[-1]:
            advance = simulation.advance(recording.events[n]).advance
            n_missed += advance is not None and advance.flagged > 0
    return SimulatedMotion(
        frames=stored_frames,
        x=np.array(positions),
        v=np.array(velocities),
        period=scene.period,
        n_missed=n_missed,
        n_settle_frames=n_settle,
        rest_state=rest_state,
    )


def _settle(recording: FitRecording, scene: Scene) -> State:
    """Return the state of a cloth after its settling time in thick air.

    Nothing moves while the cloth settles, therefore frames are long: most of a frame's cost is independent of its
    duration.
    """
    seconds = recording.n_settle_frames * scene.period
    n_frames = max(round(seconds / SETTLING_PERIOD), 1)
    changes = {
        "rate": n_frames / seconds,
        "tolerance": max(SETTLING_TOLERANCE, scene.tolerance),
        "air.drag": max(SETTLING_DRAG, scene.air.drag),
    }
    settling = scene_with(scene, (), (), **changes)
    simulation = Simulation(settling, recording.state)
    for n in range(n_frames):
        simulation.advance(recording.events[0] if n == 0 else ())
    return prepare_state(simulation.state)


def _needed_frames(recording: FitRecording, offsets: tuple[float, float]) -> NDArray[np.int64]:
    """Return the indices of the frames that clouds need within time offsets [frames], from the end of settling on."""
    last = len(recording.events)
    needed = np.zeros(last + 1, dtype=bool)
    # A cloud with a positive offset is late: it shows an earlier frame.
    for frame in recording.frames:
        begin = int(np.clip(np.floor(frame - offsets[1]), recording.n_settle_frames, last))
        end = int(np.clip(np.ceil(frame - offsets[0]), recording.n_settle_frames, last))
        needed[begin : end + 1] = True
    # Start and rest shape serve as yardstick.
    needed[min(recording.n_settle_frames, last)] = True
    return np.flatnonzero(needed)


class TrajectoryPool(RunPool):
    """Pool of processes (context manager) that simulate recordings, each by a `TrajectoryRun`."""

    def simulate(self, runs: Sequence[TrajectoryRun]) -> list[SimulatedMotion | str]:
        """Simulate runs in parallel; return the motion of each, or the text of its error.

        Raises:
            FitError: as `RunPool.map`.
        """
        return self.map(_trajectory_or_error, runs)


def _trajectory_or_error(run: TrajectoryRun) -> SimulatedMotion | str:
    try:
        return simulate_trajectory(run)
    except (ValueError, UnstableError) as error:
        return str(error)
