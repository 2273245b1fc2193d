# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_bench`: run time against error, stability, speed, costs, peers.

Begin with `main` (the sections) and `problems` (scenes with a known answer); `report` writes tables, JSON and plots.
"""
