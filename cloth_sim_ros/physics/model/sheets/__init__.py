# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Geometry, masses and springs of grids, triangle meshes, chains and raw springs.

Begin with `grid` and `mesh`. `surface` has triangles, edges and hinges of either, `material` and `bending` turn moduli
into stiffnesses, `hinge_shape` measures a fold.
"""
