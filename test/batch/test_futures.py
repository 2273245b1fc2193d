# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rollouts: each future is what a simulation alone does, on any number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros import Grasp, Scene, SetParameters, Simulation, Target
from cloth_sim_ros.batch import rollouts

SCENE = Scene.from_parameters({"cloth.resolution": [5, 6], "tolerance": 1e-3, "grippers": ["left", "right"]})
FUTURES, FRAMES = 5, 4


@pytest.fixture(scope="module")
def held() -> Simulation:
    """A cloth whose last corner is held by the left gripper, under other gravity than its scene began with."""
    simulation = Simulation(SCENE)
    simulation.advance([Target("left", simulation.positions[-1]), Grasp("left", True)])
    simulation.advance([Target("right", simulation.positions[-6]), SetParameters({"gravity": [0.0, 0.5, -9.0]})])
    return simulation


def ways(simulation: Simulation) -> np.ndarray:
    rng = np.random.default_rng(1)
    acts = np.zeros((FUTURES, FRAMES, 2, 4))
    acts[..., :3] = simulation.grippers.poses()[:, :3] + rng.uniform(-0.05, 0.05, (FUTURES, FRAMES, 2, 3))
    acts[..., 3] = rng.random((FUTURES, FRAMES, 2)) > 0.4
    return acts


@pytest.mark.parametrize("threads", [1, 2, 3, None])
def test_futures_are_what_simulations_alone_do(held: Simulation, threads: int | None) -> None:
    taken = held.snapshot()
    digest, acts = taken.state.digest(), ways(held)
    done = rollouts(taken, acts, velocities=True, threads=threads)
    assert done.positions.shape == done.velocities.shape == (FUTURES, FRAMES, 30, 3)
    for k in range(FUTURES):
        alone = Simulation(SCENE)
        alone.restore(taken)
        for t in range(FRAMES):
            events = [Target(name, acts[k, t, g, :3]) for g, name in enumerate(SCENE.gripper_names)]
            events += [
                Grasp(name, acts[k, t, g, 3] >= 0.5)
                for g, name in enumerate(SCENE.gripper_names)
                if alone.grippers.is_closed(g) != (acts[k, t, g, 3] >= 0.5)
            ]
            frame = alone.advance(events)
            assert (done.positions[k, t] == alone.positions.astype(np.float32)).all()
            assert (done.velocities[k, t] == alone.velocities.astype(np.float32)).all()
            assert (done.wrenches[k, t] == frame.wrenches).all()
        assert done.ends[k].state.digest() == alone.state.digest()
    assert taken.state.digest() == held.state.digest() == digest


def test_they_go_on_from_their_ends_and_tell_of_chosen_particles(held: Simulation) -> None:
    acts = ways(held)
    whole = rollouts(held.snapshot(), acts, particles=[29, 3])
    first = rollouts(held.snapshot(), acts[:1, :2])
    then = rollouts(first.ends[0], acts[:1, 2:], particles=[29, 3])
    assert whole.velocities is None
    assert (then.positions == whole.positions[:1, 2:]).all()
    assert then.ends[0].state.digest() == whole.ends[0].state.digest()


def test_grippers_turn_where_orientations_are_given(held: Simulation) -> None:
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
        ((2, 3, 1, 4), 0.0, {}, r"they must be \(2, 3, 2, 4\), of each gripper x, y, z, grasp"),
        ((2, 3, 2, 8), 0.0, {}, r"actions\[0, 0, 0\] has a quaternion without length"),
        ((2, 3, 2, 4), np.nan, {}, r"actions\[0, 0, 0, 0\] is nan"),
        ((2, 3, 2, 4), 2e4, {}, r"actions\[0, 0, 0, 0\] is 20000\.0 m; at most 10000 m away"),
        ((2, 3, 2, 4), 0.0, {"threads": -1}, "threads is -1"),
        ((2, 3, 2, 4), 0.0, {"particles": [-1]}, "particles name particle -1"),
        ((2, 3, 2, 4), 0.0, {"particles": [0.5]}, "give a list of numbers of particles"),
    ],
)
def test_bad_input_is_told(held: Simulation, shape, value, options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollouts(held.snapshot(), np.full(shape, value), **options)


def test_no_futures_and_no_frames_are_none(held: Simulation) -> None:
    assert rollouts(held.snapshot(), np.zeros((0, 3, 2, 4))).positions.shape == (0, 3, 30, 3)
    still = rollouts(held.snapshot(), np.zeros((2, 0, 2, 4)))
    assert still.ends[1].state.digest() == held.state.digest()
