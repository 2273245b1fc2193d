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

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.runs import FitRun, FitRunPool
from cloth_sim_ros.physics.model.forces.force import Array

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Prior standard deviation of a logarithm about its start: a factor of ten. The prior bounds unidentified parameters.
#: It changes a parameter that is identified to 2.5 % by 1e-4 of the distance from its start.
PRIOR_SIGMA = math.log(10.0)
#: Largest step of a logarithm: a factor of two.
MAX_LOG_STEP = math.log(2.0)
#: Limits of the difference steps of logarithms; between them a step is one standard deviation.
MIN_DIFFERENCE, MAX_DIFFERENCE = 1e-3, 0.05
#: Convergence limits of a step: fraction of a standard deviation, and absolute size of a logarithm's step.
CONVERGED_FRACTION, CONVERGED_STEP = 0.1, 1e-6
MAX_ITERATIONS = 15
#: Largest damping factor (Marquardt's lambda).
MAX_DAMPING = 1e4
#: Least standard deviation [m]: the rounding of float32 clouds.
MIN_SIGMA = 1e-8


@attrs.define(kw_only=True)
class Linearization:
    """Residuals r (n,) and their first and second differences (p, n) by the parameters' logarithms, at one point."""

    #: Logarithms of the parameters, shape (p,).
    theta: Array
    #: Residuals [m], shape (n,).
    r: Array
    #: Derivatives by the logarithms [m], shape (p, n).
    jacobian: Array
    #: Half the second difference of each, over its step [m], shape (p, n).
    curvature: Array
    #: Difference steps of the logarithms, shape (p,).
    steps: Array
    #: True if the point is a least-squares minimum: the next step is at most a standard deviation of each parameter, or
    #: 0.1 %.
    is_converged: bool = False

    def truncate(self, count: int) -> Linearization:
        """Return the linearization of the first `count` residuals."""
        return attrs.evolve(
            self, r=self.r[:count], jacobian=self.jacobian[:, :count], curvature=self.curvature[:, :count]
        )


@attrs.frozen(kw_only=True)
class FitProblem:
    """Least-squares problem of one recording, shared by windows that use its first clouds."""

    #: Pool that computes residuals.
    pool: FitRunPool
    #: Index of each cloud's first residual, shape (clouds + 1,).
    offsets: NDArray[np.int64]
    #: Standard deviation of a measured coordinate [m]; None to estimate it from the residuals.
    sigma: float | None
    #: Called with the number of new simulations.
    on_progress: Callable[[int], None]

    @property
    def start(self) -> Array:
        """Logarithms of the starting values, shape (p,)."""
        return np.log([parameter.start for parameter in self.pool.parameters])

    def evaluate(self, thetas: Sequence[Array], n_clouds: int, tolerance: float) -> list[Array | str]:
        """Simulate several points (parameters' logarithms) in parallel; return residuals [m] or texts of errors.

        Args:
            thetas: logarithms of the parameters, shape (p,) each.
            n_clouds: number of compared clouds.
            tolerance: tolerance of the simulations [m].
        """
        values = [tuple(np.exp(theta).tolist()) for theta in thetas]
        runs = [FitRun(values=point, n_clouds=n_clouds, tolerance=tolerance) for point in values]
        results = self.pool.compute_residuals(runs)
        self.on_progress(len(thetas))
        return results

    def deviation(self, r: Array) -> float:
        """Return the standard deviation of a measured coordinate [m]: prescribed, or estimated from residuals."""
        if self.sigma is not None:
            return self.sigma
        n_free = max(r.size - len(self.pool.parameters), 1)
        return max(math.sqrt(float(r @ r) / n_free), MIN_SIGMA)

    def clamp(self, theta: Array) -> Array:
        """Return the parameters' logarithms clamped to their limits, shape (p,)."""
        parameters = self.pool.parameters
        lower, upper = np.log([p.minimum for p in parameters]), np.log([p.maximum for p in parameters])
        return np.clip(theta, lower, upper)

    def linearize(
        self, theta: Array, steps: Array, n_clouds: int, tolerance: float, r: Array | None = None
    ) -> Linearization:
        """Return residuals and central differences at `theta`, from simulations around it. Raises FitError.

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
        results = self.evaluate(points if r is not None else [*points, theta], n_clouds, tolerance)
        for result in results:
            if isinstance(result, str):
                raise FitError(f"near {_format_values(self, theta)} the motion can't be simulated: {result}")
        residuals = [result for result in results if not isinstance(result, str)]
        centre = residuals.pop() if r is None else r
        up, down = np.array(residuals[0::2]), np.array(residuals[1::2])
        jacobian, curvature = (up - down) / (2.0 * steps[:, None]), (up + down) / 2.0 - centre
        return Linearization(theta=theta, r=centre, jacobian=jacobian, curvature=curvature, steps=steps)


def fisher_information(linearization: Linearization, sigma: float) -> Array:
    """Return Fisher's information matrix of the parameters' logarithms, J J' / sigma^2, shape (p, p)."""
    return np.asarray(linearization.jacobian @ linearization.jacobian.T / sigma**2)


def standard_deviations(fisher: Array) -> Array:
    """Return the Cramér-Rao bound of each logarithm's standard deviation, shape (p,); infinite if undetermined."""
    values, vectors = np.linalg.eigh(fisher)
    is_known = values > 1e-12 * max(float(values[-1]), 1e-300)
    variances = np.where(is_known, 1.0 / np.where(is_known, values, 1.0), np.inf)
    weights = vectors**2
    # Rounding gives each parameter a small component of every direction.
    weights[weights < 1e-10] = 0.0
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.nansum(weights * variances, axis=1)))


def difference_steps(fisher: Array) -> Array:
    """Return steps for differences by the logarithms: the standard deviations within limits, shape (p,)."""
    known = fisher + np.eye(len(fisher)) / PRIOR_SIGMA**2
    return np.clip(np.sqrt(np.diag(np.linalg.inv(known))), MIN_DIFFERENCE, MAX_DIFFERENCE)


def minimize(problem: FitProblem, linearization: Linearization, n_clouds: int, tolerance: float) -> Linearization:
    """Minimize the first clouds' residuals by Levenberg-Marquardt; return the last linearization. Raises FitError.

    Its `is_converged` tells if it is the minimum: the search also ends without a lower cost, or after some iterations.

    Args:
        problem: the least-squares problem.
        linearization: linearization at a point near the minimum.
        n_clouds: number of compared clouds.
        tolerance: tolerance of the simulations [m].
    """
    damping, prior_weight = 1e-3, 1.0 / PRIOR_SIGMA**2
    identity = np.eye(len(linearization.theta))
    for iteration in range(MAX_ITERATIONS + 1):
        sigma = problem.deviation(linearization.r)
        fisher = fisher_information(linearization, sigma)
        prior_gradient = prior_weight * (linearization.theta - problem.start)
        gradient = linearization.jacobian @ linearization.r / sigma**2 + prior_gradient
        matrix = fisher + prior_weight * identity
        newton = _step(matrix, gradient)
        sigmas = np.sqrt(np.diag(np.linalg.inv(matrix)))
        # A parameter at its limit stays there.
        clamped_step = problem.clamp(linearization.theta + newton) - linearization.theta
        linearization.is_converged = bool(np.all(np.abs(clamped_step) <= np.maximum(sigmas, MIN_DIFFERENCE)))
        is_small = np.all(np.abs(newton) <= np.maximum(CONVERGED_FRACTION * sigmas, CONVERGED_STEP))
        if is_small or iteration == MAX_ITERATIONS:
            return linearization
        better = None
        while better is None and damping < MAX_DAMPING:
            # Two damping factors are tried in parallel, in case the first one fails.
            factors = (damping, 30.0 * damping)
            weights = [matrix + factor * np.diag(np.diag(matrix)) for factor in factors]
            points = [problem.clamp(linearization.theta + _step(damped, gradient)) for damped in weights]
            results = problem.evaluate(points, n_clouds, tolerance)
            current_cost = _cost(problem, linearization.theta, linearization.r, sigma)
            pairs = zip(points, results, strict=True)
            costs = [math.inf if isinstance(r, str) else _cost(problem, x, r, sigma) for x, r in pairs]
            best = int(np.argmin(costs))
            if costs[best] < current_cost:
                better, damping = (points[best], results[best]), max(factors[best] / 10.0, 1e-6)
            else:
                damping = 30.0 * factors[1]
        if better is None or isinstance(better[1], str):
            return linearization
        linearization = problem.linearize(better[0], difference_steps(fisher), n_clouds, tolerance, better[1])
    return linearization


def _step(matrix: Array, gradient: Array) -> Array:
    """Return the Newton step of the logarithms, scaled so that none changes by more than `MAX_LOG_STEP`."""
    step = np.asarray(-np.linalg.solve(matrix, gradient), dtype=np.float64)
    max_change = float(np.abs(step).max())
    return step if max_change <= MAX_LOG_STEP else step * (MAX_LOG_STEP / max_change)


def _cost(problem: FitProblem, theta: Array, r: Array, sigma: float) -> float:
    distance = (theta - problem.start) / PRIOR_SIGMA
    return float(r @ r) / sigma**2 + float(distance @ distance)


def _format_values(problem: FitProblem, theta: Array) -> str:
    pairs = zip(problem.pool.parameters, np.exp(theta), strict=True)
    return ", ".join(f"{parameter.name} = {value:.3g}" for parameter, value in pairs)
