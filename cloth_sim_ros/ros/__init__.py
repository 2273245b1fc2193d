# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node and its client: the only room that imports rclpy.

Begin with `node` (the cloth in a graph: timer, queue, stepper, outputs) and `main` (the command); `gripper_main` is the
client that plays a scripted grasp, `parameters` and `services` what the graph sees, `recording` what a session gets.
"""
