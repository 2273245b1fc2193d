# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many simulations: studies on Dask, their datasets, environments for learning, rollouts, fits of a cloth's parameters.

Each simulation is a `simulation.Simulation` like a live one, and gives the same bits. Start with `vector_env` (cloths
for learning), `rollouts` (futures of one cloth), `study` (what `cloth_batch` runs) or `fit` (what `cloth_fit` finds).
Dask, gymnasium, zarr and pyarrow come with the extra `batch` and are loaded where they are first needed.
"""
