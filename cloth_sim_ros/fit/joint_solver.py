# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Search for the minimum of a joint problem: Gauss-Newton with a line search, and alignments of given motions."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.fit.alignment import search_alignment
from cloth_sim_ros.fit.joint import Derivatives, JointProblem, NormalEquations, Point
from cloth_sim_ros.fit.noise import NoiseModel
from cloth_sim_ros.fit.solver import MAX_LOG_STEP
from cloth_sim_ros.fit.windows import MAX_CURVATURE
from cloth_sim_ros.physics.model.forces.force import Array

#: Largest number of reductions of a step that does not lower the loss, and the factor of each.
_MAX_REDUCTIONS, _REDUCTION = 4, 0.35
#: Converged step [standard deviations], and of a logarithm.
_CONVERGED_FRACTION, _CONVERGED_STEP = 0.1, 1e-5
#: Least number of recordings whose scatter gives standard deviations.
_MIN_SCATTERED = 5


@attrs.define(kw_only=True, eq=False)
class JointSolution:
    """Minimum that a search has found: point, derivatives, noise model and normal equations."""

    point: Point
    derivatives: Derivatives
    noise: NoiseModel
    equations: NormalEquations
    is_converged: bool


def solve_joint(
    problem: JointProblem,
    point: Point,
    selected: Sequence[int],
    *,
    noise: NoiseModel,
    tolerance: float,
    max_iterations: int,
    steps: Array,
    central: bool = False,
    derivatives: Derivatives | None = None,
    previous: Derivatives | None = None,
    chord: bool = False,
    converged_fraction: float = _CONVERGED_FRACTION,
) -> JointSolution:
    """Minimize the loss from a point on, by Gauss-Newton and line search; return the solution. Raises FitError.

    Args:
        problem: recordings and unknowns.
        point: start of the search.
        selected: indices of the compared recordings.
        noise: noise model; without `chord` it is estimated again in each iteration.
        tolerance: tolerance of the simulations [m].
        max_iterations: largest number of steps.
        steps: difference steps of the logarithms, shape (p,).
        central: true for central differences.
        derivatives: derivatives at the start, in place of differences.
        previous: derivatives by other simulations near the start.
        chord: true to use the derivatives and the noise model of the start in all iterations.
        converged_fraction: step that counts as converged [standard deviations].

    Raises:
        FitError: if a simulation near the result fails.
    """
    # All simulations of this search settle from the same rest states, else differences would contain their change.
    problem.replace_rest_states(point, selected)
    start = problem.evaluate(point.theta, point.eta, selected, tolerance)
    point = point if isinstance(start, str) else start
    if derivatives is None:
        derivatives = problem.differentiate(point, selected, steps, tolerance, central=central)
        if previous is not None:
            derivatives.other_slopes = previous.slopes
    p, is_converged = len(point.theta), False
    for iteration in range(max_iterations + 1):
        if not chord:
            noise = problem.update_noise(noise, point, selected)
        equations = problem.normal_equations(point, derivatives, selected, noise)
        prior_information, prior_gradient = problem.prior(point)
        matrix = equations.information.sum(axis=0) + np.diag(prior_information)
        gradient = equations.gradient.sum(axis=0) + prior_gradient
        step = _limited_step(matrix, gradient, p)
        sigmas = scatter_deviations(matrix, equations.gradient)[:p]
        distance = np.abs(problem.clamp(point.theta + step[:p]) - point.theta)
        is_converged = bool(np.all(distance <= np.maximum(converged_fraction * sigmas, _CONVERGED_STEP)))
        if is_converged or iteration == max_iterations:
            break
        fixed = (derivatives, matrix, equations.weights) if chord else None
        moved = _line_search(problem, point, selected, noise, tolerance, step, fixed)
        if moved is None:
            # Short waves make the loss rough: a step within the deviations may find no lower one.
            is_converged = bool(np.all(distance <= np.maximum(sigmas, _CONVERGED_STEP)))
            break
        point = moved
        if not chord:
            # From afar, derivatives that are only corrected by the steps (Broyden) end in another valley.
            derivatives = problem.differentiate(point, selected, steps, tolerance, central=central)
    return JointSolution(
        point=point, derivatives=derivatives, noise=noise, equations=equations, is_converged=is_converged
    )


def scatter_deviations(matrix: Array, gradient: Array) -> Array:
    """Return the standard deviations of all unknowns: by the noise, or by the scatter of the recordings if larger.

    Args:
        matrix: information of all recordings and of the prior, shape (unknowns, unknowns).
        gradient: gradient of each recording, shape (recordings, unknowns).
    """
    inverse = np.linalg.inv(matrix)
    variances, count = np.diag(inverse), len(gradient)
    if count >= _MIN_SCATTERED:
        influence = (gradient - gradient.mean(axis=0)) @ inverse
        variances = np.maximum(variances, count / (count - 1.0) * np.square(influence).sum(axis=0))
    return np.sqrt(variances)


def _limited_step(matrix: Array, gradient: Array, p: int) -> Array:
    """Return the Newton step in which no logarithm changes by more than `MAX_LOG_STEP`.

    Parameters that would change more are fixed at the limit, and the others are solved again.
    """
    step = np.zeros(len(gradient))
    free = np.ones(len(gradient), dtype=bool)
    while True:
        fixed = matrix[np.ix_(free, ~free)] @ step[~free]
        step[free] = -np.linalg.solve(matrix[np.ix_(free, free)], gradient[free] + fixed)
        excess = free & (np.arange(len(step)) < p) & (np.abs(step) > MAX_LOG_STEP)
        if not excess.any():
            return step
        step[excess] = np.sign(step[excess]) * MAX_LOG_STEP
        free &= ~excess


def _line_search(
    problem: JointProblem,
    point: Point,
    selected: Sequence[int],
    noise: NoiseModel,
    tolerance: float,
    step: Array,
    fixed: tuple[Derivatives, Array, Array] | None,
) -> Point | None:
    """Return the first point along a step whose cost is lower than at its start; None if there is none.

    It has a lower loss. With fixed derivatives, information and weights of recordings, the next step must be smaller
    instead. Short waves of a limp cloth change the loss by more than the last steps do. Averaged derivatives hardly
    respond to them.
    """

    def cost(at: Point) -> float:
        if fixed is None:
            return problem.loss(at, selected, noise)
        derivatives, matrix, weights = fixed
        equations = problem.normal_equations(at, derivatives, selected, noise, weights)
        gradient = equations.gradient.sum(axis=0) + problem.prior(at)[1]
        return float(gradient @ np.linalg.solve(matrix, gradient))

    p, scaled = len(point.theta), step
    current = cost(point)
    for _ in range(_MAX_REDUCTIONS):
        theta = problem.clamp(point.theta + scaled[:p])
        eta = problem.alignment.clamp(point.eta + scaled[p:], problem.offsets)
        moved = problem.evaluate(theta, eta, selected, tolerance)
        if not isinstance(moved, str) and cost(moved) < current:
            return moved
        scaled = scaled * _REDUCTION
    return None


def linear_clouds(
    problem: JointProblem, solution: JointSolution, selected: Sequence[int], sigma: float, reach: Array
) -> list[int]:
    """Return for each selected recording the number of used clouds before the first whose motion is unpredictable.

    A cloud is unpredictable if its residuals are nonlinear within the uncertainty of a parameter, beyond the noise.
    Later clouds of that recording are so too.

    Args:
        problem: recordings and unknowns.
        solution: result with central differences.
        selected: indices of its recordings.
        sigma: deviation of a coordinate [m].
        reach: uncertainty of each logarithm, shape (p,).
    """
    counts = []
    for row, k in enumerate(selected):
        slopes, curvatures = solution.derivatives.slopes[row], solution.derivatives.curvatures[row]
        n_linear = len(problem.used[k])
        for c in range(n_linear):
            is_curved = False
            for i, step in enumerate(solution.derivatives.steps):
                # Second differences grow with the square of the step.
                curvature = float(np.square(curvatures[i][c]).sum()) * (reach[i] / step) ** 4
                line = float(np.square(slopes[i][c] * reach[i]).sum())
                is_curved |= curvature > MAX_CURVATURE**2 * max(line, sigma**2 * slopes[i][c].size)
            if is_curved:
                n_linear = c
                break
        counts.append(n_linear)
    return counts


def align_all(problem: JointProblem, point: Point, selected: Sequence[int], *, is_refined: bool = False) -> Array:
    """Search over time offsets for the alignment that fits the motions of a point best; return its vector."""
    eta, model = np.zeros(problem.alignment.n_unknowns), problem.alignment
    if not len(eta):
        return eta
    trajectories = dict(zip(selected, point.trajectories, strict=True))
    groups = [list(selected)] if model.is_common else [[k] for k in selected]
    for group in groups:
        best, _ = search_alignment(
            [problem.recordings[k] for k in group],
            [trajectories[k] for k in group],
            [problem.used[k] for k in group],
            model,
            problem.offsets,
            is_refined=is_refined,
        )
        for k in group:
            model.write_alignment(eta, k, best)
    return eta


def replace_alignment(problem: JointProblem, point: Point, selected: Sequence[int], eta: Array) -> Point:
    """Return a point with another alignment and the residuals that follow, without new simulations."""
    residuals = [problem.residuals(k, t, eta) for k, t in zip(selected, point.trajectories, strict=True)]
    return attrs.evolve(point, eta=eta, residuals=residuals)
