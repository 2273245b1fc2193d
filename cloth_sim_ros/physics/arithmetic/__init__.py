# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arithmetic with the same bits on every machine: powers, angles, sums of arrays.

The C library, BLAS and numpy's reductions differ between machines. State, coefficients and decisions use these
functions instead. Begin with `deterministic_math`.
"""
