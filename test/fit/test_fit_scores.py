# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Misfit of a cloth beyond the error of the camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.fit.alignment import Alignment, moved_points
from cloth_sim_ros.fit.contradictions import contradiction
from cloth_sim_ros.fit.recording import FitRecording
from cloth_sim_ros.fit.scores import Score, excess_misfit, gripper_positions, misfit_doubt, pooled_score, rigid_doubt
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Target


def scores(random: np.random.Generator, scale: float, count: int = 20, spread: float = 0.5) -> list[Score]:
    """Scores of motions by a camera whose error has a size of its own in each motion [m]."""
    sizes = scale * random.uniform(1.0 - spread, 1.0 + spread, size=count)
    return [Score(distances=np.linalg.norm(random.normal(scale=size, size=(200, 3)), axis=1)) for size in sizes]


def test_gripper_is_at_its_first_target_before() -> None:
    # Without, the score of a rigid cloth was NaN.
    events = ((Target("a", (1.0, 0.0, 0.0)),), (), (Target("b", (5.0, 0.0, 0.0)), Target("a", (3.0, 0.0, 0.0))), ())
    none = np.zeros(0)
    recording = FitRecording(
        name="late", scene=Scene(), state=None, events=events, frames=none, seconds=none, clouds=()
    )
    positions = gripper_positions(recording, np.array([0.0, 1.0, 2.5, 4.0]), ["a", "b"])
    assert positions[:, 0, 0].tolist() == [1.0, 1.0, 2.0, 3.0]
    assert positions[:, 1, 0].tolist() == [5.0, 5.0, 5.0, 5.0]


def test_misfit_beyond_floor_is_its_root_mean_square() -> None:
    random = np.random.default_rng(1)
    models, floors = scores(random, 0.02), scores(random, 0.01)
    expected = np.sqrt(np.mean([m.rms**2 for m in models]) - np.mean([f.rms**2 for f in floors]))
    assert excess_misfit(models, floors) == pytest.approx(expected)


def test_misfit_of_a_right_model_is_rarely_stated() -> None:
    random = np.random.default_rng(2)
    stated = sum(excess_misfit(scores(random, 0.01), scores(random, 0.01)) is not None for _ in range(200))
    # One in a hundred on average.
    assert stated <= 8


def test_misfit_needs_five_motions_with_a_floor() -> None:
    random = np.random.default_rng(3)
    models, floors = scores(random, 0.02, 5, 0.1), scores(random, 0.001, 5, 0.1)
    assert excess_misfit(models, floors) is not None
    assert excess_misfit(models[:4], floors[:4]) is None
    assert excess_misfit(models, [*floors[:4], Score(distances=np.zeros(0))]) is None


def test_fit_of_one_motion_far_from_it_is_in_doubt() -> None:
    random = np.random.default_rng(4)
    models, floors = scores(random, 0.009, 5), scores(random, 0.0018, 5)
    assert "does not follow the recording. Its points are off by 23 mm rms, the driven" in misfit_doubt(
        models[:1], floors[:1], 1e-4
    )
    assert misfit_doubt(floors[:1], floors[1:2], 1e-4) == ""
    assert misfit_doubt(models, floors, 1e-4) == "", "excess_misfit tells"
    assert misfit_doubt([], [], 1e-4) == ""
    exact = [Score(distances=np.full(4, 1e-8))]
    assert misfit_doubt([Score(distances=np.full(20, 1e-6))], exact, 1e-4) == "", "clouds without noise"


def test_no_scores_have_no_pooled_score() -> None:
    assert pooled_score([]) is None
    together = pooled_score([Score(distances=np.array([3.0])), Score(distances=np.array([4.0, 5.0]))])
    assert together is not None
    assert together.distances.tolist() == [3.0, 4.0, 5.0]


def test_fit_worse_than_a_rigid_cloth_is_doubted() -> None:
    rng = np.random.default_rng(5)
    rigids = scores(rng, 0.02)
    assert rigid_doubt(scores(rng, 0.02), rigids) == ""
    assert rigid_doubt([], []) == ""
    assert "a cloth carried rigidly is nearer to the points, 36 mm rms, than the simulated one, 55" in rigid_doubt(
        scores(rng, 0.03), rigids
    )


def said_of(x: np.ndarray, clouds: list[np.ndarray]) -> str:
    """Return what contradicts in clouds of particles that were simulated at x, by a camera whose pose is fixed."""
    problem: Any = SimpleNamespace(
        alignment=SimpleNamespace(max_offset=0.0, alignment=lambda _eta, _k: Alignment()),
        recordings=[SimpleNamespace(name="a", clouds=clouds, matched=True)],
        used=[np.arange(len(clouds))],
    )
    residuals = [(cloud - x)[np.isfinite(cloud).all(axis=1)] for cloud in clouds]
    point: Any = SimpleNamespace(eta=None, residuals=[residuals])
    return contradiction(problem, point, [0])


@pytest.mark.parametrize(("axes", "words"), [([-1, 1, 1], "points the other way"), ([-1, -1, 1], ""), ([1, 1, 1], "")])
def test_points_nearer_when_mirrored_are_told(axes: list[float], words: str) -> None:
    random = np.random.default_rng(6)
    flat = random.uniform(size=(30, 2))
    x = np.column_stack([flat, 0.3 * flat[:, 0] * flat[:, 1]])
    cloud = x * axes + random.normal(scale=1e-3, size=x.shape)
    said = said_of(moved_points(x, cloud), [cloud])
    assert said.endswith(words)
    assert bool(said) == bool(words)


def test_flat_cloth_that_is_shifted_is_not_mirrored() -> None:
    random = np.random.default_rng(7)
    x = np.column_stack([random.uniform(size=(30, 2)), np.zeros(30)])
    assert said_of(x, [x + np.array([0.0, 0.0, 0.01]) + random.normal(scale=1e-3, size=x.shape)]) == ""


def test_exchanged_particles_are_told_from_a_cloth_that_is_off() -> None:
    random = np.random.default_rng(8)
    x = np.stack(np.meshgrid(*[np.linspace(0.0, 0.5, 6)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    clouds = [x + random.normal(scale=2e-3, size=x.shape) for _ in range(5)]
    assert said_of(x, clouds) == ""
    exchanged = [cloud[[*range(7), 20, *range(8, 20), 7, *range(21, 36)]] for cloud in clouds]
    exchanged[1][7] = np.nan
    assert said_of(x, exchanged).startswith("the points of particles 7, 20 lie at each other")
    # One column farther: each point lies at the neighbour of its particle.
    assert said_of(x, [cloud + np.array([0.1, 0.0, 0.0]) for cloud in clouds]) == ""
