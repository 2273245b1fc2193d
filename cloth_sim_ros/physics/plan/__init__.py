# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plan: a compiled model that runs steps and answers queries.

`compile` assembles a model's forces into the engine's arrays. A plan takes a state and returns numbers; it holds no
state of its own that a later step reads. Begin with `plan`.
"""
