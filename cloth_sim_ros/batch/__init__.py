# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many simulations: studies, datasets, learning environments, rollouts, parameter fits.

Each simulation is a `simulation.Simulation` and gives the same bits as a live one. Start with `vector_env` (learning
environments), `parallel_rollouts` (`rollouts` of one cloth), `study` (command `cloth_batch`) or `fit` (command
`cloth_fit`). The extra `batch` installs Dask, gymnasium, zarr and pyarrow. They are imported at their first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloth_sim_ros.batch.env import ClothEnv
    from cloth_sim_ros.batch.outcome import Outcome
    from cloth_sim_ros.batch.parallel_rollouts import Trajectories, rollouts
    from cloth_sim_ros.batch.vector_env import ClothVectorEnv

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
