# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Step control: step sizes, orders and integrators by rules of stability, error, energy and fallback.

Start with `explicit`: one advance, repeated until all rules hold; `fast_path` serves most frames. The rules are
`stability`, `error`, `energy` and `fallback`. `precision` selects single precision, `automatic` the integrator. Their
states are in `physics.state.controller_state`, their tuned numbers in `constants`.
"""
