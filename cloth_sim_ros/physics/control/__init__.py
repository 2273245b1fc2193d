# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choosing steps, orders and integrators by stability, error and energy, and remembering why.

Begin with `controlled` (one advance, attempted until it is stable and accurate) and `control` (what it remembers, and
its
constants); `economies` says what single runs save on, `energy_guard` looks at energy, `last_resort` takes what explicit
steps can't follow, `automatic` chooses the integrator.
"""
