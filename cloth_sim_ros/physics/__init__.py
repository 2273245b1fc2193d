# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The model of a cloth and its motion, without ROS, files or clocks.

Begin with `model` (masses, forces, anchors) and `plan` (`compile` turns a model into a callable plan). `forces` has one
file a force. `sheets` builds grids, meshes and chains. `integrators` and `control` step time. `state` has the dynamic
state.
"""
