# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rollouts equal single simulations on any number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros import Grasp, Pause, Scene, SetParameters, Simulation, Target
from cloth_sim_ros.batch import rollouts

SCENE = Scene.from_parameters({"cloth.resolution": [5, 6], "tolerance": 1e-3, "grippers": ["left", "right"]})
N_ROLLOUTS, FRAMES = 5, 4


@pytest.fixture(scope="module")
def held() -> Simulation:
    """Simulation whose left gripper holds the last corner, with another gravity than its scene."""
    simulation = Simulation(SCENE)
    simulation.advance([Target("left", simulation.positions[-1]), Grasp("left", True)])
    simulation.advance([Target("right", simulation.positions[-6]), SetParameters({"gravity": [0.0, 0.5, -9.0]})])
    return simulation


def random_actions(simulation: Simulation) -> np.ndarray:
    rng = np.random.default_rng(1)
    acts = np.zeros((N_ROLLOUTS, FRAMES, 2, 4))
    acts[..., :3] = simulation.grippers.poses()[:, :3] + rng.uniform(-0.05, 0.05, (N_ROLLOUTS, FRAMES, 2, 3))
    acts[..., 3] = rng.random((N_ROLLOUTS, FRAMES, 2)) > 0.4
    return acts


@pytest.mark.parametrize("workers", [{"threads": 1}, {"threads": 2}, {"threads": 3}, {}, {"processes": 2}], ids=str)
def test_rollouts_equal_single_simulations(held: Simulation, workers: dict[str, int]) -> None:
    snapshot = held.snapshot()
    digest, acts = snapshot.state.digest(), random_actions(held)
    result = rollouts(snapshot, acts, velocities=True, **workers)
    assert result.positions.shape == result.velocities.shape == (N_ROLLOUTS, FRAMES, 30, 3)
    for k in range(N_ROLLOUTS):
        alone = Simulation(SCENE)
        alone.restore(snapshot)
        for t in range(FRAMES):
            events = [Target(name, acts[k, t, g, :3]) for g, name in enumerate(SCENE.gripper_names)]
            events += [
                Grasp(name, acts[k, t, g, 3] >= 0.5)
                for g, name in enumerate(SCENE.gripper_names)
                if alone.grippers.is_closed(g) != (acts[k, t, g, 3] >= 0.5)
            ]
            frame = alone.advance(events)
            assert (result.positions[k, t] == alone.positions.astype(np.float32)).all()
            assert (result.velocities[k, t] == alone.velocities.astype(np.float32)).all()
            assert (result.wrenches[k, t] == frame.wrenches).all()
        assert result.ends[k].state.digest() == alone.state.digest()
    assert snapshot.state.digest() == held.state.digest() == digest


def test_rollouts_continue_with_selected_particles(held: Simulation) -> None:
    acts = random_actions(held)
    whole = rollouts(held.snapshot(), acts, particles=[29, 3])
    first = rollouts(held.snapshot(), acts[:1, :2])
    second = rollouts(first.ends[0], acts[:1, 2:], particles=[29, 3])
    assert whole.velocities is None
    assert (second.positions == whole.positions[:1, 2:]).all()
    assert second.ends[0].state.digest() == whole.ends[0].state.digest()


def test_orientations_turn_grippers(held: Simulation) -> None:
    acts = np.zeros((1, 2, 2, 8))
    acts[..., :3], acts[..., 6], acts[..., 7] = held.grippers.poses()[:, :3], 2.0, [1.0, 0.0]
    acts[0, 1, 0, 3:7] = [0.0, 0.0, 3.0, 3.0]
    poses = rollouts(held.snapshot(), acts).ends[0].state.memory["gripper.pose"]
    assert poses[0, 3:] == pytest.approx([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert poses[1, 3:] == pytest.approx([0.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("shape", "value", "options", "message"),
    [
        ((2, 3, 4), 0.0, {}, r"actions have shape \(2, 3, 4\); they must be \(K, T, grippers, 4\)"),
        ((2, 3, 1, 4), 0.0, {}, r"they must be \(2, 3, 2, 4\), for each gripper x, y, z, grasp"),
        ((2, 3, 2, 8), 0.0, {}, r"actions\[0, 0, 0\] has a quaternion without length"),
        ((2, 3, 2, 4), np.nan, {}, r"actions\[0, 0, 0, 0\] is nan"),
        ((2, 3, 2, 4), 2e4, {}, r"actions\[0, 0, 0, 0\] is 20000\.0 m; the limit is 10000 m"),
        ((2, 3, 2, 4), 0.0, {"threads": -1}, "threads is -1"),
        ((2, 3, 2, 4), 0.0, {"processes": 0}, "processes is 0; it must be a whole number of at least 1"),
        ((2, 3, 2, 4), 0.0, {"threads": 2, "processes": 2}, "threads is 2 and processes is 2; give one of them"),
        ((2, 3, 2, 4), 0.0, {"particles": [-1]}, "particles name particle -1"),
        ((2, 3, 2, 4), 0.0, {"particles": [0.5]}, "give a list of particle indices"),
    ],
)
def test_bad_input_is_refused(held: Simulation, shape, value, options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollouts(held.snapshot(), np.full(shape, value), **options)


def test_processes_accept_other_scenes_and_states(held: Simulation) -> None:
    coarse = Simulation(Scene.from_parameters({"cloth.resolution": [4, 4], "grippers": ["left", "right"]}))
    for simulation in (held, coarse, held):
        acts = random_actions(held)[:2]
        in_threads, in_processes = (
            rollouts(simulation.snapshot(), acts),
            rollouts(simulation.snapshot(), acts, processes=1),
        )
        assert [end.state.digest() for end in in_threads.ends] == [end.state.digest() for end in in_processes.ends]


def test_empty_rollouts_have_empty_results(held: Simulation) -> None:
    for workers in ({}, {"processes": 1}):
        assert rollouts(held.snapshot(), np.zeros((0, 3, 2, 4)), **workers).positions.shape == (0, 3, 30, 3)
    still = rollouts(held.snapshot(), np.zeros((2, 0, 2, 4)))
    assert still.ends[1].state.digest() == held.state.digest()


def test_snapshot_must_be_of_a_running_simulation(held: Simulation) -> None:
    acts = random_actions(held)
    with pytest.raises(ValueError, match=r"give one of a simulation, simulation\.snapshot\(\)"):
        rollouts(held, acts)  # type: ignore[arg-type]
    paused = Simulation(held.scene)
    paused.advance([Pause(True)])
    with pytest.raises(ValueError, match="the snapshot is of a paused simulation"):
        rollouts(paused.snapshot(), acts)


def test_number_of_threads_may_be_of_numpy(held: Simulation) -> None:
    acts = random_actions(held)[:2, :2]
    assert rollouts(held.snapshot(), acts, threads=np.int64(2)).positions.shape[:2] == (2, 2)  # type: ignore[arg-type]
