# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits of swings about the true parameters, and the best possible deviations.

The residuals are linear in the parameters, and exact in time offset and camera pose. A fit takes its derivatives from
two linearizations, as the program does, and the residuals respond by a third one. Short waves of all three are
independent. Noise model, weights and intervals are those of the program. Such a fit takes a second, a real one minutes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros import Scene
from cloth_sim_ros.fit.alignment import SHARED, AlignmentModel, alignment_derivatives
from cloth_sim_ros.fit.clusters import Covariance, jackknife_covariance, noise_covariance
from cloth_sim_ros.fit.difference_steps import DifferenceSteps
from cloth_sim_ros.fit.hypotheses import pivot_of, selections
from cloth_sim_ros.fit.joint import Derivatives, JointProblem, Point
from cloth_sim_ros.fit.joint_solver import JointSolution, align_all, replace_alignment
from cloth_sim_ros.fit.motions import MAX_LINEARIZATIONS
from cloth_sim_ros.fit.motions_result import TOLERANCE
from cloth_sim_ros.fit.noise import HUBER
from cloth_sim_ros.fit.parameters import FitParameter, choose_parameters
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.recording import visible_mask
from cloth_sim_ros.fit.rest_shapes import choose_rest_shapes
from cloth_sim_ros.fit.scores import Score, driven_floors, rigid_distances, score
from cloth_sim_ros.fit.short_waves import missing_information
from cloth_sim_ros.fit.start import motion_recording
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.physics.model.forces.force import Array
from validation.reality import swing_samples as samples

#: Iterations of a linear fit.
_ITERATIONS = 5


@attrs.frozen(kw_only=True, eq=False)
class Linearized:
    """Motions at the true parameters, and their derivatives at all particles and clouds."""

    #: Problem with complete, noise-free clouds, and its state.
    problem: JointProblem
    point: Point
    #: Derivatives by the last two linearizations.
    derivatives: Derivatives
    #: Derivatives by a further linearization, by which the residuals change.
    response: Derivatives


def prepare(
    recordings: Sequence[Recording],
    parameters: Sequence[FitParameter],
    pool: TrajectoryPool,
    scene: Scene | None = None,
    held: Mapping[str, tuple[int, ...]] = samples.HELD,
    pivot: tuple[float, ...] | None = None,
) -> JointProblem:
    """Return the least-squares problem of recordings, with the right particles held.

    Args:
        recordings: the recordings.
        parameters: unknowns besides the alignment.
        pool: processes of the simulations.
        scene: the cloth; by default that of the synthetic swings.
        held: held particles, by gripper.
        pivot: centre of the camera's rotation [m]; by default that of the recordings.
    """
    pivot = pivot_of(recordings) if pivot is None else pivot
    model = AlignmentModel(n_recordings=len(recordings), time=SHARED, camera=SHARED, has_shift=True, pivot=pivot)
    scene = samples.swing_scene({}) if scene is None else scene
    prepared = [motion_recording(r, scene, selections(held), max_offset=model.max_offset) for r in recordings]
    return JointProblem(
        recordings=prepared,
        used=[np.arange(len(r.clouds)) for r in recordings],
        parameters=parameters,
        alignment=model,
        pool=pool,
    )


def start_point(problem: JointProblem) -> Point:
    """Return the point of all motions at the starting values, with rest shapes chosen and all motions aligned.

    Raises:
        ValueError: if a motion can't be simulated.
    """
    selected = range(len(problem.recordings))
    choose_rest_shapes(problem, problem.start, selected, TOLERANCE)
    point = problem.evaluate(problem.start, np.zeros(problem.alignment.n_unknowns), selected, TOLERANCE)
    if isinstance(point, str):
        raise ValueError(point)
    return replace_alignment(problem, point, selected, align_all(problem, point, selected))


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
    point = aligned(problem, start_point(problem))
    recorded = LossyClouds.at_truth(problem, point, exact, seed, selected)
    steps, previous = DifferenceSteps.initial(len(parameters)), None
    for _ in range(MAX_LINEARIZATIONS):
        derivatives = problem.differentiate(point, selected, steps.steps, TOLERANCE, central=True)
        if previous is not None:
            derivatives.other_slopes = previous.slopes
        steps = steps.next_steps(derivatives, recorded.noise_deviations(derivatives))
        if previous is not None and not steps.is_rough:
            break
        previous = derivatives
    response = problem.differentiate(point, selected, steps.steps, TOLERANCE, central=True)
    return Linearized(problem=problem, point=point, derivatives=derivatives, response=response)


def aligned(problem: JointProblem, point: Point) -> Point:
    """Return a point of all motions with the best alignment at its parameters: a search has a grid of time offsets."""
    selected, p = range(len(problem.recordings)), len(point.theta)
    none = [[[np.zeros_like(r) for r in part]] * p for part in point.residuals]
    derivatives = Derivatives(slopes=none, curvatures=[], steps=np.ones(p))
    for _ in range(_ITERATIONS):
        noise = problem.white_noise(point, HUBER)
        equations = problem.normal_equations(point, derivatives, selected, noise)
        information, gradient = (part.sum(axis=0)[p:] for part in (equations.information, equations.gradient))
        point = replace_alignment(problem, point, selected, point.eta - np.linalg.solve(information[:, p:], gradient))
    return point


@attrs.define(kw_only=True, eq=False)
class LossyClouds:
    """Clouds of some motions by one seed of the camera, and these motions at the true parameters."""

    motions: Sequence[int]
    problem: JointProblem
    point: Point
    #: For each motion, the index of each cloud among all clouds, and masks of its seen particles.
    rows: list[tuple[NDArray[np.int64], list[NDArray[np.bool_]]]]

    @classmethod
    def at_truth(
        cls, whole: JointProblem, truth: Point, exact: Sequence[Array], seed: int, motions: Sequence[int]
    ) -> LossyClouds:
        """Return the clouds of a seed; `whole` and `truth` are the problem with complete clouds and its state."""
        recordings = [samples.record_motion(k, exact[k], seed) for k in motions]
        problem = prepare(recordings, whole.parameters, whole.pool)
        rows = [
            (np.rint(entry.times * samples.CLOUD_RATE).astype(np.int64), [visible_mask(c) for c in entry.clouds])
            for entry in recordings
        ]
        # Trajectories count frames from the start of the complete recordings.
        problem.recordings = [
            attrs.evolve(recording, frames=whole.recordings[k].frames[stamps], events=whole.recordings[k].events)
            for k, recording, (stamps, _) in zip(motions, problem.recordings, rows, strict=True)
        ]
        selected = range(len(motions))
        trajectories = [truth.trajectories[k] for k in motions]
        point = Point(theta=problem.start, eta=truth.eta.copy(), trajectories=trajectories, residuals=[])
        point = replace_alignment(problem, point, selected, align_all(problem, point, selected))
        return cls(motions=motions, problem=problem, point=point, rows=rows)

    @property
    def selected(self) -> range:
        """Indices of the motions in `problem`."""
        return range(len(self.motions))

    def seen(self, derivatives: Derivatives) -> Derivatives:
        """Return the derivatives of the seen particles; `derivatives` are of all motions, clouds and particles."""
        slopes, other_slopes = (
            [
                [[by_cloud[c][mask] for c, mask in zip(*rows, strict=True)] for by_cloud in parts[k]]
                for k, rows in zip(self.motions, self.rows, strict=True)
                if parts
            ]
            for parts in (derivatives.slopes, derivatives.other_slopes)
        )
        return attrs.evolve(derivatives, slopes=slopes, other_slopes=other_slopes, curvatures=[])

    def noise_deviations(self, derivatives: Derivatives) -> Array:
        """Return the standard deviations of the logarithms by the noise, shape (p,)."""
        noise = self.problem.smooth_noise(self.point, self.selected, HUBER)
        seen = self.seen(derivatives)
        equations = self.problem.normal_equations(self.point, seen, self.selected, noise)
        solution = JointSolution(
            point=self.point, derivatives=seen, noise=noise, equations=equations, is_converged=True
        )
        return noise_covariance(self.problem, solution, self.selected).deviations

    def moved(self, theta: Array, eta: Array, response: Derivatives) -> Point:
        """Return the point at other logarithms and another alignment; `response` gives the residuals' changes."""
        base = replace_alignment(self.problem, self.point, self.selected, eta)
        changes = theta - self.problem.start
        residuals = [
            [r + sum(change * slopes[i][c] for i, change in enumerate(changes)) for c, r in enumerate(part)]
            for slopes, part in zip(response.slopes, base.residuals, strict=True)
        ]
        return attrs.evolve(base, theta=theta, residuals=residuals)


def linear_fit(
    linearized: Linearized,
    exact: Sequence[Array],
    seed: int,
    motions: Sequence[int] | None = None,
    *,
    has_best: bool = True,
) -> LinearFit:
    """Return a fit to the clouds of one seed, linear in the parameters.

    Args:
        linearized: derivatives of all motions.
        exact: true frames of each motion, possibly of another model.
        seed: seed of the camera.
        motions: indices of the fitted motions; default: all.
        has_best: true to compute the best possible deviations.
    """
    motions = range(len(exact)) if motions is None else motions
    recorded = LossyClouds.at_truth(linearized.problem, linearized.point, exact, seed, motions)
    problem, point, p = recorded.problem, recorded.point, len(linearized.problem.parameters)
    selected = recorded.selected
    derivatives, response = recorded.seen(linearized.derivatives), recorded.seen(linearized.response)
    noise = problem.smooth_noise(point, selected, HUBER)
    for _ in range(_ITERATIONS):
        noise = problem.update_noise(noise, point, selected, 2)
        equations = problem.normal_equations(point, derivatives, selected, noise)
        information, gradient = problem.prior(point)
        matrix = equations.information.sum(axis=0) + np.diag(information)
        step = -np.linalg.solve(matrix, equations.gradient.sum(axis=0) + gradient)
        point = recorded.moved(point.theta + step[:p], point.eta + step[p:], response)
    solution = JointSolution(point=point, derivatives=derivatives, noise=noise, equations=equations, is_converged=True)
    covariance = jackknife_covariance(problem, solution, selected)
    return LinearFit(
        errors=point.theta - problem.start,
        eta=point.eta,
        covariance=covariance,
        best=best_deviations(recorded, solution, seed) if has_best else np.full(p, np.nan),
    )


@attrs.frozen(kw_only=True, eq=False)
class HeldOut:
    """Errors of a fit in motions that it did not use."""

    #: Of the cloth, and of the camera at the driven particles, for each motion.
    models: list[Score]
    floors: list[Score]
    #: Root mean squares over all motions [m]: of the cloth, of the cloth carried rigidly, and of the floor.
    rms: float
    rigid: float
    floor: float


def held_out(
    linearized: Linearized, exact: Sequence[Array], seed: int, motions: Sequence[int], fit: LinearFit
) -> HeldOut:
    """Return the errors of a fit in motions that it did not use."""
    recorded = LossyClouds.at_truth(linearized.problem, linearized.point, exact, seed, motions)
    problem, response = recorded.problem, recorded.seen(linearized.response)
    point = recorded.moved(problem.start + fit.errors, fit.eta, response)
    models, rigid = motion_scores(point), rigid_scores(problem, point)
    floors, _ = driven_floors(problem, point, recorded.selected)
    rms = [score([entry.distances for entry in entries]).rms for entries in (models, rigid, floors)]
    return HeldOut(models=models, floors=floors, rms=rms[0], rigid=rms[1], floor=rms[2])


def motion_scores(point: Point) -> list[Score]:
    """Return the errors of the simulated cloth in each motion."""
    return [score([np.linalg.norm(r, axis=1) for r in part]) for part in point.residuals]


def rigid_scores(problem: JointProblem, point: Point) -> list[Score]:
    """Return the errors of the cloth that its grippers carry rigidly, in each motion."""
    return [score(rigid_distances(problem, k, x, point.eta)) for k, x in enumerate(point.trajectories)]


@attrs.frozen(kw_only=True, eq=False)
class LinearFit:
    """Errors of a linear fit."""

    #: Errors of the logarithms, shape (p,), and unknowns of the alignment.
    errors: Array
    eta: Array
    covariance: Covariance
    #: Best possible standard deviations, shape (p,); NaN if they are not computed.
    best: Array

    def reach(self, level: float) -> Array:
        """Return the half width of the intervals of the logarithms, shape (p,)."""
        from scipy.stats import t

        return np.asarray(t.ppf(0.5 + 0.5 * level, self.covariance.freedoms) * self.covariance.deviations)


def best_deviations(recorded: LossyClouds, solution: JointSolution, seed: int) -> Array:
    """Return the Cramer-Rao bounds of the logarithms, with the true covariance of the camera's errors.

    Args:
        recorded: recordings and unknowns.
        solution: derivatives near the true values.
        seed: seed of the camera.
    """
    from scipy.linalg import solve_triangular

    problem = recorded.problem
    p = len(problem.parameters)
    prior, _ = problem.prior(solution.point)
    prior[:p] *= 1e-6
    total, squares = np.diag(prior), np.diag(prior)
    sets = (solution.derivatives.slopes, solution.derivatives.other_slopes)
    for k, (index, (stamps, seen)) in enumerate(zip(recorded.motions, recorded.rows, strict=True)):
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
        covariance = samples.noise_covariance(clouds, particles, samples.noise_amplitudes(index, seed))
        factor = np.linalg.cholesky(covariance)
        columns = np.concatenate([np.arange(p), p + places])
        # Rows are points; columns are unknowns and coordinates, of one set of slopes after the other.
        jacobians = [np.concatenate(by) for slopes in sets for by in (*slopes[k], *by_alignment)]
        white = solve_triangular(factor, np.stack(jacobians, axis=1).reshape(len(clouds), -1), lower=True)
        first, second = np.split(white.reshape(len(clouds), -1, 3), 2, axis=1)
        for matrix, (a, b) in (
            (total, (first, second)),
            (total, (second, first)),
            (squares, (first + second, first + second)),
        ):
            product = np.einsum("nia,nja->ij", a, b, optimize=True)
            matrix[np.ix_(columns, columns)] += (0.5 if matrix is total else 0.25) * product
    total[:p, :p] += missing_information(total, squares, p)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(total))[:p]))
