# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Search for violations of the error bound: climbs that maximise the error ratio of unflagged windows.

A family maps a vector of numbers in [0, 1] to a scene of public parameters. A climb maximises the error ratio, error /
(tolerance x max(1, g)), over the unflagged windows of a family's scenes. It uses hill climbing with restarts, or
differential evolution.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.parameters.declare import ParameterError
from validation.case_pool import CasePool, read_results
from validation.report import Report
from validation.tolerance.climb_families import FAMILIES
from validation.tolerance.climb_scenes import Trial

METHODS = ("hill", "evolution")
#: Random starts of a hill climb, and limits of the number of failures in a row before it restarts.
_STARTS, _MAX_FAILURES = 6, (30, 200)
#: Members of differential evolution's population.
_POPULATION = 24
#: Time of a climb's last scene beyond the climb's own time [s]; a scene that takes longer ends without a result.
_LAST_SCENE = 120.0
#: Largest expected ratio of wall time to processor time.
_LOAD = 10.0


@attrs.frozen
class Climb:
    """One climb of a family."""

    family: str
    method: str
    seed: int
    index: int
    #: Processor time [s].
    seconds: float


@attrs.frozen(kw_only=True)
class ClimbResult:
    """Summit of one climb, and statistics of its scenes."""

    #: Largest error ratio of an unflagged window, 0 without one; its vector and its scene.
    ratio: float
    vector: tuple[float, ...]
    tolerance: float
    amplification: float
    words: str
    parameters: dict[str, Any]
    #: Median error ratio of all unflagged windows.
    median: float
    scenes: int
    windows: int
    flagged: int
    #: Windows that the reference can't follow, and scenes without evaluation.
    unknown: int
    not_evaluated: int


#: Types of a case and of its result.
_KINDS = (Climb, ClimbResult)


class _TimeOverError(Exception):
    """The time of a climb is over."""


class _Objective:
    """Error ratio of the scene of a vector, and statistics of all of them."""

    def __init__(self, family: str, seconds: float) -> None:
        self._family, self._end = family, time.process_time() + seconds
        self._vector = np.zeros(0)
        self._trial: Trial | None = None
        self._ratios = list[float]()
        self._ratio, self._counts = -1.0, dict.fromkeys(("scenes", "windows", "flagged", "unknown", "not_evaluated"), 0)

    def __call__(self, vector: Array) -> float:
        if time.process_time() > self._end:
            raise _TimeOverError
        trial = evaluate_vector(self._family, vector)
        self._counts["scenes"] += 1
        if trial is None or not trial.windows:
            self._counts["not_evaluated"] += 1
        if trial is None:
            return 0.0
        known = [window for window in trial.windows if window.is_known]
        self._counts["windows"] += len(known)
        self._counts["flagged"] += sum(window.flagged > 0 for window in known)
        self._counts["unknown"] += len(trial.windows) - len(known)
        self._ratios += [window.ratio for window in trial.unflagged]
        ratio = trial.worst.ratio if trial.worst else 0.0
        if ratio > self._ratio:
            self._ratio, self._vector, self._trial = ratio, vector.copy(), trial
        return ratio

    def result(self) -> ClimbResult:
        trial = self._trial
        worst = trial.worst if trial else None
        return ClimbResult(
            ratio=max(self._ratio, 0.0),
            vector=tuple(self._vector.tolist()),
            tolerance=trial.tolerance if trial else 0.0,
            amplification=worst.amplification if worst else 0.0,
            words=trial.words if trial else "",
            parameters=dict(trial.parameters) if trial else {},
            median=float(np.median(self._ratios)) if self._ratios else 0.0,
            **self._counts,
        )


def evaluate_vector(family: str, vector: Array) -> Trial | None:
    """Evaluate the scene of a vector; None if its parameters do not make a scene."""
    try:
        return FAMILIES[family][0](VectorGenerator(vector.tolist()))
    except ParameterError:
        # Not every material can be woven into every grid.
        return None


def run_climb(climb: Climb) -> ClimbResult:
    """Climb until the time is over."""
    rng = np.random.default_rng([climb.seed, climb.index])
    objective, size = _Objective(climb.family, climb.seconds), FAMILIES[climb.family][1]
    try:
        while True:
            (_climb_hill if climb.method == "hill" else _evolve)(objective, rng, size)
    except _TimeOverError:
        return objective.result()


def _climb_hill(objective: Callable[[Array], float], rng: np.random.Generator, size: int) -> None:
    """Climb from the best of some random vectors until many steps in a row fail."""
    starts = [rng.random(size) for _ in range(_STARTS)]
    ratios = [objective(start) for start in starts]
    ratio, vector = max(zip(ratios, starts, strict=True), key=lambda pair: pair[0])
    failures, max_failures = 0, int(rng.integers(*_MAX_FAILURES))
    while failures < max_failures:
        is_changed = rng.random(size) < max(1.5 / size, 0.5 * rng.random() ** 2)
        step = 10.0 ** rng.uniform(-3.0, -0.3) * rng.normal(size=size)
        # Steps across a limit are reflected.
        candidate = 1.0 - np.abs(1.0 - np.abs(vector + is_changed * step))
        candidate_ratio = objective(np.clip(candidate, 0.0, 1.0))
        failures = 0 if candidate_ratio > ratio else failures + 1
        if candidate_ratio >= ratio:
            ratio, vector = candidate_ratio, np.clip(candidate, 0.0, 1.0)


def _evolve(objective: Callable[[Array], float], rng: np.random.Generator, size: int) -> None:
    """Run differential evolution from a random population until it has converged."""
    from scipy.optimize import differential_evolution

    differential_evolution(
        lambda vector: -objective(vector),
        [(0.0, 1.0)] * size,
        init=rng.random((_POPULATION, size)),
        rng=rng,
        polish=False,
    )


def climb_command(options: argparse.Namespace) -> Report:
    """Run the climbs, or replay those of a file."""
    return _replay(options.replay) if options.replay else _climb(options)


def _climb(options: argparse.Namespace) -> Report:
    families = options.family or list(FAMILIES)
    turns = itertools.islice(itertools.cycle(itertools.product(METHODS, families)), options.climbs)
    cases = [Climb(family, method, options.seed, k, options.seconds) for k, (method, family) in enumerate(turns)]
    report = Report("Search for violations of the error bound")
    results = CasePool(options.jobs, _LOAD * (options.seconds + _LAST_SCENE), options.resume).report(
        run_climb,
        cases,
        report,
        name=lambda climb: f"climb {climb.index} of {climb.family}, {climb.method}",
        describe=lambda result: f"ratio {result.ratio:.3g}, {result.words}",
        kinds=_KINDS,
    )
    columns = ["family", "climbs", "scenes", "lowest best", "lower quartile", "median best", "upper quartile", "best"]
    columns += ["above 1", "median of windows", "flagged"]
    summary_table = report.add_table("Largest error ratio of each climb", columns)
    for family in families:
        if summits := [result for climb, result in results if climb.family == family]:
            ratios = [result.ratio for result in summits]
            sums = {name: sum(getattr(result, name) for result in summits) for name in ("scenes", "windows", "flagged")}
            quantiles = np.quantile(ratios, [0.0, 0.25, 0.5, 0.75, 1.0]).tolist()
            n_above, median = sum(ratio > 1.0 for ratio in ratios), np.median([result.median for result in summits])
            row: list[Any] = [family, len(summits), sums["scenes"], *quantiles, n_above, float(median)]
            summary_table.rows.append([*row, sums["flagged"] / max(1, sums["windows"])])
    columns = ["climb", "family", "method", "ratio", "tolerance m", "g", "scenes", "unknown", "not evaluated", "what"]
    table = report.add_table("Scene of the largest error ratio of each climb", columns)
    for climb, result in sorted(results, key=lambda pair: -pair[1].ratio):
        row = [climb.index, climb.family, climb.method, result.ratio, result.tolerance, result.amplification]
        table.rows.append([*row, result.scenes, result.unknown, result.not_evaluated, result.words])
    _require(report, "climbs", [result.ratio for _, result in results])
    return report


def _replay(file: Path) -> Report:
    """Evaluate the best scene of each climb of a file again."""
    report = Report("Replay of a search")
    columns = ["climb", "family", "ratio", "recorded ratio", "tolerance m", "g", "error m", "flagged windows", "what"]
    table = report.add_table("Scenes of the largest error ratios", columns)
    for done in read_results(file, _KINDS):
        if done.result is None or not done.result.vector:
            continue
        trial = evaluate_vector(done.case.family, np.array(done.result.vector))
        worst = trial.worst if trial else None
        row: list[Any] = [done.case.index, done.case.family, worst.ratio if worst else 0.0, done.result.ratio]
        row += [done.result.tolerance, worst.amplification if worst else 0.0, worst.error if worst else 0.0]
        n_flagged = sum(window.flagged > 0 for window in trial.windows) if trial else 0
        table.rows.append([*row, n_flagged, done.result.words])
    table.rows.sort(key=lambda row: -float(row[2]))
    _require(report, "scenes", [row[2] for row in table.rows])
    return report


def _require(report: Report, kind: str, ratios: list[float]) -> None:
    n_violations = sum(ratio > 1.0 for ratio in ratios)
    failure = f"{n_violations} of {len(ratios)} {kind} violate the error bound without a flagged frame"
    report.require(not n_violations, failure)


class VectorGenerator(np.random.Generator):
    """Generator that draws from a vector of numbers in [0, 1], one coordinate a number.

    Draws beyond the vector's end are pseudorandom, the same for every vector.
    """

    def __init__(self, vector: Sequence[float]) -> None:
        bits = np.random.PCG64(0)
        super().__init__(bits)
        self._vector, self._n_drawn, self._fallback = vector, 0, np.random.Generator(bits)

    def random(self, size: Any = None, *_arguments: Any) -> Any:  # type: ignore[override]
        """Return the next coordinates."""
        if size is not None:
            return np.array([self.random() for _ in range(int(np.prod(size)))]).reshape(size)
        self._n_drawn += 1
        if self._n_drawn > len(self._vector):
            return float(self._fallback.random())
        # 1 is excluded, as in numpy.
        return min(float(self._vector[self._n_drawn - 1]), 1.0 - 1e-12)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:  # type: ignore[override]
        """Return numbers between two limits."""
        return low + (high - low) * self.random(size)

    def integers(self, low: int, high: int | None = None, size: Any = None) -> Any:  # type: ignore[override]
        """Return integers from a lower limit (0 without an upper one) to below the upper limit."""
        first, end = (0, low) if high is None else (low, high)
        drawn = np.floor(self.uniform(first, end, size)).astype(np.int64)
        return int(drawn) if size is None else drawn

    def choice(self, a: Any, size: Any = None, *, p: Any = None) -> Any:  # type: ignore[override]
        """Return one of several alternatives."""
        if size is not None:
            # Random scenes draw one alternative at a time.
            raise NotImplementedError(f"a choice of {size} alternatives; draw one at a time")
        options = np.arange(a) if np.ndim(a) == 0 else np.asarray(a)
        weights = np.full(len(options), 1.0 / len(options)) if p is None else np.asarray(p)
        index = int(np.searchsorted(np.cumsum(weights), self.random(), side="right"))
        return options[min(index, len(options) - 1)]

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:  # type: ignore[override]
        """Return normally distributed numbers, within five standard deviations."""
        from scipy.special import ndtri

        quantiles = np.clip(self.random(size), 3e-7, 1.0 - 3e-7)
        return loc + scale * ndtri(quantiles)
