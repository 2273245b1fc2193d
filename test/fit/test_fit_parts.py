# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a fit against known results: least squares, bounds, confounding, distances."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest

from cloth_sim_ros.fit import solver as fit_solver
from cloth_sim_ros.fit.information import confounded_directions, correlation
from cloth_sim_ros.fit.parameters import FitError, FitParameter, choose_parameters, scene_with
from cloth_sim_ros.fit.recording import FitRecording
from cloth_sim_ros.fit.runs import FitRun, interpolate, mean_offset
from cloth_sim_ros.fit.solver import FitProblem, fisher_information, minimize, standard_deviations
from cloth_sim_ros.fit.surface import signed_distances
from cloth_sim_ros.fit.text import describe_direction
from cloth_sim_ros.fit.windows import solve_windows
from cloth_sim_ros.physics.model.sheets.surface import grid_triangles
from cloth_sim_ros.scene.scene import Scene


def sought(*names: str) -> list[FitParameter]:
    return [FitParameter(name=name, unit="", start=1.0, minimum=0.01, maximum=100.0) for name in names]


class Decay:
    """Model y = a exp(-b t) in place of a cloth: two parameters, one cloud per time."""

    def __init__(self, measured: np.ndarray, times: np.ndarray) -> None:
        self.measured, self.times, self.parameters, self.n_runs = measured, times, sought("a", "b"), 0

    def residuals(self, a: float, b: float, count: int) -> np.ndarray:
        return self.measured[:count] - a * np.exp(-b * self.times[:count])

    def compute_residuals(self, runs: Sequence[FitRun]) -> list[Any]:
        self.n_runs += len(runs)
        return [self.residuals(*run.values, run.n_clouds) for run in runs]


@pytest.fixture
def decay() -> Decay:
    times = np.linspace(0.0, 2.0, 200)
    noise = np.random.default_rng(1).normal(scale=0.02, size=200)
    return Decay(3.0 * np.exp(-0.7 * times) + noise, times)


def problem_of(runs: Any, **further: Any) -> FitProblem:
    return FitProblem(pool=runs, offsets=np.arange(201), on_progress=lambda _: None, **{"sigma": None, **further})


def test_least_squares_agrees_with_scipy(decay: Decay) -> None:
    from scipy.optimize import least_squares

    problem = problem_of(decay)
    start = problem.linearize(problem.start, np.full(2, 0.01), 200, 1e-5)
    minimum = minimize(problem, start, 200, 1e-5)
    reference = least_squares(lambda x: decay.residuals(*x, 200), [1.0, 1.0], xtol=1e-12, ftol=1e-12)
    bounds = standard_deviations(fisher_information(minimum, problem.deviation(minimum.r)))
    # Steps below a tenth of the bound count as converged; the prior's effect is far smaller.
    assert np.all(np.abs(minimum.theta - np.log(reference.x)) < 0.1 * bounds)
    covariance = np.linalg.inv(reference.jac.T @ reference.jac) * 2.0 * reference.cost / 198
    assert bounds == pytest.approx(np.sqrt(np.diag(covariance)) / reference.x, rel=1e-2)


def test_windows_reach_end_of_linear_motion(decay: Decay) -> None:
    windows = solve_windows(problem_of(decay), decay.times)
    assert [window.n_clouds for window in windows.windows] == sorted({window.n_clouds for window in windows.windows})
    assert windows.windows[-1].n_clouds == 200
    assert not windows.reason
    assert np.exp(windows.windows[-1].linearization.theta) == pytest.approx([3.0, 0.7], rel=0.02)


def test_unexplained_later_clouds_are_not_used(decay: Decay) -> None:
    decay.measured[130:] += 0.5
    windows = solve_windows(problem_of(decay), decay.times)
    assert windows.windows[-1].n_clouds < 130
    assert "the model does not explain" in windows.reason
    assert "follows only a part of the recording" in windows.doubt
    assert np.exp(windows.windows[-1].linearization.theta) == pytest.approx([3.0, 0.7], rel=0.1)


def test_misfit_of_added_clouds_is_found(decay: Decay) -> None:
    # The last half has 1.7 times the noise, the whole window less than 1.5 times.
    random = np.random.default_rng(7)
    decay.measured[101:] += random.choice([-1.0, 1.0], 99) * 0.0275
    windows = solve_windows(problem_of(decay), decay.times)
    assert windows.windows[-1].n_clouds <= 101
    assert windows.doubt


def test_slowly_growing_misfit_is_found(decay: Decay) -> None:
    # Each window's residuals are 1.4 times those of the previous window.
    for begin in (26, 51, 101):
        decay.measured[begin:] += np.random.default_rng(begin).normal(scale=0.028, size=200 - begin)
    assert solve_windows(problem_of(decay), decay.times).doubt


class Turning(Decay):
    """Model y = sin(a exp(4 t)) / 3 + b: later oscillations depend on the parameter too steeply."""

    def residuals(self, a: float, b: float, count: int) -> np.ndarray:
        return self.measured[:count] - np.sin(a * np.exp(4.0 * self.times[:count])) / 3.0 - b


@pytest.mark.parametrize(("jump", "doubted"), [(0.0, False), (1.5, True)])
def test_end_by_curvature_is_doubted_by_later_clouds(jump: float, doubted: bool) -> None:
    times = np.linspace(0.0, 2.0, 200)
    turning = Turning(np.random.default_rng(1).normal(scale=0.02, size=200), times)
    turning.measured -= turning.residuals(1.02, 0.99, 200) - turning.measured
    turning.measured[110:] += jump
    windows = solve_windows(problem_of(turning), times)
    assert "too steeply" in windows.reason or jump
    assert windows.windows[-1].n_clouds < 200
    assert bool(windows.doubt) == doubted


def test_unconverged_search_is_doubted(decay: Decay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_solver, "MAX_ITERATIONS", 1)
    decay.parameters = [attrs.evolve(parameter, start=0.05) for parameter in decay.parameters]
    windows = solve_windows(problem_of(decay), decay.times[:30])
    assert "the search did not converge" in windows.doubt


def test_failed_simulation_is_reported(decay: Decay) -> None:
    decay.compute_residuals = lambda runs: ["it burst"] * len(runs)  # type: ignore[method-assign]
    with pytest.raises(FitError, match="starting values: it burst"):
        solve_windows(problem_of(decay), decay.times)


def test_bounds_are_infinite_only_for_unidentified() -> None:
    fisher = np.array([[4e4, 1e3], [1e3, 1e4]])
    assert standard_deviations(fisher) == pytest.approx(np.sqrt(np.diag(np.linalg.inv(fisher))))
    assert standard_deviations(np.diag([1e4, 0.0])).tolist() == [0.01, np.inf]
    assert np.isinf(standard_deviations(1e6 * np.array([[1.0, -1.0], [-1.0, 1.0]]))).all()


@pytest.mark.parametrize(("sign", "word"), [(-1.0, "ratio"), (1.0, "product")])
def test_confounded_parameters_are_named(sign: float, word: str) -> None:
    # Clouds that depend on x / y alone identify the ratio: raising both changes no cloud.
    fisher = np.zeros((3, 3))
    fisher[:2, :2] = 1e6 * np.array([[1.0, sign], [sign, 1.0]])
    fisher[2, 2] = 1e6
    (direction,) = confounded_directions(sought("x", "y", "z"), fisher, 0.025)
    assert {parameter.name for parameter in direction.parameters} == {"x", "y"}
    assert f"only their {word} is" in describe_direction(direction, 0.025)
    assert not list(confounded_directions(sought("x", "y", "z"), fisher + 1e5 * np.eye(3), 0.025))


def test_single_unidentified_parameter_is_alone() -> None:
    (direction,) = confounded_directions(sought("x", "y"), np.diag([1e6, 1.0]), 0.025)
    assert direction.is_single
    assert "hardly depend" in describe_direction(direction, 0.025)
    (direction,) = confounded_directions(sought("x", "y"), np.diag([1e6, 1e-4]), 0.025)
    assert describe_direction(direction, 0.025).endswith("its standard deviation is at least 1000 %.")


def test_signed_distance_of_plane_and_sphere() -> None:
    rows, columns = 4, 5
    x, y = np.meshgrid(np.arange(columns) * 0.1, np.arange(rows) * 0.1)
    sheet = np.stack([x.ravel(), y.ravel(), np.zeros(rows * columns)], axis=1)
    triangles = grid_triangles(rows, columns, "alternating")
    random = np.random.default_rng(0)
    points = random.uniform([-0.05, -0.05, -0.1], [0.45, 0.35, 0.1], size=(200, 3))
    signed_flat = signed_distances(points, sheet, triangles)
    up = np.sign(np.cross(*(sheet[triangles[0, 1:]] - sheet[triangles[0, 0]]))[2])
    assert signed_flat == pytest.approx(up * points[:, 2], abs=1e-12)
    # For a sphere it is the distance from the centre minus the radius, except for the triangles' sagitta.
    turn, rise = np.meshgrid(np.linspace(-0.6, 0.6, 25), np.linspace(-0.6, 0.6, 25))
    ball = np.stack([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], axis=-1).reshape(-1, 3)
    out = ball.reshape(25, 25, 3)[5:20, 5:20].reshape(-1, 3) * random.uniform(0.9, 1.1, size=(225, 1))
    signed = signed_distances(out, ball, grid_triangles(25, 25, "alternating"))
    # The sagitta of a cell of 0.05 on a radius of 1 is 0.05^2 / 4.
    assert np.abs(signed) == pytest.approx(np.abs(np.linalg.norm(out, axis=1) - 1.0), abs=1e-3)
    assert signed_distances(np.empty((0, 3)), sheet, triangles).shape == (0,)


def test_interpolation_is_exact_for_cubics() -> None:
    period, s = 0.02, 0.3
    cubic = np.polynomial.Polynomial([1.0, -2.0, 30.0, 400.0])
    ends = [np.full((3, 1), value) for t in (0.0, period) for value in (cubic(t), cubic.deriv()(t))]
    assert interpolate(*ends, s, period)[0, 0] == pytest.approx(cubic(s * period), rel=1e-12)


def test_mean_offset_is_mean_of_residuals() -> None:
    r = np.random.default_rng(0).normal(size=(40, 3)) + np.array([1.0, 2.0, 3.0])
    assert mean_offset(r.ravel()) == pytest.approx(r.mean(axis=0))


def test_correlation_of_successive_residuals() -> None:
    random = np.random.default_rng(0)
    clouds = tuple(np.zeros((50, 3)) for _ in range(40))
    recording: Any = SimpleNamespace(matched=True, clouds=clouds)
    white = random.normal(size=(40, 150))
    assert correlation(recording, white.ravel(), 40) < 0.05
    same = np.repeat(random.normal(size=(1, 150)), 40, axis=0)
    # Half of each residual stays: a correlation of one half.
    assert correlation(recording, (white + same).ravel(), 40) == pytest.approx(0.5, abs=0.1)


def test_friction_entries_keep_their_ratio() -> None:
    scene = Scene.from_parameters({"contact.self": True, "contact.friction": [0.4, 0.3]})
    (friction,) = choose_parameters(scene, ["friction"])
    assert (friction.name, friction.start) == ("contact.friction", 0.4)
    changed = scene_with(scene, [friction], [0.8])
    assert changed.contact.friction == pytest.approx((0.8, 0.6))
    assert attrs.evolve(changed, contact=scene.contact) == scene


def test_bending_name_follows_scene_model() -> None:
    crossed = Scene.from_parameters({"bending.model": "crossed", "material.bending_modulus": 1e-4})
    assert choose_parameters(Scene.from_parameters({}), ["bending"])[0].name == "bending.stiffness"
    assert choose_parameters(crossed, ["bending"])[0].name == "material.bending_modulus"


def test_recording_part_selects_clouds_and_events() -> None:
    recording = FitRecording(
        name="",
        scene=Scene.from_parameters({}),
        state=None,
        events=((),) * 10,
        frames=np.arange(1.0, 11.0),
        seconds=np.arange(1.0, 11.0) / 10.0,
        clouds=tuple(np.full((1, 3), float(k)) for k in range(10)),
    )
    part = recording.part(until=0.5, every=2)
    assert part.seconds.tolist() == [0.1, 0.3, 0.5]
    assert [cloud[0, 0] for cloud in part.clouds] == [0.0, 2.0, 4.0]
    assert len(part.events) == 5


def test_weft_bending_is_that_of_the_bending_model() -> None:
    axial = Scene.from_parameters({"bending.stiffness_weft": 2.0})
    for name in ("bending_weft", "bending.stiffness_weft"):
        assert [parameter.name for parameter in choose_parameters(axial, [name])] == ["bending.stiffness_weft"]
    moduli = {"bending.model": "crossed", "material.bending_modulus": 1e-5, "material.bending_modulus_weft": 2e-5}
    (parameter,) = choose_parameters(Scene.from_parameters(moduli), ["bending_weft"])
    assert (parameter.name, parameter.start) == ("material.bending_modulus_weft", 2e-5)


def test_start_beyond_the_range_is_refused_by_its_own_value() -> None:
    with pytest.raises(FitError, match=r"material\.density begins at 1e-10 kg/m\^2; it must be from 1e-09"):
        choose_parameters(Scene(), ["density"], {"density": 1e-10})
