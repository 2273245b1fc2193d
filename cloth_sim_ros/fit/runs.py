# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulations of a recording's motion with other parameters, in parallel processes.

The residuals of a run depend only on parameters, window and tolerance. They do not depend on the process.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import attrs
import numpy as np

from cloth_sim_ros.fit.parameters import FitParameter, scene_with
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.run_pool import RunPool
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

if TYPE_CHECKING:
    pass

#: Air drag of settling frames [1/s]: the slowest oscillation of a sheet of 0.5 m is close to critically damped.
SETTLING_DRAG = 6.0
#: Work limit of a frame [multiple of real time, estimated]. It stops simulations of parameters that crumple the cloth.
MAX_WORK = 30.0


@attrs.frozen(kw_only=True)
class FitRun:
    """Request of one simulation of a recording: parameter values, number of clouds and tolerance."""

    #: Values of the parameters, in their units.
    values: tuple[float, ...]
    #: Number of compared clouds, from the first one.
    n_clouds: int
    #: Tolerance of the simulation [m].
    tolerance: float


def simulate(recording: FitRecording, parameters: Sequence[FitParameter], run: FitRun) -> Array:
    """Simulate a recording; return positions at the times of its clouds [m], shape (clouds, particles, 3).

    Positions between two frames' ends are interpolated by cubic Hermite polynomials.

    Args:
        recording: commands and times of the clouds.
        parameters: the parameters, in the order of the values.
        run: values, number of clouds and tolerance.

    Raises:
        ValueError: if the values are invalid, or an event can't take effect.
        UnstableError: if the motion does not stay finite.
    """
    return simulate_with_misses(recording, parameters, run)[0]


def simulate_with_misses(recording: FitRecording, parameters: Sequence[FitParameter], run: FitRun) -> tuple[Array, int]:
    """Simulate as `simulate` does; return the positions, and the number of frames that missed the tolerance."""
    scene = scene_with(recording.scene, parameters, run.values, tolerance=run.tolerance, step=0.0, work_limit=MAX_WORK)
    simulation = Simulation(scene, recording.state)
    frames, period = recording.frames[: run.n_clouds], scene.period
    positions = np.empty((len(frames), simulation.state.particle_count, 3))
    x0, v0 = simulation.state.x, simulation.state.v
    n_frames = n_missed = 0
    for k, frame_time in enumerate(frames):
        while n_frames < frame_time:
            x0, v0 = simulation.state.x, simulation.state.v
            drag_events = settling_drag_events(scene, n_frames, recording.n_settle_frames)
            advance = simulation.advance([*recording.events[n_frames], *drag_events]).advance
            n_missed += advance is not None and advance.flagged > 0
            n_frames += 1
        x1, v1 = simulation.state.x, simulation.state.v
        s = frame_time - (n_frames - 1)
        positions[k] = (x1 if n_frames == frame_time else interpolate(x0, v0, x1, v1, s, period)).T
    return positions, n_missed


def residuals(recording: FitRecording, parameters: Sequence[FitParameter], run: FitRun) -> Array:
    """Simulate a recording; return its clouds' residuals, measured minus simulated [m], shape (n,).

    A matched cloud gives three coordinates per visible particle. Bare points give their distances from the surface.
    """
    positions = simulate(recording, parameters, run)
    parts = []
    if not recording.matched:
        from cloth_sim_ros.fit.surface import signed_distances

        triangles = recording.scene.sheet.triangles()
        for cloud, x in zip(recording.clouds, positions, strict=False):
            parts.append(signed_distances(cloud[visible_mask(cloud)], x, triangles))
    else:
        for cloud, x in zip(recording.clouds, positions, strict=False):
            seen = visible_mask(cloud)
            parts.append((cloud[seen] - x[seen]).ravel())
    r = np.concatenate(parts)
    return r - np.tile(mean_offset(r), r.size // 3) if recording.has_shift else r


def mean_offset(r: Array) -> Array:
    """Return the mean of the residuals of matched clouds, their common shift [m], shape (3,).

    After subtraction of this vector, residuals and derivatives are those of a fit that includes it.
    """
    return np.asarray(r.reshape(-1, 3).mean(axis=0)) if r.size else np.zeros(3)


class FitRunPool(RunPool):
    """Pool of processes that simulate one recording with many parameter values.

    Args:
        recording: commands and clouds.
        parameters: the parameters, in the order of each run's values.
        workers: as for `RunPool`.
    """

    def __init__(
        self, recording: FitRecording, parameters: Sequence[FitParameter], *, workers: int | None = None
    ) -> None:
        self.recording, self.parameters = recording, list(parameters)
        super().__init__(workers, initializer=_init_worker, arguments=(recording, self.parameters))

    def compute_residuals(self, runs: Sequence[FitRun]) -> list[Array | str]:
        """Simulate runs in parallel; return each one's residuals [m], shape (n,), or the text of its error.

        Raises:
            FitError: as `RunPool.map`.
        """
        return self.map(
            _residuals_in_worker,
            runs,
            local_function=lambda run: _residuals_or_error(self.recording, self.parameters, run),
        )


def settling_drag_events(scene: Scene, frame: int, n_settle_frames: int) -> list[SetParameters]:
    """Return the events that raise the drag of air in frame 0 and restore the scene's drag after settling."""
    if not n_settle_frames or frame not in (0, n_settle_frames):
        return []
    return [SetParameters({"air.drag": scene.air.drag if frame else max(SETTLING_DRAG, scene.air.drag)})]


def interpolate(x0: Array, v0: Array, x1: Array, v1: Array, s: float | Array, period: float) -> Array:
    """Return positions between two frames [m], at a fraction s of the frame, by cubic Hermite interpolation."""
    a, b = s * s * (3.0 - 2.0 * s), s * (1.0 - s)
    return np.asarray(x0 + a * (x1 - x0) + period * b * ((1.0 - s) * v0 - s * v1))


def _residuals_or_error(recording: FitRecording, parameters: Sequence[FitParameter], run: FitRun) -> Array | str:
    try:
        return residuals(recording, parameters, run)
    except (ValueError, UnstableError) as error:
        return str(error)


#: Recording and parameters of a worker process.
_worker_inputs: tuple[FitRecording, Sequence[FitParameter]] | None = None


def _init_worker(recording: FitRecording, parameters: Sequence[FitParameter]) -> None:
    global _worker_inputs
    _worker_inputs = recording, parameters


def _residuals_in_worker(run: FitRun) -> Array | str:
    assert _worker_inputs is not None
    return _residuals_or_error(*_worker_inputs, run)
