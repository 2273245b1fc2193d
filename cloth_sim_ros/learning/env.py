# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learning environment of one cloth: a `gymnasium.Env`.

It is for wrappers and algorithms that do not support vector environments.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.learning.vector_env import ClothVectorEnv
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable
from cloth_sim_ros.simulation.snapshot import Snapshot


class ClothEnv(Uncopyable, gymnasium.Env[Any, Any]):
    """Gymnasium environment of one cloth that grippers move: a `ClothVectorEnv` with one cloth.

    Args:
        options: options of `ClothVectorEnv` except `num_envs`, `autoreset_mode` and `copy`. Functions of the user get
            arrays of one cloth, shape (1, ...).
    """

    copy_refusal = ClothVectorEnv.copy_refusal

    def __init__(self, **options: Any) -> None:
        for name in ("num_envs", "autoreset_mode", "copy"):
            if name in options:
                raise ValueError(f"{name} is set, but ClothEnv has no such option; use ClothVectorEnv")
        self._cloths = ClothVectorEnv(1, autoreset_mode=AutoresetMode.DISABLED, **options)
        self.metadata = {"render_modes": []}
        self.scene = self._cloths.scene
        self.action_space = self._cloths.single_action_space
        self.observation_space = self._cloths.single_observation_space

    @property
    def snapshot(self) -> Snapshot:
        """Snapshot of the cloth, for rollouts or for a `Simulation` of its scene."""
        return self._cloths.snapshots[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode; return its first observation, (m, 3 or 6), and an empty dictionary."""
        super().reset(seed=seed)
        observations, _ = self._cloths.reset(seed=seed, options=options)
        return observations[0], {}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Step the cloth by an action, (grippers, 4 or 8); return observation, reward, terminated, truncated, info."""
        observations, rewards, terminations, truncations, infos = self._cloths.step(np.asarray(action)[None])
        info = {"flagged": int(infos["flagged"][0])}
        return observations[0], float(rewards[0]), bool(terminations[0]), bool(truncations[0]), info

    def close(self) -> None:
        """Stop the threads; a later step raises RuntimeError."""
        self._cloths.close()
