# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What several tests need: independent references of the laws, and a force alone in a plan."""
