# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics, services, parameters and transforms of the node.

A message is checked and becomes an event; a frame becomes messages. No physics happens here. Begin with `inputs`
and `outputs`.
"""
