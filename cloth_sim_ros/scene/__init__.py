# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Configuration of a cloth: parameters, files, and the model built from them.

Begin with `scene` (the frozen configuration) and `sections` (every parameter with its default). `parameters` declares
parameters and reads their files, and `files` reads the files that a scene names. `build` makes a model and
its plan. `topology_id` identifies the cloth of a state.
"""
