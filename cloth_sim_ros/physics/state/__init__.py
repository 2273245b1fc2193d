# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""State of a cloth: everything that a later step reads, and its digest.

A state also carries the memory of step control and of contact by name. Files from strangers are checked before use.
Begin with `state`.
"""
