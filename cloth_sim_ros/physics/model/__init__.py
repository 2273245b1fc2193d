# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Model of a cloth: masses, anchors and forces, which do not change while it moves.

`sheets` makes the springs of grids, meshes and chains, and `forces` holds one force per file. `parts` describes forces
to the engine. Begin with `model`.
"""
