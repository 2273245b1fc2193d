# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Result of a fit to several recordings: estimates, scores of the motions, and doubts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.alignment import Alignment, AlignmentModel
from cloth_sim_ros.fit.clusters import MIN_MOTIONS, Covariance, jackknife_covariance, noise_covariance
from cloth_sim_ros.fit.contradictions import contradiction
from cloth_sim_ros.fit.fit import Estimate
from cloth_sim_ros.fit.hypotheses import GraspChoice
from cloth_sim_ros.fit.information import ConfoundedDirection, confounded_directions
from cloth_sim_ros.fit.joint import JointProblem
from cloth_sim_ros.fit.joint_solver import JointSolution, align_all
from cloth_sim_ros.fit.misfit import NOT_CONVERGED
from cloth_sim_ros.fit.parameters import FitParameter
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.scores import (
    Score,
    driven_floors,
    excess_misfit,
    misfit_doubt,
    pooled_score,
    rigid_distances,
    rigid_doubt,
    score,
)
from cloth_sim_ros.fit.screening import UnusedClouds
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Tolerance of the simulations [m].
TOLERANCE = 1e-4
#: Root mean square of a motion's residuals above which the report names it [median of all motions].
SUSPICIOUS_RATIO = 2.5


@attrs.frozen(eq=False, kw_only=True)
class MotionScore:
    """Distances of one motion's points from the fitted cloth and from a rigid cloth [m]."""

    name: str
    #: Of the cloth, with parameters fitted on the other motions (or on all, if there are too few).
    model: Score
    #: Of the cloth carried rigidly by its grippers.
    rigid: Score
    #: True if no parameter was fitted on it.
    is_held_out: bool
    #: Camera's error at the driven particles; None if nothing was fitted on the motion, or if it shows none of them.
    floor: Score | None = None


@attrs.frozen(eq=False, kw_only=True)
class MotionFit:
    """Result of a fit to several recordings: estimates, alignments, scores and doubts."""

    name: str
    scene: Scene
    recordings: tuple[FitRecording, ...]
    estimates: tuple[Estimate, ...]
    confounded: tuple[ConfoundedDirection, ...]
    #: Covariance of the logarithms of the parameters, shape (p, p), and how it was found.
    covariance: Covariance
    #: Time offset and camera pose of each recording; None if it has its own, and none of its clouds is used.
    alignments: tuple[Alignment | None, ...]
    alignment_model: AlignmentModel
    #: Standard deviations of the alignment's unknowns, shape (unknowns,).
    alignment_sigmas: NDArray[np.float64]
    #: Standard deviation of the white noise of a coordinate [m], and share of the smooth errors in the variance.
    sigma: float
    smooth_share: float
    #: Score of the fitted model on the motions that it was fitted on.
    fitted: Score
    #: Scores on motions without them, pooled, and for each motion.
    held_out: Score | None
    rigid: Score
    motions: tuple[MotionScore, ...]
    #: Error of the driven particles as the camera shows them, and its description.
    floor: Score | None
    floor_basis: str
    #: Part of the error that the floor does not explain [m]; None if it explains all.
    excess: float | None
    n_clouds: int
    n_recorded_clouds: int
    left_out: UnusedClouds
    missing_fraction: float | None
    #: Reason why no parameter counts as identified, and the remedy; empty if the intervals are valid.
    doubt: str
    #: Names of recordings that the model follows much worse than the others.
    suspicious: tuple[str, ...]
    n_runs: int
    tolerance: float
    within: float
    loss: str
    #: Solution about the result, for validation.
    solution: JointSolution
    #: Choice of the grasped particles; None for sessions and bare points.
    grasp: GraspChoice | None = None

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by full name, in the parameters' units."""
        return {estimate.parameter.name: estimate.value for estimate in self.estimates}

    @property
    def unused(self) -> tuple[str, ...]:
        """Names of recordings that have no score, because none of their clouds is used."""
        scored = {entry.name for entry in self.motions}
        return tuple(recording.name for recording in self.recordings if recording.name not in scored)

    @property
    def all_identified(self) -> bool:
        """True if every parameter is identified."""
        return all(estimate.is_identified for estimate in self.estimates)


def build_result(
    problem: JointProblem,
    solution: JointSolution,
    inside: list[int],
    outside: list[int],
    left_out: UnusedClouds,
    loss: str,
    within: float,
    n_before: int,
) -> MotionFit:
    """Return the result of a fit; simulates each motion with the parameters of a fit without it.

    Args:
        problem: recordings and unknowns.
        solution: solution of the fit.
        inside: indices of the recordings that it used.
        outside: indices of those on which nothing was fitted.
        left_out: counts of unused clouds.
        loss: loss of a point.
        within: largest relative standard deviation of an identified parameter.
        n_before: simulations of the pool before this fit.
    """
    recordings, point = problem.recordings, solution.point
    has_intervals = len(inside) >= MIN_MOTIONS
    covariance = (jackknife_covariance if has_intervals else noise_covariance)(problem, solution, inside)
    floors, basis = driven_floors(problem, point, inside)
    by_motion = dict(zip(inside, floors, strict=bool(floors)))
    motions, etas = _score_motions(problem, solution, covariance, inside, outside, by_motion)
    entries_without = [entry for entry in motions if entry.is_held_out]
    typical = float(np.median([entry.model.rms for entry in motions]))
    model, n_seen = problem.alignment, [int(visible_mask(c).sum()) for k in inside for c in _used_clouds(problem, k)]
    n_points = sum(len(c) for k in inside for c in _used_clouds(problem, k))
    noise = solution.noise
    smooth = float(noise.variances.sum())
    compared = [(entry.model, entry.floor) for entry in motions if entry.floor is not None]
    models, floors_of_models = [model for model, _ in compared], [floor for _, floor in compared]
    doubt = _doubt(solution, inside) or contradiction(problem, point, inside)
    used = [entry for entry in motions if not entry.is_held_out]
    doubt = doubt or rigid_doubt([entry.model for entry in used], [entry.rigid for entry in used])
    doubt = doubt or misfit_doubt(models, floors_of_models, TOLERANCE)
    estimates = [
        _estimate(parameter, float(theta), covariance, k, within, doubt)
        for k, (parameter, theta) in enumerate(zip(problem.parameters, point.theta, strict=True))
    ]
    information = np.asarray(np.linalg.pinv(covariance.matrix, rcond=1e-14), dtype=np.float64)
    return MotionFit(
        name=", ".join(r.name for r in recordings[:3])
        + (f" and {len(recordings) - 3} more" if len(recordings) > 3 else ""),
        scene=recordings[0].scene,
        recordings=tuple(recordings),
        estimates=tuple(estimates),
        confounded=tuple(confounded_directions(problem.parameters, information, within)),
        covariance=covariance,
        alignments=tuple(
            model.alignment(etas.get(k, point.eta), k) if model.is_common or k in inside or k in etas else None
            for k in range(len(recordings))
        ),
        alignment_model=model,
        alignment_sigmas=covariance.alignment_deviations,
        sigma=noise.sigma,
        smooth_share=smooth / (smooth + noise.sigma**2),
        fitted=score([np.linalg.norm(r, axis=1) for part in point.residuals for r in part]),
        held_out=pooled_score([entry.model for entry in entries_without]),
        rigid=score([entry.rigid.distances for entry in (entries_without or motions)]),
        motions=tuple(motions),
        floor=pooled_score(floors),
        floor_basis=basis,
        excess=excess_misfit(models, floors_of_models),
        n_clouds=sum(len(problem.used[k]) for k in inside),
        n_recorded_clouds=sum(len(r.clouds) for r in recordings),
        left_out=left_out,
        missing_fraction=1.0 - sum(n_seen) / max(n_points, 1) if recordings[0].matched else None,
        doubt=doubt,
        suspicious=tuple(e.name for e in motions if len(motions) > 2 and e.model.rms > SUSPICIOUS_RATIO * typical),
        n_runs=problem.pool.n_runs - n_before,
        tolerance=TOLERANCE,
        within=within,
        loss=loss,
        solution=solution,
    )


def _used_clouds(problem: JointProblem, index: int) -> list[NDArray[np.float64]]:
    return [problem.recordings[index].clouds[int(k)] for k in problem.used[index]]


def _estimate(
    parameter: FitParameter, theta: float, covariance: Covariance, index: int, within: float, doubt: str
) -> Estimate:
    value = math.exp(theta)
    is_at_limit = min(abs(value / parameter.minimum - 1.0), abs(value / parameter.maximum - 1.0)) < 1e-6
    estimate = Estimate(
        parameter=parameter,
        value=value,
        bound=float(covariance.deviations[index]),
        is_identified=False,
        is_at_limit=is_at_limit,
        is_explained=not doubt,
        freedom=None if covariance.freedoms is None else float(covariance.freedoms[index]),
        has_interval=covariance.has_intervals,
    )
    is_known = covariance.has_intervals and estimate.is_within(within) and not estimate.has_few_motions
    return attrs.evolve(estimate, is_identified=is_known and not is_at_limit and not doubt)


def _doubt(solution: JointSolution, inside: Sequence[int]) -> str:
    if not solution.is_converged:
        return NOT_CONVERGED
    n_missed = sum(trajectory.n_missed for trajectory in solution.point.trajectories)
    n_frames = sum(len(trajectory.frames) for trajectory in solution.point.trajectories)
    if n_missed > 0.01 * n_frames:
        return (
            f"the simulation missed its tolerance of {TOLERANCE:g} m in {n_missed} of {n_frames} frames of "
            f"{len(inside)} motions, because they exceeded the work limit. Use fewer particles, or gentler motions"
        )
    return ""


def _score_motions(
    problem: JointProblem,
    solution: JointSolution,
    covariance: Covariance,
    inside: Sequence[int],
    outside: Sequence[int],
    floors: Mapping[int, Score],
) -> tuple[list[MotionScore], dict[int, Array]]:
    """Return the distances of each motion by the parameters of a fit without it, and alignments fitted for them.

    The latter, and `floors`, are by index.
    """
    point, p = solution.point, len(problem.parameters)
    indices = sorted([*inside, *outside])
    unknowns = {}
    for k in indices:
        change = np.zeros(p + len(point.eta))
        if k in inside and covariance.without is not None:
            change = covariance.without[list(inside).index(k)]
        unknowns[k] = (
            problem.clamp(point.theta + change[:p]),
            problem.alignment.clamp(point.eta + change[p:], problem.offsets),
        )
    results = problem.simulate([(k, unknowns[k][0]) for k in indices], TOLERANCE)
    scores, aligned = [], dict[int, Array]()
    for k, result in zip(indices, results, strict=True):
        if isinstance(result, str) or not len(problem.used[k]):
            continue
        eta = unknowns[k][1]
        if k in outside and not problem.alignment.is_common:
            alone = attrs.evolve(point, trajectories=[result])
            eta = aligned[k] = align_all(problem, alone, [k], is_refined=True)
        distances = [np.linalg.norm(r, axis=1) for r in problem.residuals(k, result, eta)]
        scores.append(
            MotionScore(
                name=problem.recordings[k].name,
                model=score(distances),
                rigid=score(rigid_distances(problem, k, result, eta)),
                is_held_out=k in outside or (not outside and covariance.without is not None),
                floor=floors.get(k),
            )
        )
    return scores, aligned
