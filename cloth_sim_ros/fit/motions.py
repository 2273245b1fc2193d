# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of a cloth's parameters to several recordings at once, with intervals by motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs
import numpy as np

from cloth_sim_ros.fit.alignment import FIXED, PER_RECORDING, SHARED, AlignmentModel
from cloth_sim_ros.fit.clusters import noise_covariance
from cloth_sim_ros.fit.difference_steps import DifferenceSteps, step_bounds
from cloth_sim_ros.fit.joint import JointProblem, Point
from cloth_sim_ros.fit.joint_solver import JointSolution, align_all, linear_clouds, replace_alignment, solve_joint
from cloth_sim_ros.fit.motions_result import TOLERANCE, MotionFit, build_result
from cloth_sim_ros.fit.noise import HUBER, median_deviation
from cloth_sim_ros.fit.parameters import FitError, choose_parameters
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.recording import FitRecording, check_recording, visible_mask
from cloth_sim_ros.fit.rest_shapes import choose_rest_shapes
from cloth_sim_ros.fit.screening import UnusedClouds, screen_clouds
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.fit.windows import IDENTIFIED_DEVIATION
from cloth_sim_ros.physics.model.forces.force import Array

#: Tolerance of the simulations of the search [m].
SEARCH_TOLERANCE = 1e-4
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
            first = [cloud[visible_mask(cloud)] for cloud in recordings[0].clouds if visible_mask(cloud).any()]
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
        limit = problem.alignment.max_offset
        problem.offsets = max(offset - _OFFSET_MARGIN, -limit), min(offset + _OFFSET_MARGIN, limit)
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
    return build_result(problem, solution, inside, outside, counts, loss, within, n_before)


def strongest_motions(
    recordings: Sequence[FitRecording] | Sequence[Recording], candidates: Sequence[int], count: int
) -> list[int]:
    """Return sorted indices of at most `count` recordings for a first search.

    Half of them are those with the largest motion of the points, the other half are spread over the rest.
    """
    strengths = {}
    for k in candidates:
        visible = [cloud[visible_mask(cloud)] for cloud in recordings[k].clouds]
        centres = [points.mean(axis=0) for points in visible if len(points)]
        strengths[k] = float(np.std(np.array(centres), axis=0).sum()) if centres else 0.0
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
