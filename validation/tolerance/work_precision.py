# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `work-precision`: wall time against error of product and library solvers."""

from __future__ import annotations

import argparse
import math
import statistics

import attrs
from support.problems import MORE_PROBLEMS, PROBLEMS, Problem, problem
from support.reference import Reference, reference
from support.reference_runs import measure

from cloth_sim_ros.physics import thread_limit
from cloth_sim_ros.scene.scene import Scene
from validation.report import Plot, Report, Table
from validation.tolerance.baselines import Solver, TooSlow, library_solvers, our_solvers
from validation.tolerance.sweep import LARGEST_RESIDUAL

#: Required speedup over the best library solver, by error [m].
PROMISES = {1e-5: 10.0, 1e-7: 5.0, 1e-10: 2.5}
#: Three per decade, as dense as those of the best library solvers, so that grid spacing does not bias the comparison.
TOLERANCES = (1e-2, *(digit * 10.0**power for power in range(-4, -12, -1) for digit in (10, 5, 2)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    known = [*PROBLEMS, *MORE_PROBLEMS]
    parser.add_argument(
        "--scene", choices=known, metavar="SCENE", default="curtain16", help=f"one of {', '.join(known)}"
    )
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each solver; the median counts")
    parser.add_argument("--slow", action="store_true", help="also solvers that take minutes")
    parser.add_argument("--limit", type=float, default=60.0, metavar="SECONDS", help="time limit of a library solver")


@attrs.frozen
class Point:
    """One solver's error and times."""

    solver: Solver
    error: float
    seconds: list[float]
    evaluations: int
    #: Residual of the energy balance over the energy turned over; None for a library's solver.
    residual: float | None

    @property
    def median(self) -> float:
        """Median time [s]."""
        return statistics.median(self.seconds)


def run(options: argparse.Namespace) -> Report:
    """Measure one scene."""
    scene = problem(options.scene)
    known = reference(scene)
    solvers = [*our_solvers(TOLERANCES), *library_solvers(slow=options.slow)]
    given_up, first = [], {}
    for solver in solvers:
        try:
            # The first run warms up; it is not counted.
            first[solver] = solver.solve(scene, options.limit)
        except TooSlow:
            given_up.append(f"{solver.name} {solver.setting}: not done after {options.limit:g} s")
    times: dict[Solver, list[float]] = {solver: [] for solver in first}
    # Solvers alternate, so that other load on the machine affects all of them.
    for repeat in range(options.repeats):
        for solver, run_before in first.items():
            if repeat == 0 or run_before.seconds < 5.0:
                # No time limit: the first run of this solver was within it.
                times[solver].append(solver.solve(scene, math.inf).seconds)
    points = [
        Point(
            solver,
            known.deviation(scene.frames, done.positions),
            times[solver],
            done.evaluations,
            _residual(solver, scene, known),
        )
        for solver, done in first.items()
    ]
    report = Report(f"Work-precision on {scene.name}", f"python -m validation work-precision --scene {scene.name}")
    report.notes.append(
        f"{scene.description}; errors at {scene.duration:g} s; the reference's own error is {known.error:.1g} m"
    )
    report.notes += given_up
    report.notes.append(
        f"the product may use {thread_limit.available_threads()} threads here: it computes runs of the extrapolation "
        "concurrently; library solvers use one thread, because each of their steps needs the previous one"
    )
    for point in points:
        open_by, asked = point.residual, point.solver.tolerance
        if open_by is not None and asked <= Scene().tolerance and not open_by <= LARGEST_RESIDUAL:
            report.failures.append(f"{point.solver.name} {point.solver.setting}: energy residual {open_by:.2g}")
    report.tables += [_everything(points), _comparison(points, report, scene.name)]
    lines: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        lines.setdefault(point.solver.name, []).append((point.error, point.median))
    report.plots.append(Plot(f"Work-precision {scene.name}", "position error [m]", "wall time [s]", lines))
    return report


def _residual(solver: Solver, scene: Problem, known: Reference) -> float | None:
    """Return the residual of the product's energy balance from an untimed run; None for other solvers."""
    if solver.kind != "ours":
        return None
    return measure(scene, known, "auto", solver.tolerance, energy=True).residual


def _everything(points: list[Point]) -> Table:
    table = Table(
        "All runs", ["solver", "setting", "error m", "wall s", "least s", "most s", "evaluations", "energy residual"]
    )
    for point in points:
        row = [point.solver.name, point.solver.setting, point.error, point.median]
        table.rows.append([*row, min(point.seconds), max(point.seconds), point.evaluations])
        table.rows[-1].append("" if point.residual is None else point.residual)
    return table


def _comparison(points: list[Point], report: Report, scene: str) -> Table:
    table = Table(
        "Least time to an error",
        ["error m", "ours s", "by", "one thread s", "best library s", "by library", "times", "times by one thread"],
    )
    for error, promise in PROMISES.items():
        ours = _least(points, "ours", error)
        alone = _least(points, "alone", error)
        theirs = _least(points, "library", error)
        if ours is None or alone is None or theirs is None:
            report.notes.append(f"no comparison at {error:g} m: product or library did not reach it")
            continue
        times = theirs.median / ours.median
        names = [f"{point.solver.name} {point.solver.setting}" for point in (ours, theirs)]
        table.rows.append([error, ours.median, names[0], alone.median, theirs.median, names[1], times])
        table.rows[-1].append(theirs.median / alone.median)
        if scene in ("curtain16", "curtain32") and times < promise:
            report.failures.append(
                f"speedup over the best library at {error:g} m is {times:.2g}; required: {promise:g}"
            )
    return table


def _least(points: list[Point], kind: str, error: float) -> Point | None:
    good = [point for point in points if point.solver.kind == kind and point.error <= error]
    return min(good, key=lambda point: point.median) if good else None
