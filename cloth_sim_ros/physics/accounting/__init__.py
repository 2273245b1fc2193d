# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Accounting of a motion: wrenches, work, dissipation and the energy balance.

The integrals add up step by step in a fixed order. Rejected steps leave nothing behind. Begin with
`work_accumulator`.
"""
