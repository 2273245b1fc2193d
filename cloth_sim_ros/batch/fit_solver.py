# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Least squares over a window: Gauss-Newton steps in the parameters' logarithms, damped as Levenberg and Marquardt do.

Derivatives are central differences; their second differences say how straight the residuals are.
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

#: A parameter is expected within a factor of ten of its start (one standard deviation of its logarithm). It keeps
#: what the clouds don't tell from running away, and pulls on what they tell to 2.5 % by 1e-4 of the distance.
EXPECTED = math.log(10.0)
#: Longest step of a logarithm: a factor of two.
LONGEST = math.log(2.0)
#: Difference steps of logarithms lie between these; in between they are one standard deviation.
LEAST_DIFFERENCE, MOST_DIFFERENCE = 1e-3, 0.05
#: A step of this part of every standard deviation is none, nor is one of this relative size.
SMALL, TINY = 0.1, 1e-6
MOST_ITERATIONS = 15
#: Damping of steps (Marquardt's factor) with which none is tried any more.
MOST_DAMPING = 1e4
#: Rounding of float32 clouds [m]: no deviation is taken for less.
LEAST_SIGMA = 1e-8


@attrs.define(kw_only=True)
class Linear:
    """Residuals about a point, and their first and second differences."""

    #: Logarithms of the parameters, shape (p,).
    theta: Array
    #: Residuals [m], shape (n,).
    r: Array
    #: Derivatives by the logarithms [m], shape (p, n).
    jacobian: Array
    #: Half the second difference of each, over its step [m], shape (p, n).
    bend: Array
    #: The difference steps, shape (p,).
    steps: Array
    #: Whether the point is a least square: the next step is at most a standard deviation of each parameter, or 0.1 %.
    settled: bool = False

    def first(self, count: int) -> Linear:
        """Return it for the first so many residuals."""
        return attrs.evolve(self, r=self.r[:count], jacobian=self.jacobian[:, :count], bend=self.bend[:, :count])


@attrs.frozen(kw_only=True)
class Problem:
    """What all windows have in common."""

    runs: Runs
    #: Where each cloud's residuals begin, shape (clouds + 1,).
    offsets: NDArray[np.int64]
    #: Deviation of a measured coordinate [m]; None: that of the residuals.
    sigma: float | None
    #: Told once a run is made.
    tick: Callable[[int], None]

    @property
    def start(self) -> Array:
        """Logarithms of the starting values."""
        return np.log([parameter.start for parameter in self.runs.fitted])

    def ask(self, thetas: Sequence[Array], clouds: int, tolerance: float) -> list[Array | str]:
        """Return residuals for several points, or why there are none."""
        made = self.runs.make(
            [Run(values=tuple(np.exp(theta).tolist()), clouds=clouds, tolerance=tolerance) for theta in thetas]
        )
        self.tick(len(thetas))
        return made

    def deviation(self, r: Array) -> float:
        """Return the deviation of a coordinate [m]: as given, or that of some residuals."""
        if self.sigma is not None:
            return self.sigma
        freedom = max(r.size - len(self.runs.fitted), 1)
        return max(math.sqrt(float(r @ r) / freedom), LEAST_SIGMA)

    def within(self, theta: Array) -> Array:
        """Return a point moved into the parameters' limits."""
        fitted = self.runs.fitted
        least, most = np.log([p.least for p in fitted]), np.log([p.most for p in fitted])
        return np.clip(theta, least, most)

    def linear(self, theta: Array, steps: Array, clouds: int, tolerance: float, r: Array | None = None) -> Linear:
        """Return residuals and differences about a point; `r` where they are known there.

        Raises:
            FitError: where a run beside the point can't be made.
        """
        count = len(theta)
        points = [theta + sign * steps * (np.arange(count) == i) for i in range(count) for sign in (1.0, -1.0)]
        made = self.ask(points if r is not None else [*points, theta], clouds, tolerance)
        for one in made:
            if isinstance(one, str):
                raise FitError(f"beside {_values(self, theta)} the motion can't be simulated: {one}")
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
    """Return Fisher's matrix of the logarithms, shape (p, p): J J' / sigma^2."""
    return np.asarray(linear.jacobian @ linear.jacobian.T / sigma**2)


def deviations(fisher: Array) -> Array:
    """Return the least standard deviation of each logarithm (the Cramér-Rao bound), infinite where nothing is told."""
    values, vectors = np.linalg.eigh(fisher)
    told = values > 1e-12 * max(float(values[-1]), 1e-300)
    variances = np.where(told, 1.0 / np.where(told, values, 1.0), np.inf)
    weights = vectors**2
    # Rounding leaves a trace of every direction in every parameter.
    weights[weights < 1e-10] = 0.0
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.nansum(weights * variances, axis=1)))


def difference_steps(fisher: Array) -> Array:
    """Return difference steps of the logarithms: what is not known of them, within limits."""
    known = fisher + np.eye(len(fisher)) / EXPECTED**2
    return np.clip(np.sqrt(np.diag(np.linalg.inv(known))), LEAST_DIFFERENCE, MOST_DIFFERENCE)


def descend(problem: Problem, linear: Linear, clouds: int, tolerance: float) -> Linear:
    """Return the differences at the least squares of a window, from those at a point near it."""
    damping, expected = 1e-3, 1.0 / EXPECTED**2
    identity = np.eye(len(linear.theta))
    for iteration in range(MOST_ITERATIONS + 1):
        sigma = problem.deviation(linear.r)
        fisher = information(linear, sigma)
        slope = linear.jacobian @ linear.r / sigma**2 + expected * (linear.theta - problem.start)
        matrix = fisher + expected * identity
        newton = _step(matrix, slope)
        unknown = np.sqrt(np.diag(np.linalg.inv(matrix)))
        # A parameter at the end of its range goes no further.
        possible = problem.within(linear.theta + newton) - linear.theta
        linear.settled = bool(np.all(np.abs(possible) <= np.maximum(unknown, LEAST_DIFFERENCE)))
        if np.all(np.abs(newton) <= np.maximum(SMALL * unknown, TINY)) or iteration == MOST_ITERATIONS:
            return linear
        better = None
        while better is None and damping < MOST_DAMPING:
            # Two at a time: the second is there when the first fails.
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
    """The step down a slope, shortened to `LONGEST`."""
    step = np.asarray(-np.linalg.solve(matrix, slope), dtype=np.float64)
    longest = float(np.abs(step).max())
    return step if longest <= LONGEST else step * (LONGEST / longest)


def _cost(problem: Problem, theta: Array, r: Array, sigma: float) -> float:
    away = (theta - problem.start) / EXPECTED
    return float(r @ r) / sigma**2 + float(away @ away)


def _values(problem: Problem, theta: Array) -> str:
    pairs = zip(problem.runs.fitted, np.exp(theta), strict=True)
    return ", ".join(f"{parameter.name} = {value:.3g}" for parameter, value in pairs)
