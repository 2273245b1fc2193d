# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Process of the node: arguments, signals, worker thread, failure and exit status.

A stop signal ends the node in order, and a recording is closed first. Begin with `process`.
"""
