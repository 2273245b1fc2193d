# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The environments' name in gymnasium, which knows it once this module, or one of theirs, is imported.

``gymnasium.make_vec("cloth_sim_ros.batch.registered:cloth_sim_ros/Cloth-v0")`` imports it itself.
"""

from __future__ import annotations

import gymnasium

#: Name of the environment, of one cloth and of many.
NAME = "cloth_sim_ros/Cloth-v0"
#: Steps of an episode where nothing else is asked for.
STEPS = 600

if NAME not in gymnasium.registry:
    gymnasium.register(
        NAME,
        entry_point="cloth_sim_ros.batch.env:ClothEnv",
        vector_entry_point="cloth_sim_ros.batch.vector_env:ClothVectorEnv",
        max_episode_steps=STEPS,
    )
