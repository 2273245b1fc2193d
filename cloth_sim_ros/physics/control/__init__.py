# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choosing steps, orders and integrators by four rules: stability, error, energy, fallback.

Begin with `explicit` (one advance, attempted until the rules hold; `calm` is the short way that most frames go);
`stability`, `error`, `energy` and `fallback` are the rules, `precision` says where single precision does, `automatic`
chooses the integrator. What they remember is in `physics.remembered`, their tuned numbers in `physics.constants`.
"""
