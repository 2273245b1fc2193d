# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a sheet that is too stiff for explicit steps holds real time as shipped, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Callable

import attrs
import numpy as np
from support.problems import PERIOD, Problem
from support.reference import Reference

from benchmarks.timing import take_turns
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.forces.force import Array

#: Target of the position error [m], of which the sheet as shipped is held to the whole at the end.
TOLERANCE = 1e-3
#: What is compared: as shipped, and explicit steps at their stability limit without error control.
STEPPERS: dict[str, tuple[str, float | None]] = {"as shipped": ("auto", TOLERANCE), "explicit": ("leapfrog", None)}


@attrs.frozen(kw_only=True, eq=False)
class StiffSpeed:
    """Runs of a scene by one stepper."""

    name: str
    #: Names of the integrators that ran.
    integrators: tuple[str, ...]
    #: Wall times of frames [s], shape (runs, frames).
    frames: Array
    #: Largest distance of a particle from its place in the reference at the end [m].
    error: float

    @property
    def factor(self) -> float:
        """Simulated seconds per wall second, median over the runs."""
        return float(np.median(self.frames.shape[1] * PERIOD / self.frames.sum(axis=1)))

    @property
    def late(self) -> float:
        """Share of the frames that took longer than they last."""
        return float(np.mean(self.frames > PERIOD))


def stiff_speeds(problem: Problem, known: Reference, *, seconds: float) -> list[StiffSpeed]:
    """Run a scene in turns by each of `STEPPERS`, for about so many seconds."""
    times: dict[str, list[list[float]]] = {name: [] for name in STEPPERS}
    ends: dict[str, tuple[tuple[str, ...], Array]] = {}

    def candidate(name: str) -> Callable[[], None]:
        def turn() -> None:
            integrator, tolerance = STEPPERS[name]
            spent, names, x = _run(problem, integrator, tolerance)
            times[name].append(spent)
            ends[name] = names, x

        return turn

    take_turns({name: candidate(name) for name in STEPPERS}, seconds=seconds)
    speeds = []
    for name in STEPPERS:
        integrators, x = ends[name]
        # The first warmed up.
        frames = np.array(times[name][1:])
        error = known.deviation(problem.frames, x)
        speeds.append(StiffSpeed(name=name, integrators=integrators, frames=frames, error=error))
    return speeds


def _run(problem: Problem, name: str, tolerance: float | None) -> tuple[list[float], tuple[str, ...], Array]:
    """Wall times of the frames [s], the integrators that ran, and where the particles end."""
    plan, state = problem.build()
    integrator = make_integrator(name, tolerance=tolerance)
    spent, names = [], dict[str, None]()
    for frame in range(problem.frames):
        begin = time.perf_counter()
        names[integrator.advance(plan, state, frame * PERIOD, PERIOD).integrator] = None
        spent.append(time.perf_counter() - begin)
    return spent, tuple(names), state.x
