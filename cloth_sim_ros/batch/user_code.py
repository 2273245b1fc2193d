# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `studies.user_code`."""

from cloth_sim_ros.studies.user_code import *  # noqa: F403
