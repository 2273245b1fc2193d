# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of clouds, covariance by motions, and alignment, against known results."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest
from support.motion_samples import CAMERA, PIVOT, RATE, scene_of

from cloth_sim_ros.fit.alignment import (
    FIXED,
    PER_RECORDING,
    SHARED,
    Alignment,
    AlignmentModel,
    alignment_derivatives,
    cloud_residuals,
    rotation_of,
    rotation_vector,
    search_alignment,
)
from cloth_sim_ros.fit.clusters import Covariance, effective_freedoms, jackknife_covariance
from cloth_sim_ros.fit.fit import Estimate
from cloth_sim_ros.fit.noise import CAUCHY, HUBER, SQUARE, NoiseModel, initial_noise, smooth_modes
from cloth_sim_ros.fit.parameters import choose_parameters
from cloth_sim_ros.fit.recording import FitRecording
from cloth_sim_ros.fit.solver import PRIOR_SIGMA
from cloth_sim_ros.fit.text import verdict
from cloth_sim_ros.fit.trajectory import SimulatedMotion


def sheet(n: int = 8) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0.0, 0.3, n), np.linspace(0.0, 0.3, n))
    return np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)


@pytest.mark.parametrize("loss", [SQUARE, HUBER, CAUCHY])
@pytest.mark.parametrize("clouds", [False, True])
def test_weighted_residual_is_gradient_of_loss(loss: str, clouds: bool) -> None:
    modes = smooth_modes(sheet())
    random = np.random.default_rng(0)
    noise = NoiseModel(sigma=0.01, variances=np.full(modes.shape[1], 1e-5), loss=loss, has_cloud_weights=clouds)
    r = random.normal(scale=0.01, size=(len(modes), 3))
    r[3] *= 8.0
    gradient = noise.weigh(r, modes).apply(r)
    for point, axis in ((3, 0), (10, 2)):
        change = np.zeros_like(r)
        change[point, axis] = 1e-6
        up, down = (noise.weigh(r + sign * change, modes).loss for sign in (1.0, -1.0))
        assert gradient[point, axis] == pytest.approx((up - down) / 2e-6, rel=1e-2, abs=1e-2)


def test_smooth_and_white_noise_are_separated() -> None:
    modes = smooth_modes(sheet())
    random = np.random.default_rng(1)
    true = np.concatenate([[16e-6], np.full(modes.shape[1] - 1, 1e-6)])
    clouds = []
    for k in range(80):
        r = modes @ (np.sqrt(true)[:, None] * random.normal(size=(len(true), 3)))
        r += 0.003 * random.normal(size=r.shape)
        clouds.append((10.0 * r if k == 7 else r, modes))
    noise = attrs.evolve(initial_noise([r for r, _ in clouds], SQUARE, modes.shape[1]), has_cloud_weights=True)
    for _ in range(30):
        noise = noise.updated(clouds)
    assert noise.sigma == pytest.approx(0.003, rel=0.1)
    assert noise.variances[0] == pytest.approx(16e-6, rel=0.3)
    # The bad cloud has ten times the errors, therefore a hundredth of the weight.
    weights = [noise.weigh(*cloud).scale for cloud in clouds]
    assert weights[7] < 0.03 * np.median(weights)


def test_jackknife_agrees_with_refits() -> None:
    random = np.random.default_rng(2)
    designs = random.normal(size=(7, 30, 2))
    motions = 0.3 * random.normal(size=(7, 1))
    values = designs @ np.array([1.0, -2.0]) + motions + 0.1 * random.normal(size=(7, 30))
    information = np.einsum("gni,gnj->gij", designs, designs)
    moments = np.einsum("gni,gn->gi", designs, values)
    whole = np.linalg.solve(information.sum(axis=0), moments.sum(axis=0))
    gradient = np.einsum("gij,j->gi", information, whole) - moments
    problem: Any = SimpleNamespace(
        parameters=[0, 1],
        alignment=SimpleNamespace(shared_mask=lambda: np.zeros(0, dtype=bool)),
        prior=lambda _point: (np.zeros(2), np.zeros(2)),
    )
    solution: Any = SimpleNamespace(
        equations=SimpleNamespace(information=information, gradient=gradient), point=SimpleNamespace(eta=np.zeros(0))
    )
    covariance = jackknife_covariance(problem, solution, range(7))
    assert covariance.without is not None
    for g in range(7):
        remaining = [k for k in range(7) if k != g]
        refit = np.linalg.solve(information[remaining].sum(axis=0), moments[remaining].sum(axis=0))
        assert whole + covariance.without[g] == pytest.approx(refit, rel=1e-9)
    refits = whole + covariance.without
    expected = 6.0 / 7.0 * np.square(refits - refits.mean(axis=0)).sum(axis=0)
    assert np.square(covariance.deviations) == pytest.approx(expected)
    assert covariance.freedoms is not None
    assert np.all((covariance.freedoms > 3.0) & (covariance.freedoms < 6.0))


def jackknife_of(information: np.ndarray, prior: float) -> Covariance:
    """Return the covariance of motions with random gradients, at the minimum, for a prior of the parameters."""
    count, n = information.shape[:2]
    roots = np.linalg.cholesky(information + 1e-18 * np.eye(n))
    gradient = np.einsum("gij,gj->gi", roots, np.random.default_rng(4).normal(size=(count, n)))
    problem: Any = SimpleNamespace(
        parameters=list(range(n)),
        alignment=SimpleNamespace(shared_mask=lambda: np.zeros(0, dtype=bool)),
        prior=lambda _point: (np.full(n, prior), np.zeros(n)),
    )
    equations = SimpleNamespace(information=information, gradient=gradient - gradient.mean(axis=0))
    solution: Any = SimpleNamespace(equations=equations, point=SimpleNamespace(eta=np.zeros(0)))
    return jackknife_covariance(problem, solution, range(count))


@pytest.mark.parametrize("unknown", [0.0, 1e-5, 1e-2])
def test_parameter_clouds_do_not_show_has_any_value(unknown: float) -> None:
    information = np.array([np.diag([1e3, unknown / 10.0])] * 10)
    covariance = jackknife_of(information, 1.0 / PRIOR_SIGMA**2)
    assert np.isfinite(covariance.deviations).tolist() == [True, False]
    assert covariance.matrix[1, 1] > 50.0
    assert covariance.matrix[0, 1] == 0.0


def test_parameter_of_one_motion_alone_has_any_value() -> None:
    information = np.array([np.diag([1e3, 1e3 * (g == 4)]) for g in range(10)])
    covariance = jackknife_of(information, 1.0 / PRIOR_SIGMA**2)
    assert np.isfinite(covariance.deviations).tolist() == [True, False]
    assert np.isfinite(covariance.matrix).all()


def test_prior_of_search_does_not_narrow_intervals() -> None:
    # With the search's whole prior the second deviation, of 18 %, would be 0.8 % smaller.
    parts = np.array([[600.0, 10.0], [10.0, 3.0]]) * np.arange(0.6, 1.5, 0.1)[:, None, None]
    exact, used = jackknife_of(parts, 0.0), jackknife_of(parts, 1.0 / PRIOR_SIGMA**2)
    assert used.deviations == pytest.approx(exact.deviations, rel=1e-7)
    assert used.freedoms == pytest.approx(exact.freedoms, rel=1e-6)
    assert used.without is not None
    # Held-out scores are of fits with the prior.
    assert used.without[:, 1] != pytest.approx(exact.without[:, 1], rel=1e-4)  # type: ignore[index]


def test_equal_motions_have_one_freedom_less_than_motions() -> None:
    part = np.array([[3.0, 1.0], [1.0, 2.0]])
    freedoms = effective_freedoms(np.array([part] * 9), 9.0 * part, 2)
    assert freedoms == pytest.approx([8.0, 8.0])


def test_dominant_motions_take_freedom() -> None:
    information = np.array([[[100.0]], [[100.0]], *([[[1.0]]] * 8)])
    (freedom,) = effective_freedoms(information, information.sum(axis=0), 1)
    assert freedom < 2.0


def test_freedom_decides_what_is_identified() -> None:
    (parameter,) = choose_parameters(scene_of(), ["normal_drag"])
    estimate = Estimate(parameter=parameter, value=1.0, bound=0.02, is_identified=False, freedom=3.9)
    assert estimate.has_few_motions
    assert verdict(estimate, 0.025) == "NOT IDENTIFIED: too few motions (3.9 degrees of freedom)"
    assert not attrs.evolve(estimate, freedom=4.0).has_few_motions
    assert not attrs.evolve(estimate, freedom=4.0).is_within(0.025)
    assert attrs.evolve(estimate, freedom=20.0).is_within(0.025)


def moving_cloth(camera: Alignment) -> tuple[FitRecording, SimulatedMotion]:
    """Return a recording without noise and its motion: a sheet that swings and turns."""
    scene = scene_of()
    rest_shape, frames = scene.initial_positions(), np.arange(121)
    swing = 0.1 * np.sin(0.09 * frames)[:, None] * np.array([1.0, 0.4, 0.2])
    x = rest_shape + swing[:, None] + 0.05 * np.sin(0.05 * frames)[:, None, None] * rest_shape[:, [2, 0, 1]]
    v = np.gradient(x, 1.0 / RATE, axis=0)
    trajectory = SimulatedMotion(frames=frames, x=x, v=v, period=1.0 / RATE, n_missed=0, n_settle_frames=0)
    at = np.arange(40.0, 100.0, 7.0)
    recording = FitRecording(
        name="",
        scene=scene,
        state=None,
        events=((),) * 120,
        frames=at,
        seconds=at / RATE,
        clouds=tuple(camera.to_camera(trajectory.sample(at - RATE * camera.offset), PIVOT)),
    )
    return recording, trajectory


def test_offset_and_camera_pose_are_found() -> None:
    recording, trajectory = moving_cloth(CAMERA)
    model = AlignmentModel(n_recordings=1, time=SHARED, camera=SHARED, has_shift=True, pivot=tuple(PIVOT))
    clouds = [np.arange(len(recording.clouds))]
    alignment, distance = search_alignment([recording], [trajectory], clouds, model, (-0.4, 0.4))
    # The search examines offsets in steps of 0.04 s.
    assert alignment.offset == pytest.approx(CAMERA.offset, abs=0.03)
    assert alignment.rotation == pytest.approx(CAMERA.rotation, abs=0.01)
    assert distance < 0.01
    exact = cloud_residuals(recording, trajectory, CAMERA, PIVOT, clouds[0])
    assert max(float(np.abs(r).max()) for r in exact) < 1e-12


@pytest.mark.parametrize(
    ("matched", "offset", "unit"),
    [(True, 0.1, 1.0), (True, 0.2637, 1e-3), (True, 0.3985, 1.0), (False, -0.0191, 1.0)],
    ids=["particles", "small cloth", "near the bound", "bare points"],
)
def test_refined_offset_is_within_milliseconds(matched: bool, offset: float, unit: float) -> None:
    camera = attrs.evolve(CAMERA, offset=offset) if matched else Alignment(offset=offset)
    recording, trajectory = moving_cloth(camera)
    random = np.random.default_rng(5)
    clouds = tuple(unit * (cloud + random.normal(scale=0.002, size=cloud.shape)) for cloud in recording.clouds)
    recording = attrs.evolve(recording, clouds=clouds, matched=matched)
    trajectory = attrs.evolve(trajectory, x=unit * trajectory.x, v=unit * trajectory.v)
    pivot = tuple(unit * PIVOT)
    model = AlignmentModel(n_recordings=1, time=SHARED, camera=SHARED, has_shift=True, pivot=pivot)
    arguments = [recording], [trajectory], [np.arange(len(clouds))], model, (-0.4, 0.4)
    coarse, coarse_cost = search_alignment(*arguments)
    refined, cost = search_alignment(*arguments, is_refined=True)
    assert refined.offset == pytest.approx(offset, abs=0.003)
    assert cost <= coarse_cost
    assert abs(refined.offset - offset) < abs(coarse.offset - offset)


def test_fixed_offset_is_not_refined() -> None:
    recording, trajectory = moving_cloth(CAMERA)
    model = AlignmentModel(n_recordings=1, time=FIXED, camera=SHARED, has_shift=True, pivot=tuple(PIVOT))
    arguments = [recording], [trajectory], [np.arange(len(recording.clouds))], model, (0.0, 0.0)
    assert search_alignment(*arguments, is_refined=True) == search_alignment(*arguments)


def test_alignment_derivatives_are_those_of_residuals() -> None:
    recording, trajectory = moving_cloth(CAMERA)
    clouds = np.array([2, 5])
    by_shift, by_turn = alignment_derivatives(recording, trajectory, CAMERA, PIVOT, clouds, [4, 3])
    assert by_shift[0] == pytest.approx(np.tile([-1.0, 0.0, 0.0], (len(by_shift[0]), 1)), abs=1e-9)
    moved = attrs.evolve(CAMERA, rotation=(*CAMERA.rotation[:2], CAMERA.rotation[2] + 1e-3))
    before, after = (cloud_residuals(recording, trajectory, a, PIVOT, clouds)[1] for a in (CAMERA, moved))
    assert by_turn[1] == pytest.approx((after - before) / 1e-3, abs=1e-3)


def test_rotation_vector_is_inverse() -> None:
    for vector in ((0.1, -0.2, 0.3), (0.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (1.5, 1.0, -1.0)):
        assert rotation_vector(rotation_of(vector)) == pytest.approx(vector, abs=1e-8)


def test_alignment_columns_follow_kinds() -> None:
    def model(time: str, camera: str) -> AlignmentModel:
        return AlignmentModel(n_recordings=3, time=time, camera=camera, has_shift=True, pivot=(0.0, 0.0, 0.0))

    assert model(SHARED, SHARED).n_unknowns == 7
    assert model(PER_RECORDING, FIXED).n_unknowns == 3 + 3
    assert model(FIXED, PER_RECORDING).n_unknowns == 18
    separate = model(PER_RECORDING, PER_RECORDING)
    unknowns = np.zeros(separate.n_unknowns)
    separate.write_alignment(unknowns, 2, CAMERA)
    assert separate.alignment(unknowns, 2) == CAMERA
    assert separate.alignment(unknowns, 1) == Alignment()
    assert not separate.shared_mask().any()
