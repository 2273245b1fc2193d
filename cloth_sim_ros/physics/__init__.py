# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The model of a cloth and its motion, without ROS, files or clocks.

Begin with `model` (masses, forces, anchors, sheets) and `plan` (`compile` turns a model into a callable plan).
`contact` has obstacles and jaws. `integrators` and `control` step time. `state` has the dynamic state. `accounting`
sums work and energy.
"""
