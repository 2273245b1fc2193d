# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The environments' names in gymnasium, which calls this when it is imported (entry point ``gymnasium.envs``)."""

from __future__ import annotations

#: Name of the environment.
NAME = "cloth_sim_ros/Cloth-v0"
#: Steps of an episode where nothing else is asked for.
STEPS = 600


def register() -> None:
    """Let gymnasium know the environments, unless it does."""
    import gymnasium

    if NAME not in gymnasium.registry:
        gymnasium.register(
            NAME,
            entry_point="cloth_sim_ros.batch.env:ClothEnv",
            vector_entry_point="cloth_sim_ros.batch.vector_env:ClothVectorEnv",
            max_episode_steps=STEPS,
        )
