# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `fit.fit`."""

from cloth_sim_ros.fit.fit import *  # noqa: F403
