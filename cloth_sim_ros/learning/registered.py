# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Registration of the environments in gymnasium.

Importing this module or an environment's module registers the name. The call
``gymnasium.make_vec("cloth_sim_ros.learning.registered:cloth_sim_ros/Cloth-v0")`` imports this module.
"""

from __future__ import annotations

import gymnasium

#: Name of the single and of the vector environment.
NAME = "cloth_sim_ros/Cloth-v0"
#: Default number of steps of an episode.
STEPS = 600

if NAME not in gymnasium.registry:
    gymnasium.register(
        NAME,
        entry_point="cloth_sim_ros.learning.env:ClothEnv",
        vector_entry_point="cloth_sim_ros.learning.vector_env:ClothVectorEnv",
        max_episode_steps=STEPS,
    )
