# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Linear fits of swings: clouds of lossy recordings, best alignment, halves of a set of motions."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy.stats import t

from cloth_sim_ros.fit.clusters import Covariance
from cloth_sim_ros.fit.motions_result import TOLERANCE
from cloth_sim_ros.fit.parameters import choose_parameters
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from validation.reality import swing_samples as samples
from validation.reality.linear_fits import HeldOut, LinearFit, LossyClouds, aligned, prepare
from validation.reality.other_models import Halves, halves_of


def test_clouds_after_a_late_start_are_compared_at_their_times() -> None:
    # The first cloud that is not lost shows the moving cloth, so that the recording starts at its first pose.
    motion, seed = 9, 2
    frames = samples.exact_motion(motion, samples.TRUTH)
    assert samples.record_motion(motion, frames, seed).times[0] > 0.9
    parameters = choose_parameters(samples.swing_scene({}), list(samples.TRUTH))
    with TrajectoryPool(1) as pool:
        problem = prepare([samples.complete_recording(motion, frames)], parameters, pool)
        problem.offsets = (samples.DELAY - 0.1, samples.DELAY + 0.1)
        start = problem.evaluate(problem.start, np.zeros(problem.alignment.n_unknowns), [0], TOLERANCE)
        assert not isinstance(start, str)
        truth = aligned(problem, start)
        exact = {motion: frames}
        point = attrs.evolve(truth, trajectories={motion: truth.trajectories[0]})
        problem.recordings = {motion: problem.recordings[0]}
        clouds = LossyClouds.at_truth(problem, point, exact, seed, [motion])
    assert problem.alignment.alignment(truth.eta, 0).offset == pytest.approx(samples.DELAY, abs=2e-3)
    errors = np.concatenate([np.linalg.norm(r, axis=1) for r in clouds.point.residuals[0]])
    sizes = samples.NOISE * samples.noise_amplitudes(motion, seed)[clouds.rows[0][0]]
    assert np.sqrt(np.mean(np.square(errors))) < 1.5 * np.sqrt(np.mean(np.square(sizes)))


def test_halves_hold_each_motion_once() -> None:
    first, second = halves_of(41, 3)
    assert (len(first), len(second)) == (20, 21)
    assert sorted([*first, *second]) == list(range(41))
    assert halves_of(41, 4)[0] != first


def fit_with(error: float, deviation: float, freedom: float) -> LinearFit:
    covariance = Covariance(
        matrix=np.array([[deviation**2]]),
        deviations=np.array([deviation]),
        alignment_deviations=np.zeros(0),
        freedoms=np.array([freedom]),
        has_intervals=True,
    )
    none = np.zeros(1)
    return LinearFit(errors=np.array([error]), eta=none, covariance=covariance, best=none)


def test_halves_agree_within_the_interval_of_their_difference() -> None:
    held_out = HeldOut(models=[], floors=[], rms=0.0, rigid=0.0, floor=0.0)
    # Equal variances add their degrees of freedom.
    reach = t.ppf(0.95, 12.0) * np.sqrt(2.0) * 0.1
    for factor, expected in ((0.99, True), (1.01, False)):
        halves = Halves(
            first=fit_with(0.5, 0.1, 6.0), second=fit_with(0.5 - factor * reach, 0.1, 6.0), held_out=held_out
        )
        assert halves.are_consistent(0.9).tolist() == [expected]
