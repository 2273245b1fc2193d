# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Integration methods: the interface (`base`), extrapolated leapfrog runs and implicit steps.

Start with `base` and `extrapolation_tableau`. The package `physics.control` chooses method and step sizes.
"""
