# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Configuration of a cloth: what its parameters are, what they mean, and the physics that they make.

Begin with `scene` (the frozen configuration) and `sections` (every parameter with its default, once); `parameters` says
what a parameter is, `files` and its like read what a scene names, `build` makes a model and its plan of it, `identity`
tells whether a state is one of this cloth, `without_effect` which parameters a scene does not use. Pure data otherwise.
"""
