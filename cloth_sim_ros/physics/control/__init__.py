# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Step control: step sizes, orders and integrators by rules of stability, error, energy and fallback.

Start with `explicit.integrate`, the loop over the pieces of a frame. `controller` accepts and rejects them,
`frame_division` counts pieces and steps, `error_estimate` measures the error of a piece, `frame_totals` has the sums
over accepted ones. The rules are in `stability`, `error`, `changes` and `energy`; `work_budget` and `fallback` limit
the work. `precision` selects single precision, `multirate` the ratio of hinges, `automatic` the integrator. Their
states are in `physics.state.controller_state`, their tuned numbers in `constants`.
"""
