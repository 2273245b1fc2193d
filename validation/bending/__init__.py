# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bending springs against plate theory, the elastica and their rest shapes."""
