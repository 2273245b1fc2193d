# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded sessions and running nodes in Rerun: in the viewer, as a file, as a picture.

Imports `session` only, and no ROS. Entry points: `main` (the command), `live_main` (the drawing process of
`cloth_viewer`) and `stream` (logging, message by message).
"""
