# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact of a cloth with obstacles, with pinching jaws and with itself.

Obstacles are rigid bodies with exact distances. The bindings pass them to the engine, which calculates all contact
forces. Begin with `obstacles`, then `binding`.
"""
