# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing and reading recorded sessions: MCAP files of standard ROS 2 messages.

Imports neither ROS, scene nor physics, so that a session can be looked at where none of them is installed. The
modules are imported by name (``from cloth_sim_ros.session.reader import SessionReader``); this package itself loads
nothing.
"""
