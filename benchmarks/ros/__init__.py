# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The live node: latency, start-up, late frames, outputs, recording."""
