# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulation of a cloth by frames, with events at frame boundaries.

Every change of a cloth's state goes through `Simulation.advance`. Begin with `simulation` (one frame with an ordered
list of events) and `events`. `bodies` moves grippers and obstacles. `sleep` decides when frames need no computation.
`energy_watch` sums up the energy balance. `environment` describes what a run's bits depend on.
"""
