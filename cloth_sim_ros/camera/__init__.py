# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth cameras that see the cloth and the obstacles, without ROS.

The node publishes their images. Begin with `depth_camera`.
"""
