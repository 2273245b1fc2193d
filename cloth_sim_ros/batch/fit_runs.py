# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs of a recording's motion with other parameters, many at a time in processes of their own.

A run's residuals depend on its parameters, the window and the tolerance alone, never on which process made it.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

import attrs
import numpy as np

from cloth_sim_ros.batch.fit_parameters import FitError, Fitted, scene_with
from cloth_sim_ros.batch.fit_recording import Recording, visible
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.child_process import overrides, safe_imports
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

if TYPE_CHECKING:
    from loky import ProcessPoolExecutor

#: Drag of the air in which a cloth comes to rest [1/s]: the slowest swing of a sheet of half a metre dies away fastest.
THICK = 6.0
#: Most work of a frame, in real time by its estimated cost: a cloth that values far off crumple is not followed for
#: hours.
MOST_WORK = 30.0


@attrs.frozen(kw_only=True)
class Run:
    """One run that is asked for."""

    #: Values of the parameters.
    values: tuple[float, ...]
    #: Clouds that are compared: the first so many.
    clouds: int
    #: Of the simulation [m].
    tolerance: float


def simulate(recording: Recording, fitted: Sequence[Fitted], run: Run) -> Array:
    """Return the particles' positions when each cloud was taken [m], shape (clouds, particles, 3).

    Between the ends of two frames they follow the cubic through positions and velocities there.

    Raises:
        ValueError: where the values make no scene, or an event can't take effect.
        UnstableError: where the motion does not stay finite.
    """
    return followed(recording, fitted, run)[0]


def followed(recording: Recording, fitted: Sequence[Fitted], run: Run) -> tuple[Array, int]:
    """Return what `simulate` returns, and the number of frames that missed the tolerance within the work limit."""
    scene = scene_with(recording.scene, fitted, run.values, tolerance=run.tolerance, step=0.0, work_limit=MOST_WORK)
    simulation = Simulation(scene, recording.state)
    frames, period = recording.frames[: run.clouds], scene.period
    found = np.empty((len(frames), simulation.state.particle_count, 3))
    x0, v0 = simulation.state.x, simulation.state.v
    done = missed = 0
    for k, moment in enumerate(frames):
        while done < moment:
            x0, v0 = simulation.state.x, simulation.state.v
            advance = simulation.advance([*recording.events[done], *_air(scene, done, recording.lead)]).advance
            missed += advance is not None and advance.flagged > 0
            done += 1
        x1, v1 = simulation.state.x, simulation.state.v
        s = moment - (done - 1)
        found[k] = (x1 if done == moment else _between(x0, v0, x1, v1, s, period)).T
    return found, missed


def residuals(recording: Recording, fitted: Sequence[Fitted], run: Run) -> Array:
    """Return the points that were seen less the simulated ones [m], cloud after cloud.

    Of matched clouds all three coordinates of each particle, of bare points the distance from the surface.
    """
    found = simulate(recording, fitted, run)
    parts = []
    if not recording.matched:
        from cloth_sim_ros.batch.fit_surface import distances

        triangles = recording.scene.sheet.triangles()
        for cloud, x in zip(recording.clouds, found, strict=False):
            parts.append(distances(cloud[visible(cloud)], x, triangles))
    else:
        for cloud, x in zip(recording.clouds, found, strict=False):
            seen = visible(cloud)
            parts.append((cloud[seen] - x[seen]).ravel())
    r = np.concatenate(parts)
    return r - np.tile(shift(r), r.size // 3) if recording.shifted else r


def shift(r: Array) -> Array:
    """Return by what residuals of matched clouds lie off on the whole [m], shape (3,).

    With it taken away, residuals and derivatives are those of a fit that seeks this vector too.
    """
    return np.asarray(r.reshape(-1, 3).mean(axis=0)) if r.size else np.zeros(3)


class Runs:
    """Runs of one recording, as many at a time as there are workers.

    Args:
        recording: what is compared with.
        fitted: the parameters, in the order of each run's values.
        workers: processes; 1 runs in this one, None takes one a core.
    """

    def __init__(self, recording: Recording, fitted: Sequence[Fitted], *, workers: int | None = None) -> None:
        self.recording, self.fitted = recording, list(fitted)
        self.workers = workers or len(os.sched_getaffinity(0))
        #: Runs made so far.
        self.made = 0
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            # What still runs after an error is for nothing.
            self._pool.shutdown(wait=kind is None, kill_workers=kind is not None)

    def make(self, runs: Sequence[Run]) -> list[Array | str]:
        """Return each run's residuals [m], or why it could not be made.

        Raises:
            FitError: if a worker process was ended from outside, or loky is not there.
        """
        self.made += len(runs)
        if self.workers == 1 or len(runs) == 1:
            return [_made(self.recording, self.fitted, run) for run in runs]
        try:
            from loky.process_executor import BrokenProcessPool, ProcessPoolExecutor
        except ImportError as error:
            raise FitError(
                f"{self.workers} processes need loky: pip install 'cloth_sim_ros[batch]', or take --workers 1"
            ) from error

        try:
            with safe_imports():
                if self._pool is None:
                    # Not of the standard library: those would begin by running the user's program once more.
                    self._pool = ProcessPoolExecutor(
                        self.workers, initializer=_begin, initargs=(self.recording, self.fitted), env=overrides()
                    )
                results = self._pool.map(_work, runs)
            return list(results)
        except BrokenProcessPool as error:
            raise FitError("a worker process was ended, perhaps for want of memory; take --workers 1") from error


def _air(scene: Scene, frame: int, lead: int) -> list[SetParameters]:
    """Thick air until the lead has passed, then the scene's own."""
    if not lead or frame not in (0, lead):
        return []
    return [SetParameters({"air.drag": scene.air.drag if frame else max(THICK, scene.air.drag)})]


def _between(x0: Array, v0: Array, x1: Array, v1: Array, s: float, period: float) -> Array:
    """The cubic through positions [m] and velocities [m/s] at the ends of a frame, at its part s."""
    a, b = s * s * (3.0 - 2.0 * s), s * (1.0 - s)
    return np.asarray(x0 + a * (x1 - x0) + period * b * ((1.0 - s) * v0 - s * v1))


def _made(recording: Recording, fitted: Sequence[Fitted], run: Run) -> Array | str:
    try:
        return residuals(recording, fitted, run)
    except (ValueError, UnstableError) as error:
        return str(error)


#: Of a worker process.
_task: tuple[Recording, Sequence[Fitted]] | None = None


def _begin(recording: Recording, fitted: Sequence[Fitted]) -> None:
    global _task
    _task = recording, fitted
    # An interruption from the keyboard reaches all processes; the one that asked for the runs ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(run: Run) -> Array | str:
    assert _task is not None
    return _made(*_task, run)
