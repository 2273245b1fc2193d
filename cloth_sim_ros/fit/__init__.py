# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits of a cloth's parameters to recorded point clouds, with error bounds.

The command `cloth_fit` reads a recording of a real cloth and finds stiffness, damping and mass. Begin with `fit`, then
`solver`.
"""
