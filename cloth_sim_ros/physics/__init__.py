# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The model of a cloth and its motion: forces, plans, integrators. No ROS, no files, no clock.

Begin with `model` (masses, forces, anchors) and `plan` (`compile`: from a model to numbers); `forces` has one file a
force, `sheets` what cloths are made of, `integrators` and `control` how time is stepped, `state` what changes.
"""
