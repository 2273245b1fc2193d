# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many cloths at once: learning environments and rollouts.

Each cloth is a `simulation.Simulation` and gives the same bits as a live one. `vector_env` steps N cloths on all
cores; `parallel_rollouts` plays many action sequences from one state. gymnasium is imported at its first use. Begin
with `vector_env`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloth_sim_ros.learning.env import ClothEnv
    from cloth_sim_ros.learning.outcome import Outcome
    from cloth_sim_ros.learning.parallel_rollouts import Trajectories, rollouts
    from cloth_sim_ros.learning.vector_env import ClothVectorEnv

_MODULES = {
    "ClothEnv": "env",
    "ClothVectorEnv": "vector_env",
    "Outcome": "outcome",
    "Trajectories": "parallel_rollouts",
    "rollouts": "parallel_rollouts",
}

__all__ = ["ClothEnv", "ClothVectorEnv", "Outcome", "Trajectories", "rollouts"]


def __getattr__(name: str) -> Any:
    # Import a public name's module at its first use.
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
