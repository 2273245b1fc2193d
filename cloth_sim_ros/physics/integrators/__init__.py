# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Integrators, each plain and doing what its name says. Begin with `base` and `leapfrog`."""
