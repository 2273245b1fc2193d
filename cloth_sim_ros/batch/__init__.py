# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many simulations: studies on Dask, their datasets, environments for learning, rollouts, fits of a cloth's parameters.

Each simulation is a `simulation.Simulation` like a live one, and gives the same bits. Start with `vector_env` (cloths
for learning), `futures` (`rollouts` of one cloth), `study` (what `cloth_batch` runs) or `fit` (what `cloth_fit` finds).
Dask, gymnasium, zarr and pyarrow come with the extra `batch` and are loaded where they are first needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloth_sim_ros.batch.env import ClothEnv
    from cloth_sim_ros.batch.futures import Trajectories, rollouts
    from cloth_sim_ros.batch.outcome import Outcome
    from cloth_sim_ros.batch.vector_env import ClothVectorEnv

_PLACES = {
    "ClothEnv": "env",
    "ClothVectorEnv": "vector_env",
    "Outcome": "outcome",
    "Trajectories": "futures",
    "rollouts": "futures",
}

__all__ = ["ClothEnv", "ClothVectorEnv", "Outcome", "Trajectories", "rollouts"]


def __getattr__(name: str) -> Any:
    # A public name's module is imported when the name is first used: nothing that is not used is loaded.
    if name not in _PLACES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)
