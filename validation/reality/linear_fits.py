# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits of swings about the true parameters, and the best possible deviations.

The residuals are linear in the parameters, and exact in time offset and camera pose. A fit takes its derivatives from
two linearizations, as the program does, and the residuals respond by a third one. Short waves of all three are
independent. Noise model, weights and intervals are those of the program. Such a fit takes a second, a real one minutes.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.alignment import SHARED, AlignmentModel, alignment_derivatives
from cloth_sim_ros.fit.clusters import Covariance, jackknife_covariance, noise_covariance
from cloth_sim_ros.fit.difference_steps import DifferenceSteps
from cloth_sim_ros.fit.hypotheses import pivot_of, selections
from cloth_sim_ros.fit.joint import Derivatives, JointProblem, JointSolution, Point, missing_information
from cloth_sim_ros.fit.motions import MAX_LINEARIZATIONS, TOLERANCE, align_all, replace_alignment
from cloth_sim_ros.fit.noise import HUBER
from cloth_sim_ros.fit.parameters import FitParameter, choose_parameters
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.recording import visible
from cloth_sim_ros.fit.rest_shapes import choose_rest_shapes
from cloth_sim_ros.fit.start import motion_recording
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.physics.model.forces.force import Array
from validation.reality import swing_samples as samples

#: Iterations of a linear fit.
_ITERATIONS = 8


@attrs.frozen(kw_only=True, eq=False)
class Linearized:
    """Motions at the true parameters, and their derivatives at all particles and clouds."""

    parameters: tuple[FitParameter, ...]
    #: State of a problem with the complete, noise-free clouds.
    point: Point
    #: Derivatives by the last two linearizations.
    derivatives: Derivatives
    #: Derivatives by a further linearization, by which the residuals change.
    response: Derivatives


def prepare(recordings: Sequence[Recording], parameters: Sequence[FitParameter], pool: TrajectoryPool) -> JointProblem:
    """Return the least-squares problem of recordings, with the right particles held."""
    model = AlignmentModel(
        n_recordings=len(recordings), time=SHARED, camera=SHARED, has_shift=True, pivot=pivot_of(recordings)
    )
    held = {"left": (0,), "right": (samples.RESOLUTION - 1,)}
    scene = samples.swing_scene({})
    prepared = [motion_recording(r, scene, selections(held), max_offset=model.max_offset) for r in recordings]
    return JointProblem(
        recordings=prepared,
        used=[np.arange(len(r.clouds)) for r in recordings],
        parameters=parameters,
        alignment=model,
        pool=pool,
    )


def linearize(exact: Sequence[Array], seed: int, pool: TrajectoryPool) -> Linearized:
    """Return the derivatives of the motions at the true parameters.

    The difference steps are those of a fit to the clouds of a seed.

    Args:
        exact: true frames of each motion.
        seed: seed of the camera.
        pool: processes of the simulations.
    """
    parameters = tuple(choose_parameters(samples.swing_scene({}), list(samples.TRUTH)))
    whole = [samples.complete_recording(k, frames) for k, frames in enumerate(exact)]
    problem = prepare(whole, parameters, pool)
    selected = range(len(whole))
    problem.offsets = (samples.DELAY - 0.1, samples.DELAY + 0.1)
    choose_rest_shapes(problem, problem.start, selected, TOLERANCE)
    point = problem.evaluate(problem.start, np.zeros(problem.alignment.n_unknowns), selected, TOLERANCE)
    if isinstance(point, str):
        raise ValueError(point)
    point = replace_alignment(problem, point, selected, align_all(problem, point, selected))
    recorded = _Recorded.at_truth(parameters, point, exact, seed, pool)
    steps, previous = DifferenceSteps.initial(len(parameters)), None
    for _ in range(MAX_LINEARIZATIONS):
        derivatives = problem.differentiate(point, selected, steps.steps, TOLERANCE, central=True)
        if previous is not None:
            derivatives.other_slopes = previous.slopes
        steps = steps.following(derivatives, recorded.noise_deviations(derivatives))
        if previous is not None and not steps.is_rough:
            break
        previous = derivatives
    response = problem.differentiate(point, selected, steps.steps, TOLERANCE, central=True)
    return Linearized(parameters=parameters, point=point, derivatives=derivatives, response=response)


@attrs.define(kw_only=True, eq=False)
class _Recorded:
    """Clouds of one seed, and the motions at the true parameters."""

    problem: JointProblem
    point: Point
    #: For each motion, the index of each cloud among all clouds, and masks of its seen particles.
    rows: list[tuple[NDArray[np.int64], list[NDArray[np.bool_]]]]

    @classmethod
    def at_truth(
        cls,
        parameters: Sequence[FitParameter],
        truth: Point,
        exact: Sequence[Array],
        seed: int,
        pool: TrajectoryPool,
    ) -> _Recorded:
        recordings = [samples.record_motion(k, frames, seed) for k, frames in enumerate(exact)]
        problem = prepare(recordings, parameters, pool)
        rows = [
            (np.rint(recording.times * samples.CLOUD_RATE).astype(np.int64), [visible(c) for c in recording.clouds])
            for recording in recordings
        ]
        # Trajectories count frames from the start of their recording, which depends on its first cloud.
        problem.recordings = [
            attrs.evolve(recording, frames=recording.frames + original.times[0] * samples.FRAME_RATE)
            for recording, original in zip(problem.recordings, recordings, strict=True)
        ]
        selected = range(len(recordings))
        point = Point(theta=problem.start, eta=truth.eta.copy(), trajectories=truth.trajectories, residuals=[])
        point = replace_alignment(problem, point, selected, align_all(problem, point, selected))
        return cls(problem=problem, point=point, rows=rows)

    def seen(self, derivatives: Derivatives) -> Derivatives:
        """Return the derivatives of the seen particles; `derivatives` are of all clouds and particles."""
        slopes, other_slopes = (
            [
                [[by_cloud[c][mask] for c, mask in zip(*rows, strict=True)] for by_cloud in motion]
                for motion, rows in zip(parts, self.rows, strict=bool(parts))
            ]
            for parts in (derivatives.slopes, derivatives.other_slopes)
        )
        return attrs.evolve(derivatives, slopes=slopes, other_slopes=other_slopes, curvatures=[])

    def noise_deviations(self, derivatives: Derivatives) -> Array:
        """Return the standard deviations of the logarithms by the noise, shape (p,)."""
        selected = range(len(self.rows))
        noise = self.problem.smooth_noise(self.point, selected, HUBER)
        seen = self.seen(derivatives)
        equations = self.problem.normal_equations(self.point, seen, selected, noise)
        solution = JointSolution(
            point=self.point, derivatives=seen, noise=noise, equations=equations, is_converged=True
        )
        return noise_covariance(self.problem, solution, selected).deviations


def linear_fit(linearized: Linearized, exact: Sequence[Array], seed: int, pool: TrajectoryPool) -> LinearFit:
    """Return a fit to the clouds of one seed, linear in the parameters."""
    recorded = _Recorded.at_truth(linearized.parameters, linearized.point, exact, seed, pool)
    problem, point, p = recorded.problem, recorded.point, len(linearized.parameters)
    selected = range(len(exact))
    derivatives, response = recorded.seen(linearized.derivatives), recorded.seen(linearized.response).slopes
    noise = problem.smooth_noise(point, selected, HUBER)
    for _ in range(_ITERATIONS):
        noise = problem.update_noise(noise, point, selected, 2)
        equations = problem.normal_equations(point, derivatives, selected, noise)
        information, gradient = problem.prior(point)
        matrix = equations.information.sum(axis=0) + np.diag(information)
        step = -np.linalg.solve(matrix, equations.gradient.sum(axis=0) + gradient)
        theta, eta = point.theta + step[:p], point.eta + step[p:]
        base = replace_alignment(problem, point, selected, eta).residuals
        residuals = [
            [
                r + sum(change * response[k][i][c] for i, change in enumerate(theta - problem.start))
                for c, r in enumerate(part)
            ]
            for k, part in enumerate(base)
        ]
        point = attrs.evolve(point, theta=theta, eta=eta, residuals=residuals)
    solution = JointSolution(point=point, derivatives=derivatives, noise=noise, equations=equations, is_converged=True)
    covariance = jackknife_covariance(problem, solution, selected)
    return LinearFit(
        errors=point.theta - problem.start,
        covariance=covariance,
        best=best_deviations(problem, solution, recorded.rows, seed),
        naive=np.sqrt(np.diag(np.linalg.inv(matrix))[:p]),
    )


@attrs.frozen(kw_only=True, eq=False)
class LinearFit:
    """Errors of a linear fit."""

    #: Errors of the logarithms, shape (p,).
    errors: Array
    covariance: Covariance
    #: Best possible standard deviations, shape (p,).
    best: Array
    #: Standard deviations if the noise model were right, shape (p,).
    naive: Array

    def reach(self, level: float) -> Array:
        """Return the half width of the intervals of the logarithms, shape (p,)."""
        from scipy.stats import t

        return np.asarray(t.ppf(0.5 + 0.5 * level, self.covariance.freedoms) * self.covariance.deviations)


def best_deviations(
    problem: JointProblem,
    solution: JointSolution,
    rows: Sequence[tuple[NDArray[np.int64], Sequence[NDArray[np.bool_]]]],
    seed: int,
) -> Array:
    """Return the Cramer-Rao bounds of the logarithms, with the true covariance of the camera's errors.

    Args:
        problem: recordings and unknowns.
        solution: derivatives near the true values.
        rows: for each motion, the index of each cloud among all clouds, and masks of its seen particles.
        seed: seed of the camera.
    """
    p = len(problem.parameters)
    prior, _ = problem.prior(solution.point)
    prior[:p] *= 1e-6
    total, squares = np.diag(prior), np.diag(prior)
    sets = (solution.derivatives.slopes, solution.derivatives.other_slopes)
    for k, (stamps, seen) in enumerate(rows):
        kinds, places = problem.alignment.columns(k)
        alignment = problem.alignment.alignment(solution.point.eta, k)
        by_alignment = alignment_derivatives(
            problem.recordings[k],
            solution.point.trajectories[k],
            alignment,
            problem.pivot,
            problem.used[k],
            kinds.tolist(),
        )
        clouds = np.concatenate([np.full(int(m.sum()), stamp) for stamp, m in zip(stamps, seen, strict=True)])
        particles = np.concatenate([np.flatnonzero(m) for m in seen])
        covariance = samples.noise_covariance(clouds, particles, samples.noise_amplitudes(k, seed))
        factor = np.linalg.cholesky(covariance)
        first, second = (
            np.linalg.solve(factor, np.moveaxis(jacobian, 0, 1).reshape(len(clouds), -1))
            for jacobian in (np.array([np.concatenate(by) for by in (*slopes[k], *by_alignment)]) for slopes in sets)
        )
        columns = np.concatenate([np.arange(p), p + places])
        for matrix, (a, b) in (
            (total, (first, second)),
            (total, (second, first)),
            (squares, (first + second, first + second)),
        ):
            shapes = (len(clouds), len(columns), 3)
            product = np.einsum("nia,nja->ij", a.reshape(shapes), b.reshape(shapes))
            matrix[np.ix_(columns, columns)] += (0.5 if matrix is total else 0.25) * product
    total[:p, :p] += missing_information(total, squares, p)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(total))[:p]))
