# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison with real cloth, and with synthetic copies of recordings of it."""
