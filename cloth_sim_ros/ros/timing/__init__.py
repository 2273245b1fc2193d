# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Timing of the node: pacers, clocks, deadlines and the tolerance governor.

Wall time decides when a frame is computed, never its content. Begin with `frame_timing` and `stepper`.
"""
