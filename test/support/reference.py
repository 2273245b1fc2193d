# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reference solutions: closed forms, or an independent integrator far below the errors compared and checked itself."""

from __future__ import annotations

import contextlib
import importlib.util

import attrs
import numpy as np
from scipy.integrate import solve_ivp

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.state import State
from support.problems import PERIOD, Problem
from support.right_side import IndependentRightSide

#: Relative and absolute tolerance of the reference, and of the run that it is checked against.
TOLERANCE, CHECK = 1e-12, 1e-11


@attrs.frozen(eq=False)
class Reference:
    """Positions at frames, and how far they may be off."""

    #: Times of the frames [s].
    times: Array
    #: Positions [m], shape (frames, 3, n).
    positions: Array
    #: Largest deviation of the check from it [m]; 0 for a closed form.
    error: float

    def deviation(self, frame: int, x: Array) -> float:
        """Largest distance of a particle (3, n) from its place at the end of frame 1, 2, ... [m]."""
        return largest_distance(np.ascontiguousarray(x), self.positions[frame - 1])


class RightSide:
    """The equations of motion as a first-order system y = (x, v), for the solvers of libraries."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._half = 3 * plan.model.particle_count
        self.calls = 0

    def __call__(self, t: float, y: Array) -> Array:
        out = np.empty_like(y)
        self.fill(t, y, out)
        return out

    def fill(self, t: float, y: Array, out: Array) -> None:
        """Set out to dy/dt."""
        self.calls += 1
        half = self._half
        out[:half] = y[half:]
        self._plan.accelerations(
            t, y[:half].reshape(3, -1), y[half:].reshape(3, -1), out[half:].reshape(3, -1), memory={}
        )

    def start(self, state: State) -> Array:
        """The state as y."""
        return np.concatenate([state.x.ravel(), state.v.ravel()])

    def positions(self, y: Array) -> Array:
        """The positions (3, n) of y."""
        return y[: self._half].reshape(3, -1)


def reference(problem: Problem, *, tolerance: float = TOLERANCE, check: float = CHECK) -> Reference:
    """Compute a problem's reference at the end of every frame.

    Args:
        problem: the scene.
        tolerance: relative and absolute tolerance of the solver.
        check: that of the run that it is compared with; what they differ by is the reference's own error.
    """
    times: Array = np.arange(1, problem.frames + 1, dtype=np.float64) * PERIOD
    if problem.exact is not None:
        return Reference(times, np.stack([problem.exact(t) for t in times]), 0.0)
    with _one_blas_thread():
        fine = _solve(problem, times, tolerance)
        rough = _solve(problem, times, check)
    error = max(largest_distance(a, b) for a, b in zip(fine, rough, strict=True))
    return Reference(times, fine, error)


def _one_blas_thread() -> contextlib.AbstractContextManager[object]:
    """Threads of a product of a matrix with a handful of rows wait more than they work."""
    if importlib.util.find_spec("threadpoolctl") is None:
        return contextlib.nullcontext()
    from threadpoolctl import threadpool_limits

    limits: contextlib.AbstractContextManager[object] = threadpool_limits(1, "blas")
    return limits


def _solve(problem: Problem, times: Array, tolerance: float) -> Array:
    plan, state = problem.build()
    # Not the engine's forces: an error in those shall show.
    right = IndependentRightSide(plan.model)
    y, t, positions = np.concatenate([state.x.ravel(), state.v.ravel()]), 0.0, []
    for end in times:
        # Frame by frame: dense output would be less accurate than the steps.
        solved = solve_ivp(right, (t, end), y, method="DOP853", rtol=tolerance, atol=tolerance)
        y, t = solved.y[:, -1].copy(), end
        positions.append(y[: y.size // 2].reshape(3, -1).copy())
    return np.stack(positions)
