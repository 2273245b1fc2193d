# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Links of a robot as obstacles: its description (URDF), its kinematics and its collision geometry.

`links.add_links` extends the parameters of a scene by the obstacles; begin reading there. Scenes and sessions hold the
resulting obstacles, so they need no module of this folder to run.
"""
