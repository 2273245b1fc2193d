# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments: equality with single simulations, and gymnasium's checks."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402

from cloth_sim_ros import Grasp, Pause, Scene, Simulation, Target  # noqa: E402
from cloth_sim_ros.batch import ClothEnv, ClothVectorEnv, Outcome  # noqa: E402
from cloth_sim_ros.learning.registered import NAME, STEPS  # noqa: E402

SCENE = Scene.from_parameters(
    {"cloth.resolution": [5, 6], "tolerance": 1e-3, "rate": 30.0, "material.stretch_modulus": 300.0}
)
COUNT = 5
ROOT = Path(__file__).resolve().parents[2]


def take_corner(simulation: Simulation) -> None:
    corner = simulation.positions[-1]
    simulation.advance([Target("gripper", corner), Grasp("gripper", True)])


def actions(cloths: ClothVectorEnv, steps: int, seed: int = 0) -> np.ndarray:
    cloths.action_space.seed(seed)
    return np.array([cloths.action_space.sample() for _ in range(steps)])


def low(outcome: Outcome) -> np.ndarray:
    """Return true for each cloth whose last particle is below -0.2 m, shape (N,)."""
    return np.array([state.x[2, -1] < -0.2 for state in outcome.states])


def height(outcome: Outcome) -> np.ndarray:
    return outcome.positions[:, -1, 2] + 0.1 * outcome.wrenches[:, 0, 2]


def heavier(rng: np.random.Generator, scene: Scene) -> dict[str, float] | None:
    return {"material.density": float(rng.uniform(0.1, 0.3))} if rng.random() < 0.6 else None


@pytest.fixture
def make():
    environments: list[ClothVectorEnv] = []

    def new(count: int = COUNT, **options) -> ClothVectorEnv:
        environments.append(ClothVectorEnv(count, **{"scene": SCENE, **options}))
        return environments[-1]

    yield new
    for cloths in environments:
        cloths.close()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_each_cloth_equals_single_simulation(make, threads: int) -> None:
    cloths = make(speed=np.inf, prepare=take_corner, threads=threads, frames_per_step=2, velocities=True)
    observations, _ = cloths.reset(seed=3)
    alone = [Simulation(SCENE) for _ in range(COUNT)]
    for simulation in alone:
        take_corner(simulation)
    rng = np.random.default_rng(0)
    corner = alone[0].positions[-1]
    for _ in range(6):
        acts = np.zeros((COUNT, 1, 4), dtype=np.float32)
        acts[:, 0, :3] = corner + rng.uniform(-0.1, 0.1, (COUNT, 3))
        acts[:, 0, 3] = rng.random(COUNT) > 0.3
        observations, *_ = cloths.step(acts)
        for simulation, action in zip(alone, acts, strict=True):
            for _ in range(2):
                events = [Target("gripper", action[0, :3])]
                if simulation.grippers.is_closed(0) != (action[0, 3] >= 0.5):
                    events.append(Grasp("gripper", not simulation.grippers.is_closed(0)))
                simulation.advance(events)
        assert [s.state.digest() for s in cloths.snapshots] == [s.state.digest() for s in alone]
    expected = np.array([np.hstack([s.positions, s.velocities]) for s in alone], dtype=np.float32)
    assert (observations == expected).all()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_env_equals_single_envs(make, mode: AutoresetMode) -> None:
    options = {"scene": SCENE, "reward": height, "terminated": low, "randomise": heavier, "prepare": take_corner}
    cloths = make(autoreset_mode=mode, max_episode_steps=7, **options)

    def single():
        return gymnasium.wrappers.TimeLimit(ClothEnv(**options), 7)

    singles = SyncVectorEnv([single] * COUNT, autoreset_mode=mode)
    assert cloths.observation_space == singles.observation_space
    assert cloths.action_space == singles.action_space
    assert cloths.metadata["autoreset_mode"] is mode
    assert _equal(cloths.reset(seed=7), singles.reset(seed=7))
    ended = 0
    for acts in actions(cloths, 20):
        vector_step, single_step = cloths.step(acts), singles.step(acts)
        assert _equal(vector_step, single_step)
        assert vector_step[0] in cloths.observation_space
        over = vector_step[2] | vector_step[3]
        ended += int(over.sum())
        if mode is AutoresetMode.DISABLED and over.any():
            assert _equal(*(env.reset(options={"reset_mask": over.copy()}) for env in (cloths, singles)))
    assert ended > COUNT
    singles.close()


def _equal(actual, reference) -> bool:
    """Return true if results are equal; masked entries of infos are ignored."""
    *data, info = actual
    *expected, expected_info = reference
    assert all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(data, expected, strict=True))
    assert set(info) == set(expected_info)
    for name in (name for name in info if not name.startswith("_")):
        mask = expected_info["_" + name]
        assert (info["_" + name] == mask).all()
        actual_values, expected_values = info[name], expected_info[name]
        if isinstance(actual_values, dict):
            assert all((actual_values[key][mask] == expected_values[key][mask]).all() for key in actual_values)
        else:
            assert all(np.array_equal(actual_values[i], expected_values[i]) for i in np.flatnonzero(mask))
    return True


def test_registered_envs_pass_gymnasium_checks() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions have no bounds.
        warnings.filterwarnings("ignore", message=".*Box observation space m.*imum value is -?infinity.*")
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version.*")
        env = gymnasium.make(NAME, scene=SCENE)
        check_env(env.unwrapped, skip_render_check=True)
    assert env.spec.max_episode_steps == STEPS
    env.close()
    cloths = gymnasium.make_vec(NAME, num_envs=3, scene=SCENE, max_episode_steps=2, autoreset_mode="Disabled")
    assert isinstance(cloths, ClothVectorEnv)
    assert cloths.num_envs == 3
    assert cloths.reset(seed=1)[0].shape == (3, 30, 3)
    for acts in actions(cloths, 2):
        truncated = cloths.step(acts)[3]
    assert truncated.all()
    cloths.close()


@pytest.mark.parametrize(
    "code", ["from cloth_sim_ros.learning import ClothVectorEnv", "from cloth_sim_ros.batch import ClothEnv"]
)
def test_import_registers_env_name(code: str) -> None:
    code = f"import gymnasium; {code}; print(type(gymnasium.make_vec({NAME!r}, num_envs=2)).__name__)"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], check=False, capture_output=True, text=True, cwd=ROOT
    )
    assert (done.stdout, done.returncode) == ("ClothVectorEnv\n", 0), done.stderr
    assert isinstance(gymnasium.make_vec(f"cloth_sim_ros.learning.registered:{NAME}"), ClothVectorEnv)


def test_each_cloth_has_own_seed(make) -> None:
    cloths = make(randomise=heavier)
    cloths.reset(seed=11)
    assert cloths.np_random_seed == tuple(range(11, 11 + COUNT))
    first = [snapshot.scene.material.density for snapshot in cloths.snapshots]
    assert len(set(first)) > 2
    cloths.reset(seed=[15, 14, 13, 12, 11])
    assert [snapshot.scene.material.density for snapshot in cloths.snapshots] == first[::-1]
    cloths.reset()
    assert [snapshot.scene.material.density for snapshot in cloths.snapshots] != first[::-1]


def test_reset_restores_snapshot_without_rebuild(make, monkeypatch) -> None:
    cloths = make(prepare=take_corner, threads=1)
    fresh = cloths.reset()[0]
    for acts in actions(cloths, 3):
        cloths.step(acts)
    monkeypatch.setattr("cloth_sim_ros.learning.simulation_pool.Simulation", None)
    assert (cloths.reset()[0] == fresh).all()


def test_selected_particles_share_one_array(make) -> None:
    cloths = make(particles=[29, 0, 5], copy=False)
    first, _ = cloths.reset()
    assert first.shape == (COUNT, 3, 3)
    assert (first[0] == SCENE.initial_positions()[[29, 0, 5]].astype(np.float32)).all()
    assert cloths.step(actions(cloths, 1)[0])[0] is first


def test_gripper_speed_is_limited(make) -> None:
    cloths = make(1, speed=0.3, orientations=True)
    cloths.reset()
    start = np.array([[[0.0, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0, 0.0]]])
    cloths.step(start)
    goal = start + np.array([0.3, -0.1, 0.0, 0.0, 0.0, 0.9, -0.9, 0.0])
    before = start[0, 0, :3]
    for _ in range(100):
        cloths.step(goal)
        pose = cloths.snapshots[0].state.memory["gripper.pose"][0]
        distance = np.linalg.norm(pose[:3] - before)
        assert distance <= 0.3 / 30.0 + 1e-9
        before = pose[:3]
    assert pose[:3] == pytest.approx(goal[0, 0, :3], abs=1e-6)


def bad(value: float) -> np.ndarray:
    acts = np.zeros((COUNT, 1, 4))
    acts[3, 0, 1] = value
    return acts


@pytest.mark.parametrize(
    ("acts", "message"),
    [
        (
            np.zeros((COUNT, 4)),
            r"actions have shape \(5, 4\); they must be \(5, 1, 4\), for each gripper x, y, z, grasp",
        ),
        (bad(np.nan), r"actions\[3, 0, 1\] is nan; it must be finite"),
        (bad(np.inf), r"actions\[3, 0, 1\] is inf; it must be finite"),
        (bad(50.0), r"actions\[3, 0, 1\] is 50\.0; it must be from .* clip actions"),
        ("left", "they must be numbers"),
    ],
)
def test_bad_actions_move_no_cloth(make, acts, message: str) -> None:
    cloths = make(prepare=take_corner)
    before = cloths.reset()[0]
    with pytest.raises(ValueError, match=message):
        cloths.step(acts)
    assert (cloths.step(bad(0.0))[0] != before).any()
    again = make(prepare=take_corner)
    again.reset()
    again.step(bad(0.0))
    assert [s.state.digest() for s in again.snapshots] == [s.state.digest() for s in cloths.snapshots]


def test_failed_reward_leaves_cloths_unchanged(make) -> None:
    cloths = make(reward=lambda outcome: np.full(COUNT, np.nan), copy=False)
    first = cloths.reset()[0].copy()
    digests = [s.state.digest() for s in cloths.snapshots]
    with pytest.raises(ValueError, match="reward gave nan for cloth 0; it must be finite"):
        cloths.step(bad(0.0))
    assert [s.state.digest() for s in cloths.snapshots] == digests
    # private: no copy is handed out
    assert (cloths._observations == first).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"threads": 0}, "threads is 0"),
        ({"frames_per_step": 1.5}, "frames_per_step is 1.5"),
        ({"max_episode_steps": -1}, "max_episode_steps is -1"),
        ({"particles": [30]}, "there are 30, from index 0"),
        ({"particles": []}, "particles are"),
        ({"speed": 0.0}, "speed is 0.0 m/s"),
        ({"workspace": [[0, 0, 0], [1, 1, -1]]}, "workspace is"),
        ({"autoreset_mode": "never"}, "it must be one of NextStep, SameStep, Disabled"),
        ({"scene": {"cloth.resolutoin": [3, 3]}}, "cloth.resolutoin"),
        ({"scene": {"grippers": [""]}}, "no grippers"),
        ({"scene": 3}, "scene is 3"),
    ],
)
def test_bad_options_are_refused(options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ClothVectorEnv(**{"scene": SCENE, **options})


def test_calls_in_wrong_order_are_refused(make) -> None:
    cloths = make(autoreset_mode="Disabled", max_episode_steps=1)
    with pytest.raises(RuntimeError, match=r"call reset\(\) before the first step"):
        cloths.step(bad(0.0))
    with pytest.raises(ValueError, match="seed has 2 numbers"):
        cloths.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="options has 'mask'"):
        cloths.reset(options={"mask": 1})
    with pytest.raises(ValueError, match="reset_mask"):
        cloths.reset(options={"reset_mask": np.zeros(COUNT, dtype=bool)})
    cloths.reset()
    cloths.step(bad(0.0))
    with pytest.raises(RuntimeError, match="the episode of cloth 0 is over"):
        cloths.step(bad(0.0))


def test_closed_environment_is_refused(make) -> None:
    cloths = make()
    cloths.reset()
    cloths.close()
    cloths.close()
    with pytest.raises(RuntimeError, match="the environment is closed"):
        cloths.step(bad(0.0))
    with pytest.raises(RuntimeError, match="the environment is closed"):
        cloths.reset()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_failed_autoreset_undoes_the_whole_step(make, mode: str) -> None:
    failing: list[bool] = []

    def randomise(rng: np.random.Generator, scene: Scene) -> dict[str, float]:
        if failing:
            raise RuntimeError("no parameters")
        return {"material.density": 0.2}

    cloths = make(2, randomise=randomise, max_episode_steps=2, autoreset_mode=mode, threads=1)
    reference = make(2, randomise=randomise, max_episode_steps=2, autoreset_mode=mode, threads=1)
    commands = actions(cloths, 6)[:, :2]
    for environment in (cloths, reference):
        environment.reset(seed=1)
    for step, command in enumerate(commands):
        failing[:] = [True]
        try:
            answer = cloths.step(command)
        except RuntimeError:
            failing.clear()
            answer = cloths.step(command)
        failing.clear()
        expected = reference.step(command)
        assert _equal(answer, expected), step


@pytest.mark.parametrize("name", ["observations", "positions", "actions", "wrenches", "elapsed"])
def test_reward_cannot_write_its_outcome(make, name: str) -> None:
    def reward(outcome: Outcome) -> np.ndarray:
        getattr(outcome, name)[:] = 0
        return np.zeros(COUNT)

    cloths = make(reward=reward)
    cloths.reset()
    commands = actions(cloths, 1)[0]
    with pytest.raises(ValueError, match="read-only"):
        cloths.step(commands)
    assert commands.flags.writeable


def test_seeds_of_numpy_are_taken_and_bad_ones_refused(make) -> None:
    cloths = make()
    cloths.reset(seed=np.arange(COUNT))
    assert cloths.np_random_seed == tuple(range(COUNT))
    for seed in ([7, 7, 7, -1, 7], [7, 7, 7, 1.5, 7], "12345", 1.5):
        with pytest.raises(ValueError, match="seed"):
            cloths.reset(seed=seed)
        assert cloths.np_random_seed == tuple(range(COUNT))


def test_paused_start_is_refused() -> None:
    with pytest.raises(ValueError, match="prepare left the simulation paused"):
        ClothVectorEnv(scene=SCENE, prepare=lambda simulation: simulation.advance([Pause(True)]))


def test_randomised_scene_must_have_same_shape(make) -> None:
    cloths = make(randomise=lambda rng, scene: {"cloth.resolution": [4, 4]})
    with pytest.raises(ValueError, match="actions and observations of all cloths must be alike"):
        cloths.reset()


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, pickle.dumps])
def test_environment_copy_is_refused(make, again) -> None:
    for cloths in (make(), ClothEnv(scene=SCENE, threads=1)):
        with pytest.raises(TypeError, match="make another environment"):
            again(cloths)
