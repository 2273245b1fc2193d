# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt least squares in the logarithms of the parameters.

Derivatives are central differences. The second differences measure the curvature of the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import attrs
import numpy as np

from cloth_sim_ros.batch.fit_parameters import FitError
from cloth_sim_ros.batch.fit_runs import Run, Runs
from cloth_sim_ros.physics.forces.force import Array

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Prior standard deviation of a logarithm about its start: a factor of ten. The prior bounds unidentified parameters.
#: It changes a parameter that is identified to 2.5 % by 1e-4 of the distance from its start.
EXPECTED = math.log(10.0)
#: Largest step of a logarithm: a factor of two.
LONGEST = math.log(2.0)
#: Limits of the difference steps of logarithms; between them a step is one standard deviation.
LEAST_DIFFERENCE, MOST_DIFFERENCE = 1e-3, 0.05
#: Convergence limits of a step: fraction of a standard deviation, and absolute size of a logarithm's step.
SMALL, TINY = 0.1, 1e-6
MOST_ITERATIONS = 15
#: Largest damping factor (Marquardt's lambda).
MOST_DAMPING = 1e4
#: Least standard deviation [m]: the rounding of float32 clouds.
LEAST_SIGMA = 1e-8


@attrs.define(kw_only=True)
class Linear:
    """Residuals at a point, and their first and second differences."""

    #: Logarithms of the parameters, shape (p,).
    theta: Array
    #: Residuals [m], shape (n,).
    r: Array
    #: Derivatives by the logarithms [m], shape (p, n).
    jacobian: Array
    #: Half the second difference of each, over its step [m], shape (p, n).
    bend: Array
    #: Difference steps of the logarithms, shape (p,).
    steps: Array
    #: True if the point is a least-squares minimum: the next step is at most a standard deviation of each parameter, or
    #: 0.1 %.
    settled: bool = False

    def first(self, count: int) -> Linear:
        """Return the linearization of the first `count` residuals."""
        return attrs.evolve(self, r=self.r[:count], jacobian=self.jacobian[:, :count], bend=self.bend[:, :count])


@attrs.frozen(kw_only=True)
class Problem:
    """Least-squares problem that all windows share."""

    #: Pool that computes residuals.
    runs: Runs
    #: Index of each cloud's first residual, shape (clouds + 1,).
    offsets: NDArray[np.int64]
    #: Standard deviation of a measured coordinate [m]; None to estimate it from the residuals.
    sigma: float | None
    #: Called with the number of new simulations.
    tick: Callable[[int], None]

    @property
    def start(self) -> Array:
        """Logarithms of the starting values, shape (p,)."""
        return np.log([parameter.start for parameter in self.runs.fitted])

    def ask(self, thetas: Sequence[Array], clouds: int, tolerance: float) -> list[Array | str]:
        """Return the residuals [m] of several points, or the text of an error.

        Args:
            thetas: logarithms of the parameters, shape (p,) each.
            n_clouds: number of compared clouds.
            tolerance: tolerance of the simulations [m].
        """
        made = self.runs.make(
            [Run(values=tuple(np.exp(theta).tolist()), clouds=clouds, tolerance=tolerance) for theta in thetas]
        )
        self.tick(len(thetas))
        return made

    def deviation(self, r: Array) -> float:
        """Return the standard deviation of a coordinate [m]: prescribed, or estimated from residuals."""
        if self.sigma is not None:
            return self.sigma
        freedom = max(r.size - len(self.runs.fitted), 1)
        return max(math.sqrt(float(r @ r) / freedom), LEAST_SIGMA)

    def within(self, theta: Array) -> Array:
        """Return a point clipped to the parameters' limits, shape (p,)."""
        fitted = self.runs.fitted
        least, most = np.log([p.least for p in fitted]), np.log([p.most for p in fitted])
        return np.clip(theta, least, most)

    def linear(self, theta: Array, steps: Array, clouds: int, tolerance: float, r: Array | None = None) -> Linear:
        """Return residuals and central differences at a point.

        Args:
            theta: logarithms of the parameters, shape (p,).
            steps: difference steps, shape (p,).
            n_clouds: number of compared clouds.
            tolerance: tolerance of the simulations [m].
            r: residuals at the point [m], if they are known.

        Raises:
            FitError: if a simulation at a neighbouring point fails.
        """
        count = len(theta)
        points = [theta + sign * steps * (np.arange(count) == i) for i in range(count) for sign in (1.0, -1.0)]
        made = self.ask(points if r is not None else [*points, theta], clouds, tolerance)
        for one in made:
            if isinstance(one, str):
                raise FitError(f"near {_values(self, theta)} the motion can't be simulated: {one}")
        whole = [one for one in made if not isinstance(one, str)]
        here = whole.pop() if r is None else r
        up, down = np.array(whole[0::2]), np.array(whole[1::2])
        return Linear(
            theta=theta,
            r=here,
            jacobian=(up - down) / (2.0 * steps[:, None]),
            bend=(up + down) / 2.0 - here,
            steps=steps,
        )


def information(linear: Linear, sigma: float) -> Array:
    """Return Fisher's information matrix of the logarithms, J J' / sigma^2, shape (p, p)."""
    return np.asarray(linear.jacobian @ linear.jacobian.T / sigma**2)


def deviations(fisher: Array) -> Array:
    """Return the Cramér-Rao bound of each logarithm's standard deviation, shape (p,); infinite if undetermined."""
    values, vectors = np.linalg.eigh(fisher)
    told = values > 1e-12 * max(float(values[-1]), 1e-300)
    variances = np.where(told, 1.0 / np.where(told, values, 1.0), np.inf)
    weights = vectors**2
    # Rounding gives each parameter a small component of every direction.
    weights[weights < 1e-10] = 0.0
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.nansum(weights * variances, axis=1)))


def difference_steps(fisher: Array) -> Array:
    """Return difference steps of the logarithms: their standard deviations, within limits, shape (p,)."""
    known = fisher + np.eye(len(fisher)) / EXPECTED**2
    return np.clip(np.sqrt(np.diag(np.linalg.inv(known))), LEAST_DIFFERENCE, MOST_DIFFERENCE)


def descend(problem: Problem, linear: Linear, clouds: int, tolerance: float) -> Linear:
    """Return the linearization at the least-squares minimum of a window.

    Args:
        problem: the least-squares problem.
        linearization: linearization at a point near the minimum.
        n_clouds: number of compared clouds.
        tolerance: tolerance of the simulations [m].
    """
    damping, expected = 1e-3, 1.0 / EXPECTED**2
    identity = np.eye(len(linear.theta))
    for iteration in range(MOST_ITERATIONS + 1):
        sigma = problem.deviation(linear.r)
        fisher = information(linear, sigma)
        slope = linear.jacobian @ linear.r / sigma**2 + expected * (linear.theta - problem.start)
        matrix = fisher + expected * identity
        newton = _step(matrix, slope)
        unknown = np.sqrt(np.diag(np.linalg.inv(matrix)))
        # A parameter at its limit stays there.
        possible = problem.within(linear.theta + newton) - linear.theta
        linear.settled = bool(np.all(np.abs(possible) <= np.maximum(unknown, LEAST_DIFFERENCE)))
        if np.all(np.abs(newton) <= np.maximum(SMALL * unknown, TINY)) or iteration == MOST_ITERATIONS:
            return linear
        better = None
        while better is None and damping < MOST_DAMPING:
            # Two damping factors are tried in parallel, in case the first one fails.
            factors = (damping, 30.0 * damping)
            weights = [matrix + factor * np.diag(np.diag(matrix)) for factor in factors]
            points = [problem.within(linear.theta + _step(one, slope)) for one in weights]
            made = problem.ask(points, clouds, tolerance)
            now = _cost(problem, linear.theta, linear.r, sigma)
            costs = [
                math.inf if isinstance(r, str) else _cost(problem, x, r, sigma)
                for x, r in zip(points, made, strict=True)
            ]
            best = int(np.argmin(costs))
            if costs[best] < now:
                better, damping = (points[best], made[best]), max(factors[best] / 10.0, 1e-6)
            else:
                damping = 30.0 * factors[1]
        if better is None or isinstance(better[1], str):
            return linear
        linear = problem.linear(better[0], difference_steps(fisher), clouds, tolerance, better[1])
    return linear


def _step(matrix: Array, slope: Array) -> Array:
    """Return the Newton step for a gradient, limited to `MAX_LOG_STEP`."""
    step = np.asarray(-np.linalg.solve(matrix, slope), dtype=np.float64)
    longest = float(np.abs(step).max())
    return step if longest <= LONGEST else step * (LONGEST / longest)


def _cost(problem: Problem, theta: Array, r: Array, sigma: float) -> float:
    away = (theta - problem.start) / EXPECTED
    return float(r @ r) / sigma**2 + float(away @ away)


def _values(problem: Problem, theta: Array) -> str:
    pairs = zip(problem.runs.fitted, np.exp(theta), strict=True)
    return ", ".join(f"{parameter.name} = {value:.3g}" for parameter, value in pairs)
