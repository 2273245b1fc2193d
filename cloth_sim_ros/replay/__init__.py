# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Replay of recorded sessions in Rerun: in the viewer, as a file, as a picture.

Imports `session` only, and no ROS. Entry points: `main` (the command) and `stream` (logging, message by message).
"""
