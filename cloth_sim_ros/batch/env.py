# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `learning.env`."""

from cloth_sim_ros.learning.env import *  # noqa: F403
