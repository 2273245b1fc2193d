# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Search over all motions, with a function in place of the simulation: its steps and its convergence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from support.motion_samples import scene_of

from cloth_sim_ros.fit.alignment import FIXED, AlignmentModel
from cloth_sim_ros.fit.difference_steps import MAX_STEP, ROUGH_STEP, DifferenceSteps
from cloth_sim_ros.fit.joint import Derivatives, JointProblem, Point
from cloth_sim_ros.fit.joint_solver import JointSolution, scatter_deviations
from cloth_sim_ros.fit.motions import solve_all
from cloth_sim_ros.fit.noise import HUBER
from cloth_sim_ros.fit.parameters import choose_parameters
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.start import motion_recording
from cloth_sim_ros.fit.trajectory import SimulatedMotion, TrajectoryRun

NAMES = ["shear", "normal_drag"]
#: Number of motions, clouds of a motion, and noise of a coordinate [m].
N_MOTIONS, N_CLOUDS, NOISE = 8, 5, 0.01
#: Changes of both logarithms from their start to the truth, and displacement for a change of each [m].
CHANGE, DISPLACEMENT = np.array([0.2, -0.1]), np.array([0.01, 0.1])


class FunctionPool:
    """Positions that are linear in the logarithms, with a deviation of its own for each simulation."""

    def __init__(self, start: np.ndarray, initial: np.ndarray, waves: float) -> None:
        self.start, self.initial, self.waves, self.n_runs = start, initial, waves, 0
        self.pattern = np.random.default_rng(1).normal(size=(2, *initial.shape)) * DISPLACEMENT[:, None, None]

    def positions(self, theta: np.ndarray) -> np.ndarray:
        return self.initial + np.einsum("p,pid->id", theta - self.start, self.pattern)

    def simulate(self, runs: Sequence[TrajectoryRun]) -> list[SimulatedMotion]:
        self.n_runs += len(runs)
        motions = []
        for run in runs:
            name = int(run.recording.name)
            seed = np.frombuffer(np.array(run.values).tobytes(), dtype=np.uint32)
            short = self.waves * np.random.default_rng([name, *seed]).normal(size=self.initial.shape)
            frames = np.arange(len(run.recording.events) + 1)
            x = np.tile(self.positions(np.log(run.values)) + short, (len(frames), 1, 1))
            n_settle = run.recording.n_settle_frames
            motions.append(
                SimulatedMotion(frames=frames, x=x, v=0.0 * x, period=0.1, n_missed=0, n_settle_frames=n_settle)
            )
        return motions


def solve(waves: float) -> tuple[JointProblem, JointSolution]:
    scene, random = scene_of(), np.random.default_rng(3)
    parameters = choose_parameters(scene, NAMES)
    start = np.log([parameter.start for parameter in parameters])
    pool = FunctionPool(start, scene.initial_positions(), waves)
    truth = pool.positions(start + CHANGE)
    clouds = [[truth + random.normal(scale=NOISE, size=truth.shape) for _ in range(N_CLOUDS)] for _ in range(N_MOTIONS)]
    times = 0.1 * np.arange(N_CLOUDS)
    recordings = [Recording(name=str(k), times=times, clouds=part, grippers={}) for k, part in enumerate(clouds)]
    problem = JointProblem(
        recordings=[motion_recording(recording, scene, [], settle_time=0.1) for recording in recordings],
        used=[np.arange(N_CLOUDS)] * N_MOTIONS,
        parameters=parameters,
        alignment=AlignmentModel(n_recordings=N_MOTIONS, time=FIXED, camera=FIXED, has_shift=False, pivot=(0.0,) * 3),
        pool=pool,  # type: ignore[arg-type]
    )
    selected = range(N_MOTIONS)
    point = problem.evaluate(start, np.zeros(0), selected, 1e-4)
    assert not isinstance(point, str)
    solution, unpredictable = solve_all(problem, point, selected, HUBER)
    assert unpredictable == 0
    return problem, solution


def test_steps_double_over_short_waves_only() -> None:
    problem, solution = solve(waves=0.001)
    assert solution.derivatives.steps[0] == ROUGH_STEP
    assert solution.derivatives.steps[1] <= MAX_STEP
    assert solution.is_converged
    assert solution.derivatives.other_slopes
    assert solution.point.theta - problem.start == pytest.approx(CHANGE, abs=0.1)


def test_search_ends_at_root_of_gradients_on_rough_loss() -> None:
    problem, solution = solve(waves=0.003)
    prior_information, prior_gradient = problem.prior(solution.point)
    matrix = solution.equations.information.sum(axis=0) + np.diag(prior_information)
    step = np.linalg.solve(matrix, solution.equations.gradient.sum(axis=0) + prior_gradient)
    # The loss changes by several units with any change of a parameter: its lowest place would be elsewhere.
    assert np.abs(step / np.sqrt(np.diag(np.linalg.inv(matrix)))).max() < 0.5


def test_smooth_residuals_keep_the_first_steps() -> None:
    problem, solution = solve(waves=0.0)
    assert solution.derivatives.steps.max() <= MAX_STEP
    assert solution.is_converged
    assert solution.point.theta - problem.start == pytest.approx(CHANGE, abs=0.1)


def information_of(problem: JointProblem, point: Point, *sets: list[list[list[np.ndarray]]]) -> np.ndarray:
    """Return the information of all motions by one or two sets of slopes, shape (2, 2)."""
    none = [[[np.zeros_like(part) for part in row] for row in motion] for motion in sets[0]]
    derivatives = Derivatives(slopes=sets[0], curvatures=none, steps=np.full(2, 0.1), other_slopes=[])
    if len(sets) > 1:
        derivatives.other_slopes = sets[1]
    selected = range(N_MOTIONS)
    noise = problem.smooth_noise(point, selected, HUBER)
    equal = np.ones(N_MOTIONS)
    return problem.normal_equations(point, derivatives, selected, noise, equal).information.sum(axis=0)


def test_information_omits_short_waves_of_two_linearizations() -> None:
    problem, solution = solve(waves=0.0)
    exact, random = solution.derivatives.slopes, np.random.default_rng(4)

    def with_waves(scale: float) -> list[list[list[np.ndarray]]]:
        return [
            [[scale * part + random.normal(scale=0.01, size=part.shape) for part in row] for row in motion]
            for motion in exact
        ]

    first, second = with_waves(1.0), with_waves(1.0)
    expected = information_of(problem, solution.point, exact)[0, 0]
    assert information_of(problem, solution.point, first, second)[0, 0] == pytest.approx(expected, rel=0.2)
    assert information_of(problem, solution.point, first)[0, 0] > 1.5 * expected
    # Slopes that are short waves alone keep a tenth of their square.
    first, second = with_waves(0.0), with_waves(0.0)
    prior = np.diag(problem.prior(solution.point)[0])
    means = [
        [[0.5 * (a + b) for a, b in zip(*rows, strict=True)] for rows in zip(*motions, strict=True)]
        for motions in zip(first, second, strict=True)
    ]
    shares = np.linalg.eigvals(
        np.linalg.solve(
            information_of(problem, solution.point, means) + prior,
            information_of(problem, solution.point, first, second) + prior,
        )
    )
    assert shares.real.min() == pytest.approx(0.1, abs=0.05)


def test_deviations_are_of_noise_or_of_larger_scatter() -> None:
    information, count = np.diag([100.0, 400.0]), 10
    signs = np.where(np.arange(count) % 2, 1.0, -1.0)
    # Gradients of all motions with a variance of the information scatter as the noise predicts.
    gradient = np.stack([signs * np.sqrt(100.0 / count), 3.0 * signs * np.sqrt(400.0 / count)], axis=1)
    scatter = np.sqrt(count / (count - 1.0))
    assert scatter_deviations(information, gradient) == pytest.approx([0.1 * scatter, 3.0 * 0.05 * scatter])
    assert scatter_deviations(information, 0.1 * gradient) == pytest.approx([0.1, 0.05])
    # Four motions show no scatter.
    assert scatter_deviations(information, 9.0 * gradient[:4]) == pytest.approx([0.1, 0.05])


def test_deviations_ignore_a_common_gradient() -> None:
    information, common = np.diag([100.0, 400.0]), np.full((10, 2), 50.0)
    assert scatter_deviations(information, common) == pytest.approx([0.1, 0.05])


def test_steps_of_next_linearization_differ_from_the_used_ones() -> None:
    sigmas, p = np.full(2, 0.05), 2
    smooth = Derivatives(
        slopes=[[[np.ones((5, 3))]] * p], curvatures=[[[np.zeros((5, 3))]] * p], steps=np.array([0.052, 0.2])
    )
    following = DifferenceSteps.initial(p).next_steps(smooth, sigmas)
    assert following.steps == pytest.approx([0.7 * 0.052, 0.05])
    assert not following.is_rough
    rough = Derivatives(slopes=smooth.slopes, curvatures=[[[np.ones((5, 3))]] * p], steps=np.array([0.1, 0.3]))
    following = DifferenceSteps.initial(p).next_steps(rough, sigmas)
    assert following.is_rough
    assert following.steps == pytest.approx([0.2, ROUGH_STEP])
    # Steps over short waves stay long, although later differences are smooth.
    assert following.next_steps(smooth, sigmas).steps == pytest.approx([0.2, ROUGH_STEP])
