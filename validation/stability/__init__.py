# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stability scan of stress cases, and measured step limits against predicted ones."""
