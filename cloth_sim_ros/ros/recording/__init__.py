# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of the node into a session, and initial states from recorded sessions.

A session survives a kill at any byte. Without a recording no module of sessions is imported. Begin with
`recording_control`.
"""
