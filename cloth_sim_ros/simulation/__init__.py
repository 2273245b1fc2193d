# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The only door through which a cloth's state changes: frames, with events at their boundaries.

Begin with `simulation` (advance one frame with an ordered list of events) and `events`; `grippers` keeps poses and
what is held, `sleep` knows when nothing moves, `energy_watch` sums up the balance, `environment` tells what the bits of
a run depend on.
"""
