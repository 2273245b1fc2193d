# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing and reading recorded sessions: MCAP files of standard ROS 2 messages.

Imports neither ROS, scene nor physics: a session can be read on a machine that has none of them. Import the modules by
name; this package itself loads nothing. Begin with `reader` and `recorder`.
"""
