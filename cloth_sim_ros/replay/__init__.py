# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded sessions in Rerun: the viewer, a file, a picture. Imports the room session alone, and no ROS.

Begin with `main` (the command) and `stream` (what is logged, message by message).
"""
