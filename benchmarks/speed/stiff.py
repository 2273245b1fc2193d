# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real-time factor of a sheet too stiff for explicit steps."""

from __future__ import annotations

import time
from collections.abc import Callable

import attrs
import numpy as np
from support.problems import PERIOD, Problem
from support.reference import Reference

from benchmarks.timing import time_interleaved
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.model.forces.force import Array

#: Tolerance, and bound of the final position error of the sheet as shipped [m].
TOLERANCE = 1e-3
#: Compared integrators: as shipped, and explicit at the stability limit without error control.
STEPPERS: dict[str, tuple[str, float | None]] = {"as shipped": ("auto", TOLERANCE), "explicit": ("leapfrog", None)}


@attrs.frozen(kw_only=True, eq=False)
class StiffSpeed:
    """Runs of a scene by one stepper."""

    name: str
    #: Names of the integrators used.
    integrators: tuple[str, ...]
    #: Wall times of frames [s], shape (runs, frames).
    frames: Array
    #: Largest final position error against the reference [m].
    error: float

    @property
    def factor(self) -> float:
        """Simulated seconds per wall second, median over the runs."""
        return float(np.median(self.frames.shape[1] * PERIOD / self.frames.sum(axis=1)))

    @property
    def late(self) -> float:
        """Share of frames that took longer than their period."""
        return float(np.mean(self.frames > PERIOD))


def stiff_speeds(problem: Problem, known: Reference, *, seconds: float) -> list[StiffSpeed]:
    """Run a scene in turns by each of `STEPPERS`, for about `seconds`."""
    times: dict[str, list[list[float]]] = {name: [] for name in STEPPERS}
    ends: dict[str, tuple[tuple[str, ...], Array]] = {}

    def candidate(name: str) -> Callable[[], None]:
        def turn() -> None:
            integrator, tolerance = STEPPERS[name]
            wall_times, names, x = _run(problem, integrator, tolerance)
            times[name].append(wall_times)
            ends[name] = names, x

        return turn

    time_interleaved({name: candidate(name) for name in STEPPERS}, seconds=seconds)
    speeds = []
    for name in STEPPERS:
        integrators, x = ends[name]
        # The first run is a warm-up.
        frames = np.array(times[name][1:])
        error = known.deviation(problem.frames, x)
        speeds.append(StiffSpeed(name=name, integrators=integrators, frames=frames, error=error))
    return speeds


def _run(problem: Problem, name: str, tolerance: float | None) -> tuple[list[float], tuple[str, ...], Array]:
    """Return wall times of the frames [s], integrators used, and final positions [m], (3, n)."""
    plan, state = problem.build()
    integrator = make_integrator(name, tolerance=tolerance)
    wall_times, names = [], dict[str, None]()
    for frame in range(problem.frames):
        begin = time.perf_counter()
        names[integrator.advance(plan, state, frame * PERIOD, PERIOD).integrator] = None
        wall_times.append(time.perf_counter() - begin)
    return wall_times, tuple(names), state.x
