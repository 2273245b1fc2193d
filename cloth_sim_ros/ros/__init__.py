# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS node and its gripper client.

Only this package imports rclpy. `main` is the command `cloth_sim`, `gripper_main` the command `cloth_gripper`. `io` has
topics, services and parameters; `timing` decides when a frame is computed; `recording` writes sessions. Begin with
`node`.
"""
