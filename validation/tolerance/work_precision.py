# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `work-precision`: wall time against error of the product's integrators and of library solvers."""

from __future__ import annotations

import argparse
import importlib.util
import math
import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext

import attrs
import numpy as np
from scipy.integrate import solve_ivp
from support.problems import MORE_PROBLEMS, PERIOD, PROBLEMS, Problem, problem
from support.reference import Reference, RightSide, reference
from support.reference_runs import measure

from cloth_sim_ros import Plan, Scene, State
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.integrators.base import Integrator
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan import thread_limit
from validation.report import Report, Table
from validation.tolerance.sweep import MAX_RESIDUAL


class SolverTimeoutError(RuntimeError):
    """The solver exceeded its time limit."""


@attrs.frozen
class SolverRun:
    """One solution: final positions (3, n) [m], wall time [s] and force evaluations."""

    positions: Array
    seconds: float
    evaluations: int
    #: Reason of the last choice of the product's integrator.
    reason: str = ""


@attrs.frozen
class SolverSetting:
    """A method at one setting."""

    name: str
    setting: str
    #: `ours` (the product), `alone` (the product on one thread), `library`, or `beside` (in no comparison).
    kind: str
    solve: Callable[[Problem, float], SolverRun]
    #: Requested tolerance [m]; infinite for a fixed step.
    tolerance: float = math.inf


def library_solvers(*, slow: bool) -> list[SolverSetting]:
    """Return every library solver at several tolerances; `slow` adds those that take minutes."""
    solvers = []
    for method, tolerances in (
        ("RK45", (1e-2, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)),
        ("DOP853", (1e-2, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5, 1e-6, 5e-7, 2e-7, 1e-7, 1e-8)),
    ):
        solvers += [_scipy(method, tolerance) for tolerance in tolerances]
    if slow:
        solvers += [_scipy("LSODA", tolerance) for tolerance in (1e-4, 1e-7)]
    if importlib.util.find_spec("sksundae") is not None:
        adams_tolerances = (1e-2, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
        solvers += [_cvode("Adams", None, tolerance) for tolerance in adams_tolerances]
        solvers += [_cvode("BDF", "gmres", tolerance) for tolerance in (1e-5, 1e-7, 1e-9)]
    return solvers


def product_solvers(tolerances: tuple[float, ...]) -> list[SolverSetting]:
    """Return `auto` at several tolerances, with all threads and with one, and leapfrogs of fixed steps."""
    solvers = [_product_solver("auto", tolerance, single_threaded=False) for tolerance in tolerances]
    solvers += [_product_solver("auto", tolerance, single_threaded=True) for tolerance in tolerances]
    return [*solvers, *(_fixed_step_leapfrog(fraction) for fraction in (0.9, 0.45, 0.225))]


def _product_solver(name: str, tolerance: float, *, single_threaded: bool) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        plan, state = problem.build()
        with thread_limit.single_threaded() if single_threaded else nullcontext():
            return run_integrator(problem, plan, state, make_integrator(name, tolerance=tolerance))

    kind, label = ("alone", f"{name}, one thread") if single_threaded else ("ours", name)
    return SolverSetting(f"cloth_sim_ros, {label}", f"tolerance {tolerance:g}", kind, solve, tolerance)


def _fixed_step_leapfrog(limit_fraction: float) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        plan, state = problem.build()
        step = limit_fraction * make_integrator("leapfrog").step_limit(*plan.spectral_bounds(state.x))
        return run_integrator(problem, plan, state, make_integrator("leapfrog", step=step))

    return SolverSetting("plain leapfrog", f"{limit_fraction:g} of the limit", "beside", solve)


def run_integrator(problem: Problem, plan: Plan, state: State, integrator: Integrator) -> SolverRun:
    """Run a scene frame by frame, as a simulation does."""
    evaluations, reason, begin = 0, "", time.perf_counter()
    for frame in range(problem.frames):
        done = integrator.advance(plan, state, frame * PERIOD, PERIOD)
        evaluations, reason = evaluations + done.evaluations, done.reason
    return SolverRun(state.x, time.perf_counter() - begin, evaluations, reason)


def _scipy(method: str, tolerance: float) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        plan, state = problem.build()
        right = RightSide(plan)
        begin = time.perf_counter()

        def limited(t: float, y: Array) -> Array:
            if time.perf_counter() > begin + limit:
                raise SolverTimeoutError
            return right(t, y)

        span, start = (0.0, problem.duration), right.start(state)
        solved = solve_ivp(limited, span, start, method=method, rtol=tolerance, atol=tolerance)
        seconds = time.perf_counter() - begin
        return SolverRun(np.ascontiguousarray(right.positions(solved.y[:, -1])), seconds, right.calls)

    return SolverSetting(f"scipy {method}", f"rtol = atol = {tolerance:g}", "library", solve)


def _cvode(method: str, linear: str | None, tolerance: float) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        from sksundae.cvode import CVODE

        plan, state = problem.build()
        right = RightSide(plan)
        options = {"rtol": tolerance, "atol": tolerance, "linsolver": "gmres", "max_num_steps": 10**7}
        solver = CVODE(right.fill, method=method, **options)
        begin = time.perf_counter()
        solved = solver.solve(np.array([0.0, problem.duration]), right.start(state))
        seconds = time.perf_counter() - begin
        return SolverRun(np.ascontiguousarray(right.positions(solved.y[-1])), seconds, right.calls)

    name = f"CVODE {method}" + (" + GMRES" if linear else "")
    return SolverSetting(name, f"rtol = atol = {tolerance:g}", "library", solve)


#: Required speedup over the best library solver, by error [m].
MIN_SPEEDUPS = {1e-5: 10.0, 1e-7: 5.0, 1e-10: 2.5}
#: Three per decade, as dense as those of the best library solvers, so that grid spacing does not bias the comparison.
TOLERANCES = (1e-2, *(digit * 10.0**power for power in range(-4, -12, -1) for digit in (10, 5, 2)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    known = [*PROBLEMS, *MORE_PROBLEMS]
    scenes = f"one of {', '.join(known)}"
    parser.add_argument("--scene", choices=known, metavar="SCENE", default="curtain16", help=scenes)
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each solver; the median counts")
    parser.add_argument("--slow", action="store_true", help="also solvers that take minutes")
    parser.add_argument("--limit", type=float, default=60.0, metavar="SECONDS", help="time limit of a library solver")


@attrs.frozen
class SolverPoint:
    """One solver's error and times."""

    solver: SolverSetting
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
    scene_reference = reference(scene)
    solvers = [*product_solvers(TOLERANCES), *library_solvers(slow=options.slow)]
    timeouts, first_runs = [], {}
    for solver in solvers:
        try:
            # The first run warms up; it is not counted.
            first_runs[solver] = solver.solve(scene, options.limit)
        except SolverTimeoutError:
            timeouts.append(f"{solver.name} {solver.setting}: not done after {options.limit:g} s")
    times: dict[SolverSetting, list[float]] = {solver: [] for solver in first_runs}
    # Solvers alternate, so that other load on the machine affects all of them.
    for repeat in range(options.repeats):
        for solver, run_before in first_runs.items():
            if repeat == 0 or run_before.seconds < 5.0:
                # No time limit: the first run of this solver was within it.
                times[solver].append(solver.solve(scene, math.inf).seconds)
    points = []
    for solver, solver_run in first_runs.items():
        error = scene_reference.deviation(scene.frames, solver_run.positions)
        residual = _residual(solver, scene, scene_reference)
        points.append(SolverPoint(solver, error, times[solver], solver_run.evaluations, residual))
    report = Report(f"Work-precision on {scene.name}")
    reference_error = f"the reference's own error is {scene_reference.error:.1g} m"
    report.note(f"{scene.description}; errors at {scene.duration:g} s; {reference_error}")
    report.notes += timeouts
    report.note(
        f"the product may use {thread_limit.available_threads()} threads here: it computes runs of the extrapolation "
        "concurrently; library solvers use one thread, because each of their steps needs the previous one"
    )
    for point in points:
        residual, tolerance = point.residual, point.solver.tolerance
        if residual is not None and tolerance <= Scene().tolerance and not residual <= MAX_RESIDUAL:
            report.fail(f"{point.solver.name} {point.solver.setting}: energy residual {residual:.2g}")
    report.tables += [_all_runs(points), _comparison(points, report, scene.name)]
    return report


def _residual(solver: SolverSetting, scene: Problem, scene_reference: Reference) -> float | None:
    """Return the residual of the product's energy balance from an untimed run; None for other solvers."""
    if solver.kind != "ours":
        return None
    return measure(scene, scene_reference, "auto", solver.tolerance, energy=True).residual


def _all_runs(points: list[SolverPoint]) -> Table:
    columns = ["solver", "setting", "error m", "wall s", "least s", "most s", "evaluations", "energy residual"]
    table = Table("All runs", columns)
    for point in points:
        row = [point.solver.name, point.solver.setting, point.error, point.median, min(point.seconds)]
        residual = "" if point.residual is None else point.residual
        table.rows.append([*row, max(point.seconds), point.evaluations, residual])
    return table


def _comparison(points: list[SolverPoint], report: Report, scene: str) -> Table:
    columns = ["error m", "product s", "by", "one thread s", "best library s", "by library", "times"]
    table = Table("Least time to an error", [*columns, "times by one thread"])
    for error, min_speedup in MIN_SPEEDUPS.items():
        product, single_thread, library = (_fastest(points, kind, error) for kind in ("ours", "alone", "library"))
        if product is None or single_thread is None or library is None:
            report.note(f"no comparison at {error:g} m: product or library did not reach it")
            continue
        speedup = library.median / product.median
        names = [f"{point.solver.name} {point.solver.setting}" for point in (product, library)]
        row = [error, product.median, names[0], single_thread.median, library.median, names[1], speedup]
        table.rows.append([*row, library.median / single_thread.median])
        if scene in ("curtain16", "curtain32") and speedup < min_speedup:
            report.fail(f"speedup over the best library at {error:g} m is {speedup:.2g}; required: {min_speedup:g}")
    return table


def _fastest(points: list[SolverPoint], kind: str, error: float) -> SolverPoint | None:
    accurate = [point for point in points if point.solver.kind == kind and point.error <= error]
    return min(accurate, key=lambda point: point.median) if accurate else None
