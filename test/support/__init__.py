# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Shared parts of tests: independent references of the laws, and plans of single forces."""
