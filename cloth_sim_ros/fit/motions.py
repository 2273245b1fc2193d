# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of a cloth's parameters to several recordings at once, with intervals by motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.alignment import FIXED, PER_RECORDING, SHARED, Alignment, AlignmentModel, search_alignment
from cloth_sim_ros.fit.clusters import MIN_MOTIONS, Covariance, jackknife_covariance, noise_covariance
from cloth_sim_ros.fit.difference_steps import DifferenceSteps, step_bounds
from cloth_sim_ros.fit.fit import Estimate
from cloth_sim_ros.fit.hypotheses import GraspChoice
from cloth_sim_ros.fit.information import ConfoundedDirection, confounded_directions
from cloth_sim_ros.fit.joint import JointProblem, JointSolution, Point, linear_clouds, solve_joint
from cloth_sim_ros.fit.noise import HUBER, median_deviation
from cloth_sim_ros.fit.parameters import FitError, FitParameter, choose_parameters
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.recording import FitRecording, check_recording, is_visible
from cloth_sim_ros.fit.rest_shapes import choose_rest_shapes
from cloth_sim_ros.fit.scores import Score, driven_floors, excess_misfit, pooled_score, rigid_distances, score
from cloth_sim_ros.fit.screening import UnusedClouds, screen_clouds
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.fit.windows import IDENTIFIED_DEVIATION
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Tolerances of the simulations of the search and of the result [m].
SEARCH_TOLERANCE, TOLERANCE = 1e-4, 1e-4
#: Number of recordings of the first search.
N_SEARCHED = 6
#: Step at which a first search ends [standard deviations].
_SEARCHED = 0.5
#: Difference step of the first search.
_SEARCH_STEP = 0.1
#: Largest change of a time offset after the first search [s].
_OFFSET_MARGIN = 0.1
#: Iterations of the searches, and of the last search between two linearizations.
_SEARCH_ITERATIONS, _LAST_ITERATIONS = 6, 8
#: Number of linearizations of all recordings.
MAX_LINEARIZATIONS = 5
#: Change of a logarithm since the linearization above which it is repeated [standard deviations] and absolute.
_STALE_SIGMAS, _STALE_STEP = 3.0, 0.1
#: Median residual of a cloud above which it cannot be the cloth [median of all clouds].
OUTLIER_RATIO = 6.0
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


def fit_motions(
    recordings: Sequence[FitRecording],
    names: Sequence[str],
    *,
    start: Mapping[str, float] | None = None,
    time_offset: str = SHARED,
    camera_pose: str = SHARED,
    loss: str = HUBER,
    held_out: int = 0,
    within: float = IDENTIFIED_DEVIATION,
    workers: int | None = None,
    on_progress: Callable[[int], None] = lambda _runs: None,
    pool: TrajectoryPool | None = None,
) -> MotionFit:
    """Fit parameters to several whole motions of one cloth, in worker processes; return the fit. Raises FitError.

    Args:
        recordings: commands and clouds, see `motion_recording` and `read_session`.
        names: names of the parameters, short (`stretch`) or full (`material.stretch_modulus`).
        start: starting values by name; the scene's by default.
        time_offset: offset between clouds and poses: ``no``, ``shared`` by all recordings, or for ``each``.
        camera_pose: error of the camera's pose, likewise.
        loss: loss of a point: ``square``, ``huber`` or ``cauchy``.
        held_out: number of recordings on which nothing is fitted; they are spread evenly over the list.
        within: largest relative standard deviation of an identified parameter.
        workers: number of processes; one per core by default.
        on_progress: called with the number of simulations since the last call.
        pool: processes that the caller has started already; replaces `workers`.

    Raises:
        FitError: if the fit is impossible; the text names cause and remedy.
    """
    check_options(len(recordings), time_offset, camera_pose, held_out, within, workers)
    _check_cloths(recordings)
    scene = recordings[0].scene
    parameters = choose_parameters(scene, names, start)
    screened = screen_clouds(recordings)
    for recording in recordings:
        check_recording(recording, [parameter.name for parameter in parameters], min_clouds=1)
    used_pool = TrajectoryPool(workers) if pool is None else pool
    n_before = used_pool.n_runs
    try:
        centre = np.mean([recording.scene.initial_positions().mean(axis=0) for recording in recordings], axis=0)
        if recordings[0].matched:
            first = [cloud[is_visible(cloud)] for cloud in recordings[0].clouds if is_visible(cloud).any()]
            centre = np.median(np.concatenate(first), axis=0)
        problem = JointProblem(
            recordings=recordings,
            used=[np.array(indices, dtype=np.int64) for indices in screened.used],
            parameters=parameters,
            alignment=AlignmentModel(
                n_recordings=len(recordings),
                time=time_offset,
                camera=camera_pose,
                has_shift=any(recording.n_settle_frames > 0 and recording.matched for recording in recordings),
                pivot=tuple(centre.tolist()),
            ),
            pool=used_pool,
            on_progress=on_progress,
        )
        return _fit_problem(problem, screened.left_out(), held_out, loss, within, n_before)
    finally:
        if pool is None:
            used_pool.__exit__(None, None, None)


def check_options(
    n_recordings: int,
    time_offset: str,
    camera_pose: str,
    held_out: int,
    within: float,
    workers: int | None,
) -> None:
    """Raise FitError for an invalid option of a fit to several motions, by its name.

    Raises:
        FitError: naming the option that can't be used.
    """
    if not n_recordings:
        raise FitError("no recording is given")
    for option, kind in (("time offset", time_offset), ("camera pose", camera_pose)):
        if kind not in (FIXED, SHARED, PER_RECORDING):
            raise FitError(f"the {option} is '{kind}'; it must be {FIXED}, {SHARED} or {PER_RECORDING}")
    if not (math.isfinite(within) and 0.0 < within < 1.0):
        raise FitError(f"within is {within:g}; a relative deviation must be between 0 and 1, e.g. 0.025")
    if workers is not None and workers < 1:
        raise FitError(f"workers is {workers}; at least 1 is needed")
    if not 0 <= held_out < n_recordings:
        raise FitError(
            f"--held-out is {held_out}; it must be from 0 to {n_recordings - 1}, one less than the recordings"
        )


def _check_cloths(recordings: Sequence[FitRecording]) -> None:
    count = len(recordings[0].scene.initial_positions())
    for recording in recordings[1:]:
        if len(recording.scene.initial_positions()) != count or recording.matched != recordings[0].matched:
            raise FitError(f"{recording.name} and {recordings[0].name} are recordings of different cloths")


def held_out_indices(n_recordings: int, held_out: int) -> list[int]:
    """Return the indices of the recordings on which nothing is fitted, spread evenly."""
    return sorted({int((k + 0.5) * n_recordings / held_out) for k in range(held_out)}) if held_out else []


def _fit_problem(
    problem: JointProblem, left_out: UnusedClouds, held_out: int, loss: str, within: float, n_before: int
) -> MotionFit:
    outside = held_out_indices(len(problem.recordings), held_out)
    inside = [k for k in range(len(problem.recordings)) if k not in outside and len(problem.used[k])]
    if not inside:
        raise FitError("no recording has a cloud that can be the cloth")
    theta, eta = _search(problem, inside, loss)
    if problem.alignment.time == SHARED:
        offset = problem.alignment.alignment(eta, inside[0]).offset
        problem.offsets = (offset - _OFFSET_MARGIN, offset + _OFFSET_MARGIN)
    choose_rest_shapes(problem, theta, sorted([*inside, *outside]), SEARCH_TOLERANCE)
    point = _point(problem, theta, eta, inside, TOLERANCE)
    dropped = _drop_outliers(problem, point, inside)
    if dropped:
        inside = [k for k in inside if len(problem.used[k])]
        point = _point(problem, theta, eta, inside, TOLERANCE)
    n_coordinates = sum(r.size for part in point.residuals for r in part)
    n_unknowns = len(theta) + problem.alignment.n_unknowns
    if n_coordinates <= n_unknowns:
        raise FitError(f"the clouds have {n_coordinates} coordinates for {n_unknowns} unknowns; record more clouds")
    solution, unpredictable = solve_all(problem, point, inside, loss)
    counts = attrs.evolve(left_out, other_object=dropped, unpredictable=unpredictable)
    return _build(problem, solution, inside, outside, counts, loss, within, n_before)


def strongest_motions(
    recordings: Sequence[FitRecording] | Sequence[Recording], candidates: Sequence[int], count: int
) -> list[int]:
    """Return sorted indices of at most `count` recordings for a first search.

    Half of them are those with the largest motion of the points, the other half are spread over the rest.
    """
    strengths = {}
    for k in candidates:
        clouds = [cloud[is_visible(cloud)].mean(axis=0) for cloud in recordings[k].clouds if is_visible(cloud).any()]
        strengths[k] = float(np.std(np.array(clouds), axis=0).sum()) if clouds else 0.0
    order = sorted(candidates, key=lambda k: -strengths[k])
    strong = order[: (count + 1) // 2]
    weaker = order[len(strong) :]
    n_more = min(count - len(strong), len(weaker))
    return sorted([*strong, *(weaker[int((k + 0.5) * len(weaker) / n_more)] for k in range(n_more))])


def _search(problem: JointProblem, inside: Sequence[int], loss: str) -> tuple[Array, Array]:
    """Return parameters' logarithms and alignment, found at a coarse tolerance from some of the recordings."""
    selected = strongest_motions(problem.recordings, inside, N_SEARCHED)
    eta = np.zeros(problem.alignment.n_unknowns)
    choose_rest_shapes(problem, problem.start, selected, SEARCH_TOLERANCE)
    point = _point(problem, problem.start, eta, selected, SEARCH_TOLERANCE)
    eta = align_all(problem, point, selected)
    point = replace_alignment(problem, point, selected, eta)
    steps = np.full(len(problem.parameters), _SEARCH_STEP)
    for has_smooth_noise in (False, False, True):
        noise = problem.smooth_noise(point, selected, loss) if has_smooth_noise else problem.white_noise(point, loss)
        solution = solve_joint(
            problem,
            point,
            selected,
            noise=noise,
            tolerance=SEARCH_TOLERANCE,
            max_iterations=_SEARCH_ITERATIONS,
            steps=steps,
            converged_fraction=_SEARCHED,
        )
        point = solution.point
    return solution.point.theta, _complete_alignment(problem, solution.point, selected, inside)


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


def _complete_alignment(problem: JointProblem, point: Point, selected: Sequence[int], inside: Sequence[int]) -> Array:
    """Return the alignment with starting values for the recordings that the search did not use."""
    missing = [k for k in inside if k not in selected]
    if not missing or problem.alignment.is_common:
        return point.eta
    eta, further = point.eta.copy(), _point(problem, point.theta, point.eta, missing, SEARCH_TOLERANCE)
    aligned = align_all(problem, further, missing)
    is_shared = problem.alignment.shared_mask()
    for k in missing:
        places = problem.alignment.columns(k)[1]
        places = places[~is_shared[places]]
        eta[places] = aligned[places]
    return eta


def _point(problem: JointProblem, theta: Array, eta: Array, selected: Sequence[int], tolerance: float) -> Point:
    point = problem.evaluate(theta, eta, selected, tolerance)
    if isinstance(point, str):
        raise FitError(f"the motion can't be simulated with the values of the search: {point}")
    return point


def _drop_outliers(problem: JointProblem, point: Point, inside: Sequence[int]) -> int:
    """Remove clouds far from the simulated cloth from `problem.used`; return their number."""
    medians = [[float(np.median(np.abs(r))) if r.size else 0.0 for r in part] for part in point.residuals]
    typical = float(np.median([m for part in medians for m in part]))
    dropped = 0
    for k, part in zip(inside, medians, strict=True):
        is_cloth = np.array([m <= OUTLIER_RATIO * typical for m in part])
        dropped += int((~is_cloth).sum())
        problem.used[k] = problem.used[k][is_cloth]
    return dropped


def solve_all(problem: JointProblem, point: Point, inside: Sequence[int], loss: str) -> tuple[JointSolution, int]:
    """Solve for all recordings; remove unpredictable clouds from `problem.used`; return solution and their number."""
    differences, unpredictable = DifferenceSteps.initial(len(point.theta)), 0
    solution = derivatives = previous = None
    for attempt in range(MAX_LINEARIZATIONS):
        begin = point.theta
        noise = problem.smooth_noise(point, inside, loss)
        solution = solve_joint(
            problem,
            point,
            inside,
            noise=noise,
            tolerance=TOLERANCE,
            max_iterations=_LAST_ITERATIONS,
            steps=differences.steps,
            central=True,
            derivatives=derivatives,
            previous=previous,
            chord=True,
        )
        point = solution.point
        sigmas = noise_covariance(problem, solution, inside).deviations
        differences = differences.next_steps(solution.derivatives, sigmas)
        residuals = np.concatenate([r.ravel() for part in point.residuals for r in part])
        counts = linear_clouds(problem, solution, inside, median_deviation(residuals), step_bounds(sigmas))
        removed = sum(len(problem.used[k]) - n for k, n in zip(inside, counts, strict=True))
        moved = np.abs(point.theta - begin)
        has_moved = bool(np.any(moved > np.maximum(_STALE_SIGMAS * sigmas, _STALE_STEP)))
        is_stale = has_moved or differences.is_rough
        is_done = solution.is_converged and bool(solution.derivatives.other_slopes) and not (removed or is_stale)
        if is_done or attempt == MAX_LINEARIZATIONS - 1:
            break
        unpredictable += removed
        for k, n in zip(inside, counts, strict=True):
            problem.used[k] = problem.used[k][:n]
        shorter = solution.derivatives.first_clouds(counts)
        derivatives = shorter if solution.is_converged and shorter.other_slopes and not is_stale else None
        # Slopes from afar are others.
        previous = None if has_moved else shorter
        point = replace_alignment(problem, point, inside, point.eta)
    assert solution is not None
    return solution, unpredictable


def _build(
    problem: JointProblem,
    solution: JointSolution,
    inside: list[int],
    outside: list[int],
    left_out: UnusedClouds,
    loss: str,
    within: float,
    n_before: int,
) -> MotionFit:
    recordings, point = problem.recordings, solution.point
    has_intervals = len(inside) >= MIN_MOTIONS
    covariance = (jackknife_covariance if has_intervals else noise_covariance)(problem, solution, inside)
    doubt = _doubt(solution, inside)
    estimates = [
        _estimate(parameter, float(theta), covariance, k, within, doubt)
        for k, (parameter, theta) in enumerate(zip(problem.parameters, point.theta, strict=True))
    ]
    floors, basis = driven_floors(problem, point, inside)
    by_motion = dict(zip(inside, floors, strict=bool(floors)))
    motions, etas = _score_motions(problem, solution, covariance, inside, outside, by_motion)
    entries_without = [entry for entry in motions if entry.is_held_out]
    typical = float(np.median([entry.model.rms for entry in motions]))
    model, n_seen = problem.alignment, [int(is_visible(c).sum()) for k in inside for c in _used_clouds(problem, k)]
    n_points = sum(len(c) for k in inside for c in _used_clouds(problem, k))
    noise = solution.noise
    smooth = float(noise.variances.sum())
    compared = [(entry.model, entry.floor) for entry in motions if entry.floor is not None]
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
        excess=excess_misfit(*zip(*compared, strict=True)) if compared else None,
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
    from cloth_sim_ros.fit.misfit import NOT_CONVERGED

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
