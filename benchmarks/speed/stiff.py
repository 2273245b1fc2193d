# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real-time factor of a sheet too stiff for explicit steps."""

from __future__ import annotations

from functools import partial

import attrs
import numpy as np
from support.problems import PERIOD, Problem
from support.reference import Reference

from benchmarks.speed import curtain
from benchmarks.timing import run_interleaved
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
    candidates = {
        name: partial(curtain.run, problem, integrator, tolerance=tolerance)
        for name, (integrator, tolerance) in STEPPERS.items()
    }
    return [
        StiffSpeed(
            name=name,
            integrators=runs[-1].integrators,
            frames=np.array([run.frame_times for run in runs]),
            error=known.deviation(problem.frames, runs[-1].positions),
        )
        for name, runs in run_interleaved(candidates, seconds=seconds).items()
    ]
