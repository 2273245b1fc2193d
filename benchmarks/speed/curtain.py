# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Speed and error of the product on the curtain and corner scenes."""

from __future__ import annotations

import contextlib
import os
import statistics
from collections.abc import Callable, Iterator
from functools import partial

import attrs
from support.problems import Problem
from support.reference import Reference, reference

from benchmarks.timing import run_interleaved
from cloth_sim_ros.physics.control.automatic import make_integrator
from validation.tolerance.work_precision import SolverRun, run_integrator

#: Frames of `PERIOD` until the error measurement: 0.5 s, and 0.3 s at N = 128, where perturbations grow faster.
SCORED_FRAMES = {16: 30, 32: 30, 64: 30, 128: 18}
#: Largest error that counts as accurate [m].
ACCURATE = 1e-3
#: Tolerances of the reference and of its check. Stability limits the step here, so errors end far below them.
_TOLERANCE, _CHECK = 1e-10, 1e-9


def scored(scene: Callable[[int], Problem], resolution: int) -> Problem:
    """Return `curtain` (scene C) or `corner_drop` (scene A) up to the time of the error measurement.

    Raises:
        ValueError: for a resolution without a well-conditioned time.
    """
    if resolution not in SCORED_FRAMES:
        known = ", ".join(str(known) for known in SCORED_FRAMES)
        raise ValueError(f"N = {resolution}: errors mean something on sheets of {known} particles a side")
    return attrs.evolve(scene(resolution), frames=SCORED_FRAMES[resolution])


def trusted(problem: Problem) -> Reference:
    """Compute the reference solution; it takes a minute at N = 128."""
    return reference(problem, tolerance=_TOLERANCE, check=_CHECK)


def run(problem: Problem, *, tolerance: float | None, one_core: bool = False) -> SolverRun:
    """Run a scene as shipped, on all allowed cores or on one."""
    with cores(one_core=one_core):
        plan, state = problem.build()
        return run_integrator(problem, plan, state, make_integrator("auto", tolerance=tolerance))


@contextlib.contextmanager
def cores(*, one_core: bool) -> Iterator[None]:
    """Restrict this thread and its children to one core; a plan compiled within has one thread."""
    allowed = os.sched_getaffinity(0)
    if one_core:
        os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


@attrs.frozen(kw_only=True)
class CurtainSpeed:
    """Scene C at one tolerance, on all cores that this process may use or on one of them."""

    tolerance: float
    one_core: bool
    #: Simulated seconds per wall second of each run.
    factors: list[float]
    #: Mean force evaluations per frame.
    evaluations: float
    #: Largest final position error against the reference [m].
    error: float
    reason: str

    @property
    def factor(self) -> float:
        """Median of the factors."""
        return statistics.median(self.factors)


def curtain_speeds(
    problem: Problem, known: Reference, *, tolerances: tuple[float, ...], seconds: float
) -> list[CurtainSpeed]:
    """Run a scene in turns at each tolerance, on all cores and on one, for about `seconds`."""
    candidates = {
        (tolerance, one_core): partial(run, problem, tolerance=tolerance, one_core=one_core)
        for tolerance in tolerances
        for one_core in (False, True)
    }
    return [
        CurtainSpeed(
            tolerance=tolerance,
            one_core=one_core,
            factors=[problem.duration / counted_run.seconds for counted_run in counted],
            evaluations=counted[-1].evaluations / problem.frames,
            error=known.deviation(problem.frames, counted[-1].positions),
            reason=counted[-1].reason,
        )
        for (tolerance, one_core), counted in run_interleaved(candidates, seconds=seconds).items()
    ]


def loosest_accurate(speeds: list[CurtainSpeed]) -> CurtainSpeed | None:
    """Return the run on all cores with the largest tolerance and an error of at most `ACCURATE`, or None."""
    good = [speed for speed in speeds if not speed.one_core and speed.error <= ACCURATE]
    return max(good, key=lambda speed: speed.tolerance) if good else None
