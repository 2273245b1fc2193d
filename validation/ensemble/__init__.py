# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Validation of ensembles of cloths with uncertain parameters."""
