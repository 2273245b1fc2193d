# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Live measurement of the node's error by an accuracy worker process.

The monitor costs no time and no import unless it is switched on. Begin with `accuracy_monitor`.
"""
