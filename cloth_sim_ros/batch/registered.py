# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `learning.registered`."""

from cloth_sim_ros.learning.registered import *  # noqa: F403
