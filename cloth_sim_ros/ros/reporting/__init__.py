# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reports of the node: log lines, diagnostics and their texts.

A log line states cause and remedy; repeated lines are throttled. Begin with `reporting`.
"""
