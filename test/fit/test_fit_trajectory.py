# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated motions of a fit: their settling, and the runs that need none."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import pytest
from support.motion_samples import HELD, record_motions, scene_of

from cloth_sim_ros.fit import joint
from cloth_sim_ros.fit.alignment import SHARED, AlignmentModel
from cloth_sim_ros.fit.hypotheses import selections
from cloth_sim_ros.fit.joint import Derivatives, JointProblem, Point
from cloth_sim_ros.fit.joint_solver import solve_joint
from cloth_sim_ros.fit.noise import HUBER
from cloth_sim_ros.fit.parameters import acts_at_rest, choose_parameters
from cloth_sim_ros.fit.start import motion_recording
from cloth_sim_ros.fit.trajectory import TrajectoryPool

NAMES = ["shear", "damping", "normal_drag"]


@pytest.fixture(scope="module")
def problem() -> JointProblem:
    scene, recordings = scene_of(), record_motions(1)
    return JointProblem(
        recordings=[motion_recording(r, scene, selections(HELD), max_offset=0.3) for r in recordings],
        used=[np.arange(len(r.clouds)) for r in recordings],
        parameters=choose_parameters(scene, NAMES),
        alignment=AlignmentModel(n_recordings=1, time=SHARED, camera=SHARED, has_shift=True, pivot=(0.0, 0.0, 1.0)),
        pool=TrajectoryPool(1),
    )


def point_of(problem: JointProblem) -> Point:
    eta = np.zeros(problem.alignment.n_unknowns)
    first = problem.evaluate(problem.start, eta, [0], 1e-4)
    assert isinstance(first, Point)
    problem.replace_rest_states(first, [0])
    point = problem.evaluate(problem.start, eta, [0], 1e-4)
    assert isinstance(point, Point)
    return point


def test_runs_without_settling_keep_derivatives(problem: JointProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    point, steps = point_of(problem), np.full(len(NAMES), 0.03)
    quick = problem.differentiate(point, [0], steps, 1e-4, central=True)
    monkeypatch.setattr(joint, "acts_at_rest", lambda _scene, _parameter: True)
    settled = problem.differentiate(point, [0], steps, 1e-4, central=True)
    for a, b in zip(quick.slopes[0], settled.slopes[0], strict=True):
        size = np.sqrt(np.mean(np.square(np.concatenate(b))))
        assert np.abs(np.concatenate(a) - np.concatenate(b)).max() < 0.02 * size


def test_run_at_rest_repeats_motion(problem: JointProblem) -> None:
    point = point_of(problem)
    (settled,) = point.trajectories
    (again,) = problem.simulate([(0, point.theta)], 1e-4, rest_states=[settled.rest_state], are_at_rest=[True])
    assert not isinstance(again, str)
    assert again.n_settle_frames == 0
    assert np.array_equal(again.x, settled.x)
    assert np.array_equal(again.frames, settled.frames - settled.n_settle_frames)


@pytest.mark.parametrize("chord", [False, True])
def test_search_differentiates_at_each_step(
    problem: JointProblem, monkeypatch: pytest.MonkeyPatch, chord: bool
) -> None:
    start = problem.start + np.array([0.0, 0.7, -0.7])
    point = problem.evaluate(start, np.zeros(problem.alignment.n_unknowns), [0], 1e-4)
    assert isinstance(point, Point)
    places, differentiate = [], JointProblem.differentiate

    def count(self: JointProblem, at: Point, *args: Any, **settings: Any) -> Derivatives:
        places.append(at.theta)
        return differentiate(self, at, *args, **settings)

    monkeypatch.setattr(JointProblem, "differentiate", count)
    noise, steps = problem.white_noise(point, HUBER), np.full(len(NAMES), 0.03)
    result = solve_joint(problem, point, [0], noise=noise, tolerance=1e-4, max_iterations=2, steps=steps, chord=chord)
    assert not np.array_equal(result.point.theta, start)
    assert np.array_equal(places[-1], start if chord else result.point.theta)
    assert len(places) == (1 if chord else 3)


def test_wind_makes_drag_act_at_rest() -> None:
    scene = scene_of()
    acting = [acts_at_rest(scene, parameter) for parameter in choose_parameters(scene, NAMES)]
    assert acting == [True, False, False]
    windy = attrs.evolve(scene, wind=attrs.evolve(scene.wind, velocity=(0.0, 1.0, 0.0)))
    assert all(acts_at_rest(windy, parameter) for parameter in choose_parameters(windy, NAMES))
