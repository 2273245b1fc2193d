# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Textile tests of a fabric: drape, cantilever, tension, shear, bending and bias extension.

The commands `cloth_drape` and `cloth_lab` run them. Begin with `equilibrium`, then `drape` and `strips`.
"""
