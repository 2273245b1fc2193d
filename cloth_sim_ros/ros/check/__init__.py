# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a parameter file without a graph: `cloth_sim --check`.

They show the cloth, the expected real-time factor and the edges that limit the step. Begin with `check`.
"""
