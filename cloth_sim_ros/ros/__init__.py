# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS node and its gripper client.

Only this package imports rclpy. `main` is the command `cloth_sim`. `node` connects a simulation to the graph: pacer,
event queue, stepper and outputs. `parameters` and `services` are its interface; `recording` writes sessions.
`gripper_main` plays scripted grasps.
"""
