# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The methods, each plain: what an integrator is (`base`), combinations of leapfrog runs (`columns`), implicit steps.

Begin with `base` and `columns`. Which of them runs, and by what steps, is chosen in `physics.control`.
"""
