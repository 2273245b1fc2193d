# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Client of the node's grippers: plays scripted grasps through the command topics.

The command `cloth_gripper` and the demonstration use it. Begin with `gripper_player`. `viewer_feed` is the
client of the command `cloth_viewer`.
"""
