# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Common interface to library solvers and the product's integrators."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable
from contextlib import nullcontext

import attrs
import numpy as np
from scipy.integrate import solve_ivp
from support.problems import PERIOD, Problem
from support.reference import RightSide

from cloth_sim_ros import Plan, State
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.integrators.base import Integrator
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan import thread_limit


class SolverTimeoutError(RuntimeError):
    """The solver exceeded its time limit."""


@attrs.frozen
class SolverRun:
    """One solution: final positions (3, n) [m], wall time [s] and force evaluations."""

    positions: Array
    seconds: float
    evaluations: int


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
            return _advance(problem, plan, state, make_integrator(name, tolerance=tolerance))

    kind, label = ("alone", f"{name}, one thread") if single_threaded else ("ours", name)
    return SolverSetting(f"cloth_sim_ros, {label}", f"tolerance {tolerance:g}", kind, solve, tolerance)


def _fixed_step_leapfrog(limit_fraction: float) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        plan, state = problem.build()
        step = limit_fraction * make_integrator("leapfrog").step_limit(*plan.spectral_bounds(state.x))
        return _advance(problem, plan, state, make_integrator("leapfrog", step=step))

    return SolverSetting("plain leapfrog", f"{limit_fraction:g} of the limit", "beside", solve)


def _advance(problem: Problem, plan: Plan, state: State, integrator: Integrator) -> SolverRun:
    evaluations, begin = 0, time.perf_counter()
    for frame in range(problem.frames):
        evaluations += integrator.advance(plan, state, frame * PERIOD, PERIOD).evaluations
    return SolverRun(state.x, time.perf_counter() - begin, evaluations)


def _scipy(method: str, tolerance: float) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        plan, state = problem.build()
        right = _Limited(RightSide(plan), limit)
        begin = time.perf_counter()
        span, start = (0.0, problem.duration), right.inner.start(state)
        solved = solve_ivp(right, span, start, method=method, rtol=tolerance, atol=tolerance)
        seconds = time.perf_counter() - begin
        return SolverRun(np.ascontiguousarray(right.inner.positions(solved.y[:, -1])), seconds, right.inner.calls)

    return SolverSetting(f"scipy {method}", f"rtol = atol = {tolerance:g}", "library", solve)


def _cvode(method: str, linear: str | None, tolerance: float) -> SolverSetting:
    def solve(problem: Problem, limit: float) -> SolverRun:
        from sksundae.cvode import CVODE

        plan, state = problem.build()
        right = RightSide(plan)
        options = {"linsolver": linear} if linear else {"linsolver": "gmres"}
        solver = CVODE(right.fill, method=method, rtol=tolerance, atol=tolerance, max_num_steps=10**7, **options)
        begin = time.perf_counter()
        solved = solver.solve(np.array([0.0, problem.duration]), right.start(state))
        seconds = time.perf_counter() - begin
        return SolverRun(np.ascontiguousarray(right.positions(solved.y[-1])), seconds, right.calls)

    name = f"CVODE {method}" + (" + GMRES" if linear else "")
    return SolverSetting(name, f"rtol = atol = {tolerance:g}", "library", solve)


class _Limited:
    """Right-hand side that raises `SolverTimeoutError` after a time limit [s]."""

    def __init__(self, inner: RightSide, limit: float) -> None:
        self.inner = inner
        self._end = time.perf_counter() + limit

    def __call__(self, t: float, y: Array) -> Array:
        if time.perf_counter() > self._end:
            raise SolverTimeoutError
        return self.inner(t, y)
