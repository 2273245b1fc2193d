# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bodies that others move: grippers, pinching jaws and obstacles.

Their poses and targets belong to the state. Each frame gives every body a smooth path to its target. Begin with
`bodies`.
"""
