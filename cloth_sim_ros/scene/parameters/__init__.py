# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters: their declaration, their files in ROS's format, and warnings about them.

A parameter's name, type, range and description are declared once. The node, the files and the reference page read the
declaration. Begin with `declare`.
"""
